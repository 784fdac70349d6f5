#include "methods/order_two.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace invariode {
namespace {

// Newton's iteration has to be more exact than in ode15s: its errors enter z, divided by d, and the stages of the next
// step (at ode15s' goal of 0.5 rtol van der Pol's equation has errors ten times larger).
constexpr Convergence::Rules rules{.most_iterations = 5, .goal = 0.03, .first_goal = 0.003};
// J older than `old_jacobian` may be so much larger than the present one that Newton's updates are too small to show
// how wrong they are: the iteration converges, to what does not solve the equations (van der Pol's equation with ε =
// 1e-12 loses its limit cycle at 1e-3, the Oregonator its second pulse). CVODE looks at its matrix as often.
constexpr double least_worthwhile = 1.2;  // a change of h up to this is not worth a factorisation

}  // namespace

OrderTwo::OrderTwo(Callback& f, const Weights& weights, const LinearAlgebra& linear, double d,
                   const Extension& extension)
    : ImplicitBase(f, weights, linear, rules), d_(d), extension_(extension) {
  provide({&slope_, &second_, &last_y_, &last_slope_, &base_, &psi_, &increment_, &error_vector_});
}

Outcome OrderTwo::start(double t, const double* y, const Span& span) {
  last_h_ = 0;
  solver_.restart();
  const Outcome outcome = begin(t, y, candidate_.data(), slope_.data());
  if (outcome != Outcome::ok) return outcome;
  return choose_initial_step(span, third, candidate_.data(), slope_.data(), base_.data(), second_.data());
}

Step::Attempt OrderTwo::attempt(double h, double t1) {
  begin_attempt(h, t1);
  solver_.renew_if_noise(d_ * h);
  if (solver_.jacobian_age() >= old_jacobian) solver_.renew();
  if (solver_.repair(t_, y()) == Status::stop) return proposal(Newton::Result::stop);
  Newton::Result result = stages();
  if (result == Newton::Result::converged) {
    estimate(error_vector_.data());
    undamped_error_ = error_norm(error_vector_);
    result = damp(error_vector_.data());
  }
  if (result == Newton::Result::converged) error_ = end_error_ = error_norm(error_vector_);
  return proposal(result);
}

Newton::Result OrderTwo::solve_stage(double t, double* y, double* z) {
  const double c = d_ * signed_h_;
  const Newton::Result ready = newton_result(solver_.prepare(c, t));
  if (ready != Newton::Result::converged) return ready;
  keep_sides();
  for (std::size_t i = 0; i < n(); ++i) base_[i] += psi_[i];
  weights_.fill(this->y(), base_.data(), weight_.data());
  const Newton::Result result = solver_.solve(c, t, base_.data(), psi_.data(), weight_.data(), increment_.data(), y);
  for (std::size_t i = 0; i < n(); ++i) z[i] = (psi_[i] + increment_[i]) / d_;
  return result;
}

/// A component that y' leads away from 0, but whose prediction has the other sign, is predicted by y' alone: f may have
/// a pole at 0, such as c / y, and Newton's iteration would converge to a solution on the other side.
void OrderTwo::keep_sides() {
  for (std::size_t i = 0; i < solver_.system().state().size(); ++i)
    if (signed_h_ * slope_[i] * y_[i] > 0 && (base_[i] + psi_[i]) * y_[i] < 0) psi_[i] = d_ * signed_h_ * slope_[i];
}

/// The estimate before it is damped measures the slopes of which P is made. Where it is within the tolerance, it is all
/// that is needed; f is evaluated where damping has hidden something.
Step::Attempt OrderTwo::inspect_extension(const Attempt&) {
  const double undamped = undamped_error();
  double error = extension_.error * undamped;
  if (!(undamped <= weights_.rtol())) {
    error = 0;
    for (const double theta : extension_.theta) {
      const Newton::Result result = filter_defect(theta);
      if (result != Newton::Result::converged) return proposal(result);
      error = std::max(error, error_norm(increment_));
      if (!(error <= weights_.rtol())) break;
    }
  }
  error_ = std::max(error_, error);
  return proposal(Newton::Result::converged);
}

/// The larger one of that of the attempt and that of the last step, as h³ scales it: one of them may be small by
/// chance.
double OrderTwo::undamped_error() const {
  if (last_h_ == 0) return std::numeric_limits<double>::infinity();
  const double ratio = signed_h_ / last_h_;
  return std::max(undamped_error_, ratio * ratio * ratio * last_undamped_error_);
}

/// (M − d h J)⁻¹ d h (f(P) − M P') at θ. Where J is large that is y − P, and in algebraic equations too, which nothing
/// else tests between the ends of a step; in the smooth part it is d h times the defect.
Newton::Result OrderTwo::filter_defect(double theta) {
  if (extend(theta, psi_.data(), base_.data()) == Status::stop) return Newton::Result::stop;
  const double t = t_ + theta * signed_h_;
  const Newton::Result evaluated = newton_result(solver_.evaluate(t, psi_.data(), increment_.data()));
  if (evaluated != Newton::Result::converged) return evaluated;
  if (Mass* mass = solver_.mass()) {
    if (!mass->constant() && mass->evaluate(t) == Status::stop) return Newton::Result::stop;
    psi_ = base_;
    solver_.system().multiply_mass(mass->matrix(), psi_.data(), base_.data());
    if (!mass->constant() && mass->evaluate(t1_) == Status::stop) return Newton::Result::stop;
  }
  for (std::size_t i = 0; i < n(); ++i) increment_[i] = d_ * (signed_h_ * increment_[i] - base_[i]);
  return solver_.filter(increment_.data());
}

bool OrderTwo::reject(Cause cause, double hmin) {
  if (cause == Cause::newton) return retry_newton(hmin, newton_cut) || (h_ <= hmin && solver_.iterate_fully());
  return retry_of_order_two(cause, hmin);
}

/// The slope belongs to y*: that projection has moved it is of higher order (as in explicit pairs), and costs no f.
Outcome OrderTwo::accept(const double* y1) {
  if (end_slope(last_slope_.data()) == Status::stop) return Outcome::stop;
  last_slope_.swap(slope_);
  last_y_.swap(y_);
  commit(y1);
  last_h_ = signed_h_;
  last_undamped_error_ = undamped_error_;
  if (!failed_) {
    const double divisor = divisor_of_order_two();
    if (divisor > 1 || divisor * least_worthwhile < 1) h_ /= divisor;
  }
  failed_ = false;
  return Outcome::ok;
}

void OrderTwo::state(Archive& archive) {
  Step::state(archive);
  solver_.state(archive);
  archive(slope_, last_y_, last_slope_, last_h_, last_undamped_error_, failed_);
}

}  // namespace invariode
