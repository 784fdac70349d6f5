#pragma once
// Projection onto the manifold of the invariants in the weighted Euclidean norm (paper, sections 3 and 4;
// docs/algorithms.md, 'Projection').

#include <cmath>
#include <cstddef>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "manifold/directions.hpp"
#include "manifold/invariants.hpp"
#include "manifold/levels.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// r (m), J and the norms of the rows of J W (m), with the point y and the weights W where they were taken.
struct Linearization {
  const RowLayout* layout;  ///< of J
  std::vector<double> r, norm, y, w, J;

  [[nodiscard]] std::size_t n() const { return y.size(); }
  [[nodiscard]] std::size_t m() const { return r.size(); }
  /// The gradient of invariant i.
  [[nodiscard]] Row gradient(std::size_t i) const { return layout->row(i, J.data()); }
  /// The distance of the level set of invariant i, in units of the weights; 0 where the gradient vanishes.
  [[nodiscard]] double distance(std::size_t i) const { return norm[i] > 0 ? std::abs(r[i]) / norm[i] : 0; }
};

/// The result of projecting a candidate. The spans are views of the projector's latest.
struct Projected {
  Outcome outcome = Outcome::ok;
  bool skipped = false;              ///< the candidate was left alone: there is no linearization at it
  double correction = 0;             ///< max_i |y*_i − y₁_i| / w_i
  std::size_t rank = 0;              ///< of the invariants, at the last iteration
  std::span<const double> residual;  ///< of the candidate, (m)
  std::span<const double> distance;  ///< the same as distances from the level sets, in units of the weights
};

/// The result of `impose` or `approach` at a point.
struct Imposed {
  Outcome outcome;
  bool converged = false;  ///< every residual is roundoff
  int iterations = 0;
  double gain = 1;  ///< the largest residual in units of its roundoff, divided by what it was
};

/// Moves points to the manifold r(t, y) = 0 along minimum-norm Newton corrections δ = W (J W)⁺ r, y ← y − δ.
///
/// Each row of J W, and with it r, is divided by the row's 2-norm. The scaled residual is then the distance to that
/// invariant's level set in units of the weights, whatever the units of g. Rows that are zero, or that depend on others
/// to within max(rtol, 1e-10, what their derivatives are good to), are left out. Invariants in levels are corrected
/// level by level (`Levels`), otherwise alike.
class Projector {
 public:
  /// `negligible`: candidates closer than this to the manifold, in units of rtol, are left alone; 0: all are projected.
  /// A projector with a partner, of the same invariants, takes turns with it in the memory of corrections: the factors
  /// that `correction_for` applies are those of the last correction of either.
  Projector(Invariants& invariants, const Weights& weights, int iterations, double negligible = 0,
            const Projector* partner = nullptr);

  /// The paper's projection of the candidate y* (in `y`, overwritten by y₁) of a step from `from`: the given number of
  /// iterations, each with g taken afresh, and J unless the one before serves to roundoff, W = max(|from|, |y*|, thr)
  /// frozen; in levels at most so many, until a correction leaves roundoff. Not finite as well where g is not defined
  /// at y₁, or y₁ is no nearer to the manifold.
  Projected project(double t, const double* from, double* y);
  /// Moves y, in at most `most` iterations, to r(t, y) = target with the given W: for points between steps.
  Outcome onto(double t, const double* w, const double* target, double* y, int most);
  /// Projects to roundoff (at most 50 iterations, the iterate of least residual is kept), with W = max(|y|, thr).
  /// A point where that fails is left unchanged.
  Imposed impose(double t, double* y);
  /// Projects to roundoff as `impose` does, and takes the iterate of least residual wherever it is.
  Imposed approach(double t, double* y);

  /// Factors at (t, y), with the weights W = max(|y|, thr), without moving y.
  Outcome factorize_at(double t, const double* y);
  /// δ = W (J W)⁺ r for another residual r (m), with the linearization, the factors and the rank of the latest
  /// correction: what it left out, and components that it left alone, take no part.
  void correction_for(const double* r, double* delta, const double* noise = nullptr);

  /// From now on corrections are combinations of these vectors (n), which stay until the next projection.
  void seek_along(std::span<const double* const> vectors);

  /// Takes r, J and the rows' norms at (t, y) with the weights W = max(|y|, thr), without moving y.
  Outcome linearize_at(double t, const double* y);
  /// The latest one.
  [[nodiscard]] const Linearization& linearization() const { return at_; }

  [[nodiscard]] Invariants& invariants() const { return invariants_; }
  /// The invariant that was not finite, or whose gradient was not, where a projection failed for that; -1: none was.
  [[nodiscard]] int undefined() const { return undefined_; }
  /// Corrections leave component j where it is, until it is released.
  void fix(std::size_t j);
  void release(std::size_t j);
  void release_all();
  [[nodiscard]] bool fixed(std::size_t j) const { return !fixed_.empty() && fixed_[j] != 0; }
  [[nodiscard]] bool any_fixed() const { return fixed_count_ > 0; }
  /// Invariant i, which may only rise or fall, takes no part until it is engaged. None does at first.
  void rest(std::size_t i);
  void engage(std::size_t i);
  void rest_one_sided();
  [[nodiscard]] bool idle(std::size_t i) const { return !idle_.empty() && idle_[i] != 0; }
  [[nodiscard]] bool all_idle() const { return idle_count_ == m_; }
  [[nodiscard]] bool any_engaged() const { return idle_count_ < one_sided_; }
  /// Forgets what is known of the gradients: the solution jumps.
  void forget() { linearized_ = false; }
  /// The invariants that are redundant: those left out in a tenth of the corrections so far, if in a fifth of them, and
  /// of the time that they cover, some were. (One that depends on the others in a few steps only, as in the short ones
  /// of a start where components are small beside thr, does no harm.)
  [[nodiscard]] std::vector<char> dropped() const;
  /// The t at which some were first left out.
  [[nodiscard]] double dropped_at() const { return dropped_at_; }
  void state(Archive& archive);
  /// Size below which the residual of invariant i at y, near the latest linearization, is roundoff: of g, of the point,
  /// and where components are fixed of the coefficients that the others have in it.
  [[nodiscard]] double roundoff(std::size_t i, const double* y);
  /// Returns whether the latest correction left out invariant i.
  [[nodiscard]] bool left_out(std::size_t i) const { return left_out_[i] != 0; }

 private:
  double* provide();
  [[nodiscard]] double noise(std::size_t i, const double* y, const double* size) const;
  Outcome linearize(double t, const double* y);
  bool correct_again(double* y);
  [[nodiscard]] double largest_distance() const;
  [[nodiscard]] double size_of_correction() const;
  Outcome linearize_known(double t, const double* y);
  [[nodiscard]] double movable_part(std::size_t i) const;
  [[nodiscard]] bool stuck(std::size_t i) const;
  void scale_row(std::size_t i);
  [[nodiscard]] double preference(std::size_t i) const;
  Outcome measure(double t, const double* y);
  Outcome measure_after(double t, const double* y);
  bool defined(const double* r);
  [[nodiscard]] bool close_enough(const double* y);
  [[nodiscard]] double doubt(const double* y) const;
  [[nodiscard]] bool far_off(const double* y) const;
  [[nodiscard]] bool bends(const double* from, const double* y) const;
  [[nodiscard]] bool crossed_zero(const double* y) const;
  std::size_t solve(double t);
  void keep_to_directions();
  [[nodiscard]] bool out_of_reach(std::size_t i, double share) const;
  void count_correction(double t, std::size_t rank);
  std::size_t solve_one(double t);
  void correct_one(double r, double* delta);
  void apply_factors(const double* r, double* delta);
  std::size_t solve_several(double t);
  std::size_t solve_in_levels(double t);
  const char* without_part();
  [[nodiscard]] bool settled() const;
  void leave_out(std::size_t i, double t);
  [[nodiscard]] double pivot_threshold() const;
  void take_units(const double* y);
  [[nodiscard]] double in_units() const;

  /// Memory of corrections, in which projectors of the same invariants take turns.
  struct Room {
    std::vector<double> delta, original, best;
    PivotedBasis basis;              // of the rows of J W, each divided by its norm; levels have their own
    std::optional<Levels> levels;    // where the invariants have any
    std::vector<std::size_t> order;  // of the pivots, then what is left out
  };

  Invariants& invariants_;
  std::size_t n_, m_;
  const Weights& tolerances_;
  int iterations_;
  double negligible_;
  Linearization at_;
  bool linearized_ = false;  // the norms of the rows are of some earlier point, at least
  double bent_ = 0;          // relative change of the length of a gradient since the linearization before
  std::vector<double> residual_before_, distance_before_, unit_;
  std::vector<double> linearized_w_;
  std::shared_ptr<Room> room_;
  std::vector<char> left_out_;         // in the latest correction
  std::vector<std::int64_t> dropped_;  // in how many corrections
  std::int64_t corrections_ = 0, deficient_ = 0;
  double corrected_at_ = 0;                     // t of the latest correction
  double covered_ = 0, covered_deficient_ = 0;  // times between corrections, and those to where some were left out
  double dropped_at_ = 0;
  int undefined_ = -1;
  std::vector<char> fixed_;  // components that corrections leave alone; empty: there never was one, nor the next four
  std::size_t fixed_count_ = 0;
  std::vector<double> unit_of_component_, free_w_;  // the tolerances as units; w, 0 where fixed
  std::vector<double> movable_;                     // `movable_part` of each invariant
  std::vector<char> without_part_;                  // see there
  std::vector<char> idle_;                          // invariants that take no part; empty: none may only rise or fall
  std::optional<Directions> directions_;            // of corrections, where these are told
  std::size_t idle_count_ = 0, one_sided_ = 0;
  // Of the latest correction.
  std::size_t rank_ = 0;
  double distance_ = 0;                // the largest one of the invariants, before it
  const double* movable_w_ = nullptr;  // in levels: W, 0 where fixed
  const char* apart_ = nullptr;        // and what takes no part
};

}  // namespace invariode
