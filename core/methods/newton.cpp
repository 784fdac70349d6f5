#include "methods/newton.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "linear/time_derivative.hpp"

namespace invariode {
namespace {

// The constants of the suite (Shampine & Reichelt, 1997, section 2, and the codes).
constexpr double slowest_rate = 0.9;
constexpr double rate_memory = 0.9;       // what remains of the last rate in the present one
constexpr double roundoff_units = 100;    // of ε: an update of this size relative to the predictor is roundoff
constexpr double large_stiffness = 10;    // c ‖J‖ above which an old Jacobian may do harm
constexpr double tolerated_noise = 0.01;  // of c J: the rate that it costs Newton's iteration
constexpr double noise_growth = 100;      // of |c|, after which a J that may be roundoff is taken anew

}  // namespace

void Convergence::begin(double rtol, double roundoff) {
  rtol_ = rtol;
  roundoff_ = roundoff;
  iteration_ = 0;
}

Convergence::Verdict Convergence::judge(double size) {
  ++iteration_;
  if (!std::isfinite(size)) return Verdict::diverged;
  if (size <= roundoff_) return Verdict::converged;
  if (iteration_ == 1) {
    if (rate_known_ && size * rate_ / (1 - rate_) <= rules_.first_goal * rtol_) return Verdict::converged;
    if (!rate_known_) rate_ = 0;
  } else {
    if (size > slowest_rate * previous_) return Verdict::diverged;
    rate_ = std::max(rate_memory * rate_, size / previous_);
    rate_known_ = true;
    const double left = size * rate_ / (1 - rate_);
    if (left <= rules_.goal * rtol_) return Verdict::converged;
    if (left * std::pow(rate_, rules_.most_iterations - iteration_) > rules_.goal * rtol_) return Verdict::diverged;
  }
  previous_ = size;
  return iteration_ < rules_.most_iterations ? Verdict::go_on : Verdict::diverged;
}

// -------------------------------------------------------------------------------------------------- f and its Jacobian

AgingJacobian::AgingJacobian(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : f_(f),
      weights_(weights),
      jacobian_(*linear.jacobian),
      mass_(linear.mass),
      undefined_f_(weights.size()),
      scratch_(weights.size()) {}

void AgingJacobian::forget() {
  factored_ = 0;
  renew_ = false;
  noisy_ = false;
}

Outcome AgingJacobian::evaluate(double t, const double* y, double* out) {
  const std::size_t n = weights_.size();
  undefined_ = false;
  if (!all_finite(y, n)) return Outcome::not_finite;
  if (f_(t, y, out) == Status::stop) return Outcome::stop;
  if (all_finite(out, n)) return Outcome::ok;
  std::copy(out, out + n, undefined_f_.begin());
  undefined_ = true;
  return Outcome::not_finite;
}

int AgingJacobian::undefined_component() const {
  if (!undefined_) return -1;
  for (std::size_t i = 0; i < undefined_f_.size(); ++i)
    if (!std::isfinite(undefined_f_[i])) return static_cast<int>(i);
  return -1;
}

Status AgingJacobian::take_jacobian(double t, const double* y, const double* slope) {
  factored_ = 0;
  first_c_ = 0;
  renew_ = false;
  current_ = true;
  age_ = 0;
  return jacobian_.evaluate(f_, t, y, slope);
}

Status AgingJacobian::repair(double t, const double* y, const double* slope) {
  if (!renew_) return Status::ok;
  if (slope == nullptr) {
    slope = scratch_.data();
    if (jacobian_.needs_slope() && evaluate(t, y, scratch_.data()) == Outcome::stop) return Status::stop;
  }
  return take_jacobian(t, y, slope);
}

bool AgingJacobian::renew_if_old() {
  jacobian_.doubt();
  return !current_ && renew();
}

bool AgingJacobian::renew() {
  if (jacobian_.kind() == Jacobian::Kind::constant) return false;
  return renew_ = true;
}

/// Roundoff in J that looks like stiffness damps the updates: the iteration converges, to what does not solve the
/// equations. Where it has counted once (components that start at 0 cause it), J is taken anew, with wide increments,
/// as |c| grows: those of the first steps, with y tiny still, are not good enough for long ones.
void AgingJacobian::renew_if_noise(double c) {
  if (current_) return;
  c = std::abs(c);
  if (noisy_ ? c < noise_growth * first_c_ : c * jacobian_.noise() <= tolerated_noise) return;
  noisy_ = true;
  jacobian_.widen_increments();
  renew();
}

void AgingJacobian::step_accepted() {
  current_ = false;
  ++age_;
}

/// Whether the values of M(t) are finite, which are looked at where M is a function.
bool AgingJacobian::defined_mass() {
  work_.undefined_mass =
      mass_ && !mass_->constant() && !all_finite(mass_->matrix().values.data(), mass_->matrix().values.size());
  return !work_.undefined_mass;
}

/// Forgets the factors at hand if they are not those for c.
bool AgingJacobian::needs_factors(double c) {
  if (c == factored_) return false;
  if (first_c_ == 0) first_c_ = std::abs(c);
  factored_ = 0;
  work_.undefined_jacobian = !all_finite(jacobian().values.data(), jacobian().values.size());
  return true;
}

Outcome AgingJacobian::factored(double c, double t1, bool regular) {
  work_.singular = !regular;
  if (work_.singular) return Outcome::not_finite;
  factored_ = c;
  factored_at_ = t1;
  return Outcome::ok;
}

bool AgingJacobian::stiff(double c, const double* w) {
  if (mass_) return true;
  std::fill(scratch_.begin(), scratch_.end(), 0);
  jacobian().for_each([&](std::size_t i, std::size_t j, double value) { scratch_[i] += std::abs(value) * w[j]; });
  MaxNorm norm;
  for (std::size_t i = 0; i < scratch_.size(); ++i) norm.add(scratch_[i] / w[i]);
  return norm.value() * std::abs(c) > large_stiffness;
}

void AgingJacobian::fields(Archive& archive) {
  jacobian_.state(archive);
  jacobian_.matrix_state(archive);
  archive(work_.factorizations, work_.solves, factored_, factored_at_, first_c_, noisy_, current_, renew_, age_);
}

LinearWork AgingJacobian::work() const {
  LinearWork work = work_;
  work.jacobians = jacobian_.count();
  work.complex_calls = jacobian_.complex_calls();
  work.left_complex_steps = jacobian_.left_complex_steps();
  work.enlargements = jacobian_.enlargements();
  work.entries = static_cast<std::int64_t>(jacobian().rows.size());
  work.groups = static_cast<std::int64_t>(jacobian_.groups());
  return work;
}

Outcome InitialSlopes::first(AgingJacobian& jacobian, double t, const double* y, const double* w, double* f,
                             double* slope) {
  if (const Outcome outcome = jacobian.evaluate(t, y, f); outcome != Outcome::ok) return outcome;
  if (jacobian.take_jacobian(t, y, f) == Status::stop) return Outcome::stop;
  std::copy(f, f + jacobian.jacobian().n(), slope);
  Mass* mass = jacobian.mass();
  if (!mass) return Outcome::ok;
  if (mass->evaluate(t) == Status::stop) return Outcome::stop;
  if (!solver_.factor(*mass, jacobian.jacobian(), w, lapack_)) {
    jacobian.note_singular();
    return Outcome::not_finite;
  }
  solver_.slope(*mass, nullptr, slope);
  return Outcome::ok;
}

/// M y'' = f_t + J y'
Status InitialSlopes::second(AgingJacobian& jacobian, double t, const double* y, double h, const double* f,
                             double* slope, double* ft, double* second) {
  const std::size_t n = jacobian.jacobian().n();
  const Mass* mass = jacobian.mass();
  if (time_derivative(f_, t, y, f, h, n, ft) == Status::stop) return Status::stop;
  if (mass && mass->singular()) {
    std::copy(f, f + n, slope);
    solver_.slope(*mass, ft, slope);
  }
  jacobian.jacobian().multiply(slope, second);
  for (std::size_t i = 0; i < n; ++i) second[i] += ft[i];
  if (mass) solver_.slope(*mass, nullptr, second);
  return Status::ok;
}

// ----------------------------------------------------------------------------------------------- one implicit equation

Newton::Newton(Callback& f, const Weights& weights, const LinearAlgebra& linear, const Convergence::Rules& rules)
    : AgingJacobian(f, weights, linear),
      weights_(weights),
      lu_(make_factorization(jacobian().structure, linear.lapack)),
      convergence_(rules),
      f_value_(weights.size()),
      residual_(weights.size()),
      sum_(weights.size()) {}

void Newton::restart() {
  forget();
  convergence_.forget();
}

Outcome Newton::prepare(double c, double t1) {
  return AgingJacobian::prepare(c, t1, [&] {
    count_factorization();
    convergence_.forget();
    return lu_->factor(mass_matrix(), c, jacobian());
  });
}

Newton::Result Newton::solve(double c, double t1, const double* p, const double* psi, const double* w, double* d,
                             double* y) {
  const std::size_t n = weights_.size();
  const auto norm = [&](const double* v) { return max_norm(n, [v, w](std::size_t i) { return v[i] / w[i]; }); };
  std::fill(d, d + n, 0);
  std::copy(p, p + n, y);
  convergence_.begin(weights_.rtol(), roundoff_units * eps * norm(p));
  for (;;) {
    switch (evaluate(t1, y, f_value_.data())) {
      case Outcome::stop: return Result::stop;
      case Outcome::not_finite: return Result::failed;
      case Outcome::ok: break;
    }
    residual(c, psi, d);
    count_solve();
    lu_->solve(residual_.data());
    const double size = norm(residual_.data());
    for (std::size_t i = 0; i < n; ++i) {
      d[i] += residual_[i];
      y[i] = p[i] + d[i];
    }
    switch (convergence_.judge(size)) {
      case Convergence::Verdict::converged: return Result::converged;
      case Convergence::Verdict::diverged: return Result::failed;
      case Convergence::Verdict::go_on: break;
    }
  }
}

void Newton::state(Archive& archive) {
  convergence_.state(archive);
  AgingJacobian::state(archive, [this](double c) { return lu_->factor(mass_matrix(), c, jacobian()); });
}

void Newton::damp(double* v) {
  if (const Matrix* M = mass_matrix()) {
    std::copy(v, v + sum_.size(), sum_.begin());
    M->multiply(sum_.data(), v);
  }
  count_solve();
  lu_->solve(v);
}

/// c f − M (ψ + d), with f at hand.
void Newton::residual(double c, const double* psi, const double* d) {
  for (std::size_t i = 0; i < sum_.size(); ++i) sum_[i] = psi[i] + d[i];
  if (mass_matrix())
    mass_matrix()->multiply(sum_.data(), residual_.data());
  else
    std::swap(sum_, residual_);
  for (std::size_t i = 0; i < sum_.size(); ++i) residual_[i] = c * f_value_[i] - residual_[i];
}

}  // namespace invariode
