#pragma once
// Projection onto the manifold of the invariants in the weighted Euclidean norm (paper, sections 3 and 4;
// docs/algorithms.md, 'Projection').

#include <Eigen/Core>
#include <cstddef>
#include <vector>

#include "manifold/invariants.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// Moves points to the manifold r(t, y) = 0 along minimum-norm Newton corrections δ = W (J W)⁺ r, y ← y − δ.
///
/// Each row of J W, and with it r, is divided by the row's 2-norm. The scaled residual is then the distance to that
/// invariant's level set in units of the weights, whatever the units of g. Rows that are zero, or that depend on others
/// to within max(rtol, 1e-10), are dropped.
class Projector {
 public:
  /// `negligible`: candidates closer than this to the manifold, in units of rtol, are left alone; 0: none is.
  Projector(Invariants& invariants, const Weights& weights, int iterations, double negligible = 0);

  /// The paper's projection of the candidate y* (in `y`, overwritten by y₁) of a step from `from`: the given number of
  /// iterations, each with g and J taken afresh, W = max(|from|, |y*|, thr) frozen.
  Outcome project(double t, const double* from, double* y);
  /// Whether the last candidate was left alone: there is then no linearization at it.
  [[nodiscard]] bool skipped() const { return skipped_; }
  /// Residuals of the last candidate, and as distances from the level sets, in units of the weights.
  [[nodiscard]] const std::vector<double>& residual_before() const { return residual_before_; }
  [[nodiscard]] const std::vector<double>& distance_before() const { return distance_before_; }

  /// At most `most` iterations towards r(t, y) = target with the given W: for points between steps.
  Outcome onto(double t, const double* w, const double* target, double* y, int most);

  /// Projects to roundoff (at most 50 iterations, the iterate of least residual is kept), with W = max(|y|, thr).
  struct Imposed {
    Outcome outcome;
    bool converged;  // every residual is roundoff. If not, y is unchanged
    int iterations;
  };
  Imposed impose(double t, double* y);

  /// Takes r, J and the rows' norms at (t, y) with the weights W = max(|y|, thr), without moving y.
  Outcome linearize_at(double t, const double* y);

  [[nodiscard]] const Invariants& invariants() const { return invariants_; }

  // Of the last linearization: where it was taken, and what it found.
  [[nodiscard]] const double* point() const { return point_.data(); }
  [[nodiscard]] const double* residual() const { return r_.data(); }
  [[nodiscard]] const double* jacobian() const { return J_.data(); }
  [[nodiscard]] const double* weights() const { return w_.data(); }
  [[nodiscard]] double row_norm(std::size_t i) const { return norm_[i]; }

  /// Of the last `project`: max_i |y*_i − y₁_i| / w_i.
  [[nodiscard]] double correction() const { return correction_; }

  /// Which invariants were dropped in any projection so far, and the t at which that was first seen.
  [[nodiscard]] const std::vector<char>& dropped() const { return dropped_; }
  [[nodiscard]] double dropped_at() const { return dropped_at_; }

 private:
  Outcome linearize(double t, const double* y);
  Outcome linearize_known(double t, const double* y);
  Outcome measure(double t, const double* y);
  void solve(double t);
  void solve_several(double t);
  void remove_component(std::size_t i, std::size_t q);
  void drop(std::size_t i, double t);
  [[nodiscard]] double roundoff_units(const double* y) const;  ///< largest residual, in units of its roundoff

  Invariants& invariants_;
  const Weights& tolerances_;
  int iterations_;
  double negligible_;
  double pivot_threshold_;
  bool skipped_ = false;
  bool linearized_ = false;
  std::vector<double> residual_before_, distance_before_;
  std::vector<double> r_, J_, norm_, w_, point_, delta_, original_, best_;
  Eigen::MatrixXd scaled_;          // (n, m): the rows of J W, each divided by its norm, as columns; becomes Q
  Eigen::MatrixXd R_;               // (m, m): column i has the components of row i in Q
  Eigen::VectorXd z_;               // (m)
  std::vector<std::size_t> order_;  // of the pivots
  double correction_ = 0;
  std::vector<char> dropped_;
  double dropped_at_ = 0;
};

}  // namespace invariode
