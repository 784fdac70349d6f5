#pragma once
// The continuous solution over one accepted step: the method's raw extension, corrected so that it meets the stored
// values at both ends, and projected so that it keeps the invariants (docs/algorithms.md, 'Between steps';
// beyond the paper).

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include "manifold/bounds.hpp"
#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "sensitivity/tangent.hpp"
#include "sensitivity/variations.hpp"
#include "step.hpp"

namespace invariode {

/// `raw`: the method's own extension P(θ), as in the paper and the suite. `corrected`: P(θ) + e₀ (1−θ)²(1+2θ) + e₁
/// θ²(3−2θ) with e₀ = y − P(0), e₁ = y₁ − P(1). `projected`: that, projected with the step's W onto g = (1−θ) g₀ + θ
/// g₁, where g₀ and g₁ are the values at the ends (what is one-sided, between these); without invariants the same as
/// `corrected`.
enum class Interpolation { projected, corrected, raw };

/// One accepted step as data: [raw extension | e₀ e₁ | W g₀ g₁ | T₀ T₁], the later parts only where the mode reads
/// them; T₀ and T₁ are G S + g_p at the ends, where there are sensitivities.
struct Segment {
  double t0;
  double t1;
  const double* data;
  std::size_t size;
};

/// Contents that the segments of one solution share: sizes, and how they are read.
struct SegmentKind {
  Extent extent;  ///< of a value
  std::size_t m;  ///< invariants between steps
  Interpolation mode;
  Interpolate raw;

  [[nodiscard]] bool projects() const { return mode == Interpolation::projected && m > 0; }
  /// Doubles in a segment beyond its raw extension.
  [[nodiscard]] std::size_t overhead() const {
    if (mode == Interpolation::raw) return 0;
    return 2 * extent.size() + (projects() ? extent.n + 2 * m * (1 + extent.k) : 0);
  }
  bool operator==(const SegmentKind&) const = default;
};

/// Evaluates segments. Without invariants `projector` is null; without their functions too, and values are corrected
/// only. With sensitivities `tangent` goes with it, which moves them onto T = (1−θ) T₀ + θ T₁. Without bounds `bounds`
/// is null; values are within them in every mode.
class Interpolant {
 public:
  Interpolant(const SegmentKind& kind, Projector* projector, TangentProjector* tangent, const Bounds* bounds)
      : kind_(kind),
        n_(kind.extent.size()),
        m_(kind.projects() ? kind.m : 0),
        projector_(projector),
        tangent_(tangent),
        bounds_(bounds),
        target_(m_),
        tangent_target_(kind.extent.k * m_) {}

  /// The value at t in the mode. Outside the segment the corrections stay those of its end and nothing is projected.
  Status value(const Segment& segment, double t, double* y);
  /// Evaluates with the corrections but without projection: cheap, and equal to `value` at both ends.
  void corrected(const Segment& segment, double t, double* y) const { corrected(segment, {&t, 1}, y); }
  /// Evaluates with the corrections, without projection, at several t, (count, n).
  void corrected(const Segment& segment, std::span<const double> t, double* y) const;

 private:
  void correct_ends(const double* e0, double theta, double* y) const;
  void choose_directions(const Segment& segment);
  Outcome follow_tangent(double t, double theta, const double* T0, double* y);

  SegmentKind kind_;
  std::size_t n_;  // doubles of Y
  std::size_t m_;  // invariants that it projects onto
  Projector* projector_;
  TangentProjector* tangent_;
  const Bounds* bounds_;
  std::vector<double> target_, tangent_target_;
  std::vector<double> path_;               // points of the segment less its start,
  std::vector<const double*> directions_;  // as vectors

  friend class StepInterpolant;
};

/// The interpolant of the step that the loop has just accepted. Its segment is made when it is first asked for: a step
/// that nobody looks into costs nothing.
class StepInterpolant {
 public:
  /// Makes the interpolant of a step of Y, whose state has n doubles. `between`: projects the points between steps,
  /// with the tangent; `steps`: has projected the step, and knows its weights. Null without invariants.
  StepInterpolant(Step& step, std::size_t n, Interpolation mode, Projector* between, TangentProjector* tangent,
                  const Projector* steps, const Bounds* bounds = nullptr);

  /// The step from (t0, y0), which stays where it is until the next one, to the method's present (t, y) was accepted.
  void accept(double t0, const double* y0) {
    made_ = false;
    start_t_ = t0;
    start_y_ = y0;
    end_t_ = step_.t();
  }
  /// Takes a step from (t0, y0) to t1 that was made elsewhere. Returns the place of its segment, `max_size` doubles.
  double* take(double t0, const double* y0, double t1);
  [[nodiscard]] const double* start_y() const { return start_y_; }
  /// The solution jumps: what is known at the end of the last step does not hold at the start of the next.
  void restart() { g_known_ = false; }

  /// Archives the data of the start of the next step.
  void state(Archive& archive) { archive(g_known_, g_t_, g_end_, tangent_end_); }

  Status value(double t, double* y);
  /// Evaluates at several t, (count, n).
  Status values(std::span<const double> t, double* y);
  Status corrected(double t, double* y);
  /// The order up to which `powers` has coefficients. Nothing: the step is not known by powers of θ.
  [[nodiscard]] std::optional<int> order_of_powers() const {
    return step_.extends_by_powers() ? std::optional(step_.degree()) : std::nullopt;
  }
  /// Coefficients of θ^0 … of `corrected`, where it is within bounds, (order + 1, n).
  Status powers(std::vector<double>& c);
  [[nodiscard]] const SegmentKind& kind() const { return interpolant_.kind_; }
  /// Doubles in a segment, at most.
  [[nodiscard]] std::size_t max_size() const { return step_.max_extension_size() + kind().overhead(); }
  /// The segment, made if it was not yet; data is null if a user function stopped the run meanwhile.
  Segment segment();

 private:
  Status make();
  Status residuals(double* g0, double* g1);
  Status tangents(double* T0, double* T1);

  Step& step_;
  Invariants* invariants_;
  const Projector* projector_;
  Interpolant interpolant_;
  double start_t_ = 0, end_t_ = 0;
  const double* start_y_ = nullptr;
  std::vector<double> data_;
  std::size_t size_ = 0;
  bool made_ = false;
  double g_t_ = 0;  // g_end_ is g at this t, if known
  bool g_known_ = false;
  std::vector<double> g_end_, tangent_end_;
};

}  // namespace invariode
