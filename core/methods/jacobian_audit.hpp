#pragma once
// Is the Jacobian that of f? (docs/algorithms.md, 'Newton', 'Jacobians')

#include <cstdint>
#include <optional>
#include <vector>

#include "linear/jacobian.hpp"
#include "linear/jacobian_check.hpp"
#include "linear/kink.hpp"
#include "linear/misfit.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// Tests a Jacobian that is a matrix: when it is taken, as far as steps are accurate, and when residuals contradict it,
/// whether f has the branch there on which it was taken. Its evaluations of f are counted apart.
class JacobianAudit {
 public:
  JacobianAudit(Jacobian& jacobian, Callback& f, const Weights& weights);

  /// A start: the next J is its first one.
  void start() { first_ = true; }
  /// J is taken at (t, y).
  void begin(double t, const double* y);
  /// Tests J at (t, y), where f is `slope`, if that is due; without a slope only a J that is given. What does not fit
  /// is mended as far as it can be.
  Status look(double t, const double* y, const double* slope);
  /// The fit of J to the iterate y at t, of which updates by J have not removed the residual r. It is
  /// `of_another_branch` if J r was not the derivative of f where J was taken, or if this derivative jumps between
  /// there and (t, y); otherwise `stiffness_has_gone` says that c times the derivative along r is not large any more.
  /// (r points to where J is large; the updates do not, since it is large there.) `w`: weights.
  enum class [[nodiscard]] Fitness { fits, of_another_branch, stiffness_has_gone, stop };
  Fitness examine(double c, double t, const double* y, const double* r, const double* w);
  /// f at (t, y), for a test.
  Outcome evaluate(double t, const double* y, double* out);

  [[nodiscard]] std::int64_t evaluations() const { return evaluations_; }
  /// The place where a given Jacobian was found to differ from that of f.
  [[nodiscard]] const std::optional<Misfit>& misfit() const { return misfit_; }
  void state(Archive& archive);

  static constexpr double large_stiffness = 10;  ///< c ‖J‖ above which a Jacobian of another point may do harm
  static constexpr double roundoffs_of_f = 10;   ///< in a residual, each of the size of its terms

 private:
  bool due(const double* y);
  Status fit_or_mend(double t, const double* y, const double* slope);
  JacobianCheck::Fit fit(Callback& f, double t, const double* y, const double* slope, double part);
  Status take_beside(Callback& f, double t, const double* y);
  Status mend(Callback& f, double t, const double* y, const double* slope);
  void note_branch(double t, const double* y);
  void find_increment(const double* y, const double* r, const double* w);
  Outcome examine_branch(Callback& f, const double* w);

  Jacobian& jacobian_;
  Callback& f_;
  const Weights& weights_;
  JacobianCheck check_;
  std::vector<double> reach_;  // of the check
  KinkSearch kinks_;
  std::vector<double> increment_;  // of its differences, and
  std::vector<double> changes_;    // of f along it by J
  double branch_t_ = 0;            // as far as f is known to be smooth from where J was taken
  std::vector<double> branch_y_;
  bool branch_examined_ = false;   // J is known to be that of its branch
  std::optional<double> fitting_;  // the largest size of a J that has passed
  std::optional<Misfit> misfit_;
  bool first_ = true;  // J will be the first one of a start
  std::int64_t evaluations_ = 0;
};

}  // namespace invariode
