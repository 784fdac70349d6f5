#include "methods/newton.hpp"
#include "methods/initial_step.hpp"

#include <algorithm>
#include <bit>
#include <cassert>
#include <cmath>
#include <utility>

namespace invariode {
namespace {

constexpr double rate_memory = 0.9;        // what remains of the last rate in the present one (the suite's constant)
constexpr double least_first_rate = 1e-3;  // of convergence, by which a first update is judged: see `judge`
constexpr double tolerated_noise = 0.01;   // of c J: the rate that it costs Newton's iteration
constexpr double noise_growth = 100;       // of |c|, after which a J that may be roundoff is taken anew

// What residuals may say that an iteration has left, in units of the goal that its updates have to reach, and a part of
// a residual that is as good as nothing. (The old Jacobians of HIRES, whose counts are published, leave 56 of it at
// 1e-6, by iterations that remove 6 % of a residual.)
constexpr double most_left = 60, hardly = 0.03;
// Where an iteration had converged that solved nothing, the next steps may leave so much less, in more iterations.
constexpr int most_full_iterations = 25;
constexpr int careful_steps = 10, careful_iterations = 20;
constexpr double careful_part = 1e-3;

// Matrix-free (Brown & Hindmarsh, 1989, and CVODE's defaults).
constexpr double tolerated_change = 0.3;  // of c, with a preconditioner, or sparse factors, for the old one
constexpr std::size_t fewest_kept = 200;  // rows of such factors: those of smaller matrices cost no more than a step
constexpr int old_preconditioner = 20;    // steps

constexpr double most_roundoff = Convergence::roundoff_units * eps;  // of vectors whose norm is at most 1

}  // namespace

void Convergence::begin(double rtol, bool careful) {
  rtol_ = careful ? careful_part * rtol : rtol;
  most_iterations_ = careful ? careful_iterations : rules_.most_iterations;
  iteration_ = 0;
}

/// A first update is judged by the rate from before. That may have been roundoff, where f was linear, and then says
/// nothing of an update that leads far away, such as into the range of an exponential.
Convergence::Verdict Convergence::judge(double size, double roundoff) {
  ++iteration_;
  if (!std::isfinite(size)) return Verdict::diverged;
  if (size <= roundoff) return Verdict::converged;
  if (iteration_ == 1) {
    const double rate = std::max(rate_, least_first_rate);
    if (rate_known_ && size * rate / (1 - rate) <= rules_.first_goal * rtol_) return Verdict::converged;
    if (!rate_known_) rate_ = 0;
  } else if (size > slowest_rate * previous_) {
    if (size > rules_.jump_goal * rtol_) return Verdict::diverged;
  } else {
    rate_ = std::max(rate_memory * rate_, size / previous_);
    rate_known_ = true;
    double left = size * rate_ / (1 - rate_);
    if (left <= rules_.goal * rtol_) return Verdict::converged;
    for (int k = iteration_; k < most_iterations_; ++k) left *= rate_;
    if (left > rules_.goal * rtol_) return Verdict::diverged;
  }
  previous_ = size;
  return iteration_ < most_iterations_ ? Verdict::go_on : Verdict::diverged;
}

void Convergence::settle(double size) {
  rate_ = std::max(rate_memory * rate_, std::min(size / previous_, slowest_rate));
  rate_known_ = true;
}

bool unmoved(std::span<const double> before, const double* after, const double* w, double least, double part) {
  MaxNorm first, left, moved;
  for (std::size_t i = 0; i < before.size(); ++i) {
    if (before[i] == 0) continue;
    first.add(before[i] / w[i]);
    left.add(after[i] / w[i]);
    moved.add((after[i] - before[i]) / w[i]);
  }
  return left.value() > least && moved.value() <= part * first.value();
}

// -------------------------------------------------------------------------------------------------- f and its Jacobian

AgingJacobian::AgingJacobian(Callback& f, const Weights& weights, const LinearAlgebra& linear, bool complex)
    : jacobian_(*linear.jacobian),
      system_(f, weights, linear, jacobian_),
      mass_(linear.mass),
      scratch_(linear.krylov ? 0 : system_.state().size()) {
  if (linear.krylov)
    free_.emplace(system_.state_f(), system_.state_weights(), linear, complex);
  else
    audit_.emplace(jacobian_, system_.state_f(), system_.state_weights());
}

void AgingJacobian::forget() {
  if (free_) free_->forget_failures();
  if (audit_) audit_->start();
  cache_.forget();
  age_.start();
  noisy_ = false;
  careful_ = 0;
}

Status AgingJacobian::take_jacobian(double t, const double* y, const double* slope) {
  cache_.forget_jacobian();
  age_.take();
  Callback& f = system_.state_f();
  if (audit_) audit_->begin(t, y);
  if (age_.plain()) return jacobian_.evaluate_plainly(f, t, y, slope);
  if (jacobian_.evaluate(f, t, y, slope) == Status::stop) return Status::stop;
  return audit_ ? audit_->look(t, y, slope) : Status::ok;
}

Status AgingJacobian::multiply(double t, const double* y, const double* slope, const double* v, double* out) {
  if (free_) {
    free_->product().at(t, y, slope);
    return free_->product().multiply(v, out);
  }
  jacobian().multiply(v, out);
  return Status::ok;
}

Status AgingJacobian::repair(double t, const double* y, const double* slope) {
  if (free_) {
    free_->begin_attempt();
    free_->reach(t, y);
    if (age_.steps() >= old_preconditioner) renew();
  }
  if (!age_.renewal_due()) return Status::ok;
  if (slope == nullptr) {
    slope = scratch_.data();
    if (!jacobian_.needs_slope()) return take_jacobian(t, y, nullptr);
    if (system_.evaluate(system_.state(), t, y, scratch_.data()) == Outcome::stop) return Status::stop;
  }
  return take_jacobian(t, y, slope);
}

void AgingJacobian::be_careful() { careful_ = careful_steps; }

bool AgingJacobian::may_take_in_place() const {
  return age_.taken() != JacobianAge::Taken::at_iterate && jacobian_.kind() != Jacobian::Kind::constant;
}

Status AgingJacobian::take_in_place(double t, const double* y, const double* slope) {
  age_.begin_at_iterate();
  return take_jacobian(t, y, slope);
}

bool AgingJacobian::renew_if_old() {
  jacobian_.doubt();
  return age_.fail(renewable(), jacobian_.adapted());
}

bool AgingJacobian::renewable() const {
  return jacobian_.kind() != Jacobian::Kind::constant && (!free_ || free_->preconditioned());
}

/// Roundoff in J that looks like stiffness damps the updates: the iteration converges, to what does not solve the
/// equations. Where it has counted once (components that start at 0 cause it), J is taken anew, with wide increments,
/// as |c| grows: those of the first steps, with y tiny still, are not good enough for long ones.
void AgingJacobian::renew_if_noise(double c) {
  if (age_.current()) return;
  c = std::abs(c);
  const std::optional<double>& first_c = cache_.first_c();
  if (noisy_ ? first_c && c < noise_growth * *first_c : c * jacobian_.noise() <= tolerated_noise) return;
  noisy_ = true;
  jacobian_.widen_increments();
  renew();
}

void AgingJacobian::step_accepted() {
  if (free_) free_->forget_failures();
  age_.accept_step();
  careful_ = std::max(careful_ - 1, 0);
}

/// Returns whether the values of M(t) are finite, which are tested where M is a function.
bool AgingJacobian::defined_mass() {
  work_.undefined_mass =
      mass_ && !mass_->constant() && !all_finite(mass_->matrix().values.data(), mass_->matrix().values.size());
  return !work_.undefined_mass;
}

bool AgingJacobian::needs_factors(double c, double tolerated) {
  if (cache_.serves(c, tolerated)) return false;
  work_.undefined_jacobian = !all_finite(jacobian().values.data(), jacobian().values.size());
  return true;
}

Outcome AgingJacobian::factored(double c, double t1, bool regular) {
  work_.singular = !regular;
  if (work_.singular) return Outcome::not_finite;
  cache_.made(c, t1);
  return Outcome::ok;
}

Outcome AgingJacobian::prepare_preconditioner(double c, double t1) {
  bool stopped = false;
  const auto set_up = [&] {
    if (free_->preconditioned()) count_factorization();
    age_.set_up();
    stopped = free_->set_up(c) == Status::stop;
    return true;
  };
  const Outcome outcome = prepare(c, t1, set_up, tolerated_change);
  return stopped ? Outcome::stop : outcome;
}

bool AgingJacobian::set_up_again(double c, Archive& archive) {
  if (free_->set_up_again(c) == Status::stop) archive.stop();
  return true;
}

bool AgingJacobian::forget_sensitivity_roundoff(double c, const double* Y, double* v) {
  if (free_) return false;
  const Part sensitivities = system_.coupled(system_.sensitivities());
  const std::size_t n = scratch_.size();
  for (const std::size_t block : sensitivities) {
    const double* S = Y + block;
    for (std::size_t i = 0; i < n; ++i) scratch_[i] = std::abs(S[i]);
    jacobian().for_each([&](std::size_t i, std::size_t j, double value) { scratch_[i] += std::abs(c * value * S[j]); });
    for (std::size_t i = 0; i < n; ++i)
      if (std::abs(v[block + i]) <= Convergence::roundoff_units * eps * scratch_[i]) v[block + i] = 0;
  }
  return !sensitivities.empty();
}

bool AgingJacobian::stiff(double c, const double* w) {
  if (mass_) return true;
  if (free_) return false;  // J is never an old one
  std::fill(scratch_.begin(), scratch_.end(), 0);
  jacobian().for_each([&](std::size_t i, std::size_t j, double value) { scratch_[i] += std::abs(value) * w[j]; });
  MaxNorm norm;
  for (std::size_t i = 0; i < scratch_.size(); ++i) norm.add(scratch_[i] / w[i]);
  return norm.value() * std::abs(c) > JacobianAudit::large_stiffness;
}

void AgingJacobian::fields(Archive& archive) {
  jacobian_.state(archive);
  jacobian_.matrix_state(archive);
  if (free_) free_->state(archive);
  if (audit_) audit_->state(archive);
  cache_.state(archive);
  age_.state(archive);
  archive(work_.factorizations, work_.solves, noisy_, careful_);
  archive.require(careful_ >= 0);
}

LinearWork AgingJacobian::work() const {
  LinearWork work = work_;
  work.jacobians = jacobian_.count();
  work.misfit = audit_ && audit_->misfit() ? audit_->misfit() : jacobian_.misfit();
  work.checks = audit_ ? audit_->evaluations() : 0;
  if (free_) {
    work.products = free_->products();
    work.iterations = free_->iterations();
    work.unsolved = free_->unsolved();
    work.unsolved_t = free_->unsolved_t();
  }
  work.complex_calls = jacobian_.complex_calls();
  work.abandoned_complex_steps = jacobian_.abandoned_complex_steps();
  work.enlargements = jacobian_.enlargements();
  work.entries = static_cast<std::int64_t>(jacobian().rows.size());
  work.groups = static_cast<std::int64_t>(jacobian_.groups());
  return work;
}

Outcome InitialSlopes::first(AgingJacobian& jacobian, double t, const double* y, double* f, double* slope) {
  if (const Outcome outcome = jacobian.evaluate(t, y, f); outcome != Outcome::ok) return outcome;
  if (jacobian.take_jacobian(t, y, f) == Status::stop) return Outcome::stop;
  const Part all = jacobian.system().all();
  std::copy(f, f + all.size(), slope);
  Mass* mass = jacobian.mass();
  if (!mass) return Outcome::ok;
  if (mass->evaluate(t) == Status::stop) return Outcome::stop;
  if (!solver_.factor(*mass, jacobian.jacobian(), lapack_)) {
    jacobian.note_singular();
    return Outcome::not_finite;
  }
  for (const std::size_t block : jacobian.system().coupled(all)) solver_.slope(*mass, nullptr, slope + block);
  return Outcome::ok;
}

/// M y'' = f_t + J y'; of sensitivities f_t is what changes in their slopes but for S. A product that is not finite is
/// left out: the attempts will tell whether it matters.
Status InitialSlopes::second(AgingJacobian& jacobian, double t, const double* y, double h, const double* f,
                             double* slope, double* ft, double* second) {
  BlockSystem& system = jacobian.system();
  const Part coupled = system.coupled(system.all());
  const std::size_t all = system.all().size();
  const Mass* mass = jacobian.mass();
  const bool singular = mass && mass->singular();
  if (jacobian.time_derivative(t, y, f, h, ft) == Status::stop) return Status::stop;
  if (singular) {
    std::copy(f, f + all, slope);
    solver_.slope(*mass, ft, slope);
  }
  if (system.sensitivity_rate(t, y, slope, f, h, ft) == Status::stop) return Status::stop;
  if (singular)
    for (const std::size_t block : system.coupled(system.sensitivities()))
      solver_.slope(*mass, ft + block, slope + block);
  std::fill(second, second + all, 0);
  for (const std::size_t block : coupled) {
    if (jacobian.multiply(t, y, f, slope + block, second + block) == Status::stop) return Status::stop;
    if (jacobian.matrix_free() && !all_finite(second + block, coupled.n)) std::fill_n(second + block, coupled.n, 0);
  }
  for (std::size_t i = 0; i < all; ++i) second[i] += ft[i];
  if (mass)
    for (const std::size_t block : coupled) solver_.slope(*mass, nullptr, second + block);
  return Status::ok;
}

/// Evaluates f at t + δ along y'. If M is singular, that shows the rates at which the algebraic variables leave y, and
/// f along these what they do to the others.
Status InitialSlopes::beside(AgingJacobian& jacobian, double t, const double* y, double delta, const double* f,
                             const double* slope, double* rates, double* quotient) {
  const Part blocks = jacobian.system().all();
  const std::size_t all = blocks.size();
  const Mass* mass = jacobian.mass();
  std::vector<double> point(all), slopes(slope, slope + all);
  std::fill(rates, rates + all, 0);
  const auto evaluate = [&jacobian](double at, const double* Y, double* out) { return jacobian.evaluate(at, Y, out); };
  for (int looks = mass && mass->singular() ? 2 : 1; looks > 0; --looks) {
    switch (quotient_along(t, y, slopes.data(), f, delta, all, point.data(), quotient, evaluate)) {
      case Outcome::stop: return Status::stop;
      case Outcome::not_finite:
        std::fill(quotient, quotient + all, std::numeric_limits<double>::quiet_NaN());
        return Status::ok;
      case Outcome::ok: break;
    }
    if (looks == 1) break;
    std::copy(f, f + all, slopes.data());
    for (const std::size_t block : blocks) solver_.slope(*mass, quotient + block, slopes.data() + block);
    for (std::size_t i = 0; i < all; ++i) rates[i] = slopes[i] - slope[i];
  }
  if (mass)
    for (const std::size_t block : blocks) solver_.slope(*mass, nullptr, quotient + block);
  return Status::ok;
}

// ----------------------------------------------------------------------------------------------- one implicit equation

Newton::Newton(Callback& f, const Weights& weights, const LinearAlgebra& linear, const Convergence::Rules& rules)
    : AgingJacobian(f, weights, linear),
      weights_(weights),
      lu_(linear.krylov ? nullptr : make_factorization(jacobian().structure, linear.lapack)),
      convergence_(rules),
      sensitivity_convergence_(rules.for_sensitivities()),
      f_value_(weights.size()),
      residual_(weights.size()),
      sum_(weights.size()),
      before_(linear.krylov ? 0 : system().state().size()),
      earlier_(before_.size()),
      sensitivity_weight_(linear.blocks ? weights.size() : 0) {}

void Newton::keep_factors() {
  const Structure& J = jacobian().structure;
  keeps_factors_ =
      !matrix_free() && !system().has_sensitivities() && J.kind == Structure::Kind::sparse && J.n >= fewest_kept;
}

bool Newton::forget_other_factors() {
  if (!keeps_factors_ || !has_factors() || factored_for() == place_.c) return false;
  forget_factors();
  return true;
}

void Newton::restart() {
  forget();
  convergence_.forget();
  sensitivity_convergence_.forget();
  last_c_.reset();
  fully_ = false;
}

Outcome Newton::prepare(double c, double t1) {
  if (matrix_free()) {
    if (c != last_c_) convergence_.forget();  // the preconditioner may be one for another c, GMRES solves for this one
    last_c_ = c;
    return prepare_preconditioner(c, t1);
  }
  if (keeps_factors_ && c != last_c_) convergence_.forget();
  last_c_ = c;
  const auto factor = [&] {
    convergence_.forget();
    sensitivity_convergence_.forget();
    const bool regular = lu_->factor(mass_matrix(), c, jacobian());
    count_factorization();  // unless it was given up
    return regular;
  };
  return AgingJacobian::prepare(c, t1, factor, keeps_factors_ ? tolerated_change : 0);
}

Newton::Result Newton::solve(double c, double t1, const double* p, const double* psi, const double* w, double* d,
                             double* y) {
  assert(c != 0 && std::isfinite(c));
  place_ = {c, t1, y, w};
  const Result result = fully_ ? solve_fully(p, psi, d, y) : solve_state(p, psi, d, y);
  if (result != Result::converged || !system().has_sensitivities()) return result;
  return solve_sensitivities(p, psi, d, y);
}

void Newton::step_accepted() {
  AgingJacobian::step_accepted();
  fully_ = false;
}

bool Newton::iterate_fully() {
  if (fully_ || matrix_free() || jacobian().values.empty() || !has_factors()) return false;
  return fully_ = renew();
}

/// f of the state at the iterate.
Newton::Result Newton::evaluate_state() {
  return newton_result(system().evaluate(system().state(), place_.t, place_.y, f_value_.data()));
}

double Newton::norm_in_attempt(const double* v) const {
  return max_norm(system().state().size(), [v, w = place_.w](std::size_t i) { return v[i] / w[i]; });
}

/// The iteration begins at the prediction, y = p and d = 0.
void Newton::begin_iteration(const double* p, double* d, double* y) {
  const std::size_t n = system().state().size();
  std::fill(d, d + n, 0);
  std::copy(p, p + n, y);
  convergence_.begin(weights_.rtol(), careful());
}

/// The size of an update of p that is roundoff, at most `most_roundoff`: no weight is below |p|.
double Newton::roundoff(const double* p) const { return most_roundoff * norm_in_attempt(p); }

/// Newton's iteration as it is in the books. What it converges to from p is a solution however J changes between.
Newton::Result Newton::solve_fully(const double* p, const double* psi, double* d, double* y) {
  const auto [c, t1, place_y, w] = place_;
  const std::size_t n = system().state().size();
  const auto norm = [&](const double* v) { return norm_in_attempt(v); };
  begin_iteration(p, d, y);
  for (int k = 0; k < most_full_iterations; ++k) {
    Result result = evaluate_state();
    if (result == Result::converged && take_in_place(t1, y, f_value_.data()) == Status::stop) result = Result::stop;
    if (result == Result::converged) result = newton_result(prepare(c, t1));
    if (result != Result::converged) return result;
    residual(system().state(), psi, d);
    lu_->solve(residual_.data());
    count_solve();
    const double size = norm(residual_.data());
    for (std::size_t i = 0; i < n; ++i) {
      d[i] += residual_[i];
      y[i] = p[i] + d[i];
    }
    if (size <= std::max(convergence_.goal(), roundoff(p))) return Result::converged;
  }
  return Result::failed;
}

Newton::Result Newton::solve_state(const double* p, const double* psi, double* d, double* y) {
  const auto [c, t1, place_y, w] = place_;
  const std::size_t n = system().state().size();
  const auto norm = [&](const double* v) { return norm_in_attempt(v); };
  begin_iteration(p, d, y);
  const double tolerance = matrix_free() ? std::max(linear_part * convergence_.goal(), roundoff(p)) : 0;
  for (;;) {
    if (const Result evaluated = evaluate_state(); evaluated != Result::converged) return evaluated;
    residual(system().state(), psi, d);
    if (!matrix_free()) {
      before_.swap(earlier_);
      std::copy_n(residual_.begin(), n, before_.begin());
    }
    if (const Result ready = newton_result(precondition(residual_.data())); ready != Result::converged) return ready;
    if (matrix_free() && convergence_.iterations() > 0 && matrix_free()->negligible(w, tolerance, residual_.data())) {
      convergence_.settle(tolerance);
      return Result::converged;
    }
    if (const Result solved = solve_linear(tolerance, residual_.data()); solved != Result::converged) return solved;
    const double size = norm(residual_.data());
    for (std::size_t i = 0; i < n; ++i) {
      d[i] += residual_[i];
      y[i] = p[i] + d[i];
    }
    switch (convergence_.judge(size, size > most_roundoff ? 0 : roundoff(p))) {
      case Convergence::Verdict::converged:
        if (const Result confirmed = confirm(psi, d, size); confirmed != Result::failed) return confirmed;
        if (const Result renewed = renew_in_place(); renewed != Result::converged) return renewed;
        convergence_.begin(weights_.rtol(), careful());
        break;
      case Convergence::Verdict::diverged:
        if (convergence_.iterations() > 1 && unmoved(earlier_, before_.data(), w, 0)) note_too_large();
        return Result::failed;
      case Convergence::Verdict::go_on: break;
    }
  }
}

/// The slopes are linear in S: J is what alone may be too old, and the state's iteration has shown that it is not. The
/// first update of quadratures is exact.
Newton::Result Newton::solve_sensitivities(const double* p, const double* psi, double* d, double* y) {
  const Part part = system().sensitivities();
  const std::size_t n = part.first, all = part.stop;
  system().sensitivity_weights().fill(p,
                                      sensitivity_weight_.data());  // y still holds what an earlier attempt left there
  const double* w = sensitivity_weight_.data();
  const auto norm = [&](const double* v) {
    return max_norm(all - n, [&](std::size_t i) { return v[n + i] / w[n + i]; });
  };
  std::fill(d + n, d + all, 0);
  std::copy(p + n, p + all, y + n);
  sensitivity_convergence_.begin(weights_.rtol());
  if (const Result ready = look_at_product(); ready != Result::converged) return ready;
  for (;;) {
    const Result evaluated = newton_result(system().evaluate(part, place_.t, y, f_value_.data()));
    if (evaluated != Result::converged) return evaluated;
    residual(part, psi, d);
    if (const Result solved = solve_columns(sensitivity_convergence_.goal(), residual_.data());
        solved != Result::converged)
      return solved;
    const double size = norm(residual_.data());
    for (std::size_t i = n; i < all; ++i) {
      d[i] += residual_[i];
      y[i] = p[i] + d[i];
    }
    if (system().coupled(part).empty()) return Result::converged;
    switch (sensitivity_convergence_.judge(size, size > most_roundoff ? 0 : most_roundoff * norm(p))) {
      case Convergence::Verdict::converged: return Result::converged;
      case Convergence::Verdict::diverged: return Result::failed;
      case Convergence::Verdict::go_on: break;
    }
  }
}

/// J of matrix-free columns is that of the state where its iteration has ended, one f on from where f is known.
Newton::Result Newton::look_at_product() {
  if (!matrix_free()) return Result::converged;
  if (!matrix_free()->product().given())
    if (const Result evaluated = evaluate_state(); evaluated != Result::converged) return evaluated;
  matrix_free()->product().at(place_.t, place_.y, f_value_.data());
  return Result::converged;
}

/// The blocks of b behind the state become solutions. By GMRES each alone, in its own weights, about as far as `goal`
/// lets the iteration end, with J where `product()` is.
Newton::Result Newton::solve_columns(double goal, double* b) {
  const Part sensitivities = system().sensitivities();
  if (!matrix_free()) {
    solve_blocks(*lu_, b, sensitivities);
    return Result::converged;
  }
  for (const std::size_t block : system().coupled(sensitivities)) {
    count_solve();
    const double* w = sensitivity_weight_.data() + block;
    if (const Result ready = newton_result(precondition(b + block)); ready != Result::converged) return ready;
    const Result solved =
        newton_result(matrix_free()->solve(place_.c, mass_matrix(), w, linear_part * goal, b + block));
    if (solved != Result::converged) return solved;
  }
  return Result::converged;
}

/// Updates say that the iteration has converged. Do its residuals, of an update of that size? J of another branch of f
/// may be so much too large that updates are too small to show that nothing is solved. What is not stiff cannot be:
/// there the solution is not farther off than its residual.
Newton::Result Newton::confirm(const double* psi, const double* d, double size) {
  if (matrix_free() || mass() != nullptr) return Result::converged;
  const double before = norm_in_attempt(before_.data());
  if (before <= tolerated_residual()) return Result::converged;
  const bool slow = convergence_.iterations() > 1 && !solved(size, norm_in_attempt(earlier_.data()), before);
  if (!slow && !stiff(place_.c, place_.w)) return Result::converged;
  switch (audit()->evaluate(place_.t, place_.y, f_value_.data())) {
    case Outcome::stop: return Result::stop;
    case Outcome::not_finite: return slow ? Result::failed : Result::converged;
    case Outcome::ok: break;
  }
  residual(system().state(), psi, d);
  const bool stuck = unmoved(before_, residual_.data(), place_.w, tolerated_residual(), hardly);
  if (!slow && !stuck && solved(size, before, norm_in_attempt(residual_.data()))) return Result::converged;
  for (std::size_t i = 0; i < before_.size(); ++i) residual_[i] -= before_[i];
  const Result result = doubt(norm_in_attempt(residual_.data()) <= JacobianAudit::large_stiffness * size);
  if (result == Result::failed && stuck) be_careful();
  return result;
}

/// Residuals contradict the updates. As long as f is smooth and stiff this is left to the rule of the suite, whose
/// steps are published: what is left of the solution is much less than the residual. `soft`: f is not stiff along the
/// update.
Newton::Result Newton::doubt(bool soft) {
  using Fitness = JacobianAudit::Fitness;
  switch (audit()->examine(place_.c, place_.t, place_.y, before_.data(), place_.w)) {
    case Fitness::stop: return Result::stop;
    case Fitness::of_another_branch: return Result::failed;
    case Fitness::stiffness_has_gone: return soft ? Result::failed : Result::converged;
    case Fitness::fits: break;
  }
  return Result::converged;
}

/// Returns whether an update of that size, after a residual of the size `last` and before one of the size `residual`,
/// leaves little.
bool Newton::solved(double size, double last, double residual) const {
  return left_by(size, residual / last, residual) <= tolerated_residual();
}

double Newton::tolerated_residual() const { return most_left * convergence_.goal(); }

/// J and the factors at the iterate, once in a step: f has the branch there that it has at the solution, or nearly.
Newton::Result Newton::renew_in_place() {
  if (!may_take_in_place()) return Result::failed;
  const Result evaluated = evaluate_state();
  if (evaluated != Result::converged) return evaluated;
  if (take_in_place(place_.t, place_.y, f_value_.data()) == Status::stop) return Result::stop;
  return newton_result(prepare(place_.c, place_.t));
}

Outcome Newton::precondition(double* b) { return matrix_free() ? matrix_free()->precondition(b) : Outcome::ok; }

/// b, preconditioned, becomes the solution; matrix-free with J at the place, where f is at hand.
Newton::Result Newton::solve_linear(double tolerance, double* b) {
  count_solve();
  if (!matrix_free()) {
    assert(has_factors());
    lu_->solve(b);
    if (keeps_factors_) correct_for_c(b);
    return Result::converged;
  }
  matrix_free()->product().at(place_.t, place_.y, f_value_.data());
  return newton_result(matrix_free()->solve(place_.c, mass_matrix(), place_.w, tolerance, b));
}

/// The factors are those for another c': for stiff components the solution is too large by c/c', for others it is
/// right; the factor between, which is that of CVODE, leaves the same part of either in error.
void Newton::correct_for_c(double* b) const {
  const double factor = 2 / (1 + place_.c / factored_for());
  for (std::size_t i = 0; i < system().state().size(); ++i) b[i] *= factor;
}

void Newton::state(Archive& archive) {
  convergence_.state(archive);
  sensitivity_convergence_.state(archive);
  if (matrix_free() || keeps_factors_) archive(last_c_);
  AgingJacobian::state(archive, [&](double c) {
    return matrix_free() ? set_up_again(c, archive) : lu_->factor(mass_matrix(), c, jacobian());
  });
}

Newton::Result Newton::damp(double* v) {
  if (const Matrix* M = mass_matrix()) {
    std::copy(v, v + sum_.size(), sum_.begin());
    system().multiply_mass(*M, sum_.data(), v);
  }
  return filter(v);
}

Newton::Result Newton::filter(double* v) {
  if (!matrix_free()) {
    assert(has_factors());
    solve_blocks(*lu_, v, system().all());
    return Result::converged;
  }
  Result result = newton_result(evaluate(place_.t, place_.y, f_value_.data()));
  if (result == Result::converged) result = newton_result(precondition(v));
  if (result == Result::converged) result = solve_linear(linear_part * weights_.rtol(), v);
  return result == Result::converged ? solve_columns(weights_.rtol(), v) : result;
}

/// c f − M (ψ + d) of a part, with f at hand.
void Newton::residual(const Part& part, const double* psi, const double* d) {
  const Matrix* M = mass_matrix();
  const double c = place_.c;
  const std::size_t first = part.first, end = part.stop;
  const double* f = f_value_.data();
  double* __restrict r = residual_.data();
  if (M == nullptr || system().coupled(part).empty()) {
    for (std::size_t i = first; i < end; ++i) r[i] = c * f[i] - (psi[i] + d[i]);
    return;
  }
  for (std::size_t i = first; i < end; ++i) sum_[i] = psi[i] + d[i];
  for (const std::size_t block : part) M->multiply(sum_.data() + block, r + block);
  for (std::size_t i = first; i < end; ++i) r[i] = c * f[i] - r[i];
}

}  // namespace invariode
