#include "methods/radau.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "methods/runge_kutta.hpp"

namespace invariode {
namespace {

/// The error estimate is O(h^{s+1}).
double estimate_order(const RadauFormula& formula) { return static_cast<double>(formula.stages) + 1; }

// Hairer & Wanner, section IV.8, and their codes RADAU5 and RADAU.
constexpr double safety = 0.9;
constexpr double smallest_factor = 0.2, largest_factor = 8;
constexpr double kept_from = 0.9, kept_up_to = 1.2;  // such a change of h is not worth new factorisations
constexpr double fast_rate = 1e-2;  // rate of convergence with which J is kept (measured in benchmarks/multistep.py)
constexpr double smallest_error = 1e-2;  // of the last step, that the prediction takes
constexpr double halved = 0.5;           // h, where a current Jacobian does not help
constexpr double first_goal = 0.1;       // of the goal of later iterations
constexpr double linear_half = 0.5;      // of the goal, 1/30 rtol or less: what GMRES may leave (benchmarks/krylov.py)
constexpr double left_at_end = 20;       // of a residual at the end of a step, in units of rtol
constexpr double least_growth = 1.6;     // of h, where the estimate is nothing but errors of Newton's iteration

// The order: RADAU's constants, but for the last two, which were measured on the stiff set.
constexpr double rate_to_raise = 0.002, rate_to_lower = 0.8;
constexpr double least_change = 0.8;    // of h, with which the order may rise
constexpr int steps_before_raise = 10;  // steps at a lower order before it may rise again
constexpr double most_growth = 1.5;     // of h, with which the order rises: where h grows faster, no error limits it
constexpr double seven_stages_from = 1e-7;  // rtol: above it 7 stages cost more than they gain

// Parts of the interval in each of which f is seen: formulas of order 5 see it about as often at 1e-6 (test_pulses.py).
constexpr double parts_seen_by_radau = 128;

/// Returns the factor by which the estimate magnifies errors of the increments.
double amplification(const RadauFormula& formula) {
  double sum = 0;
  for (std::size_t stage = 0; stage < formula.stages; ++stage) sum += std::abs(formula.initial_slope[stage]);
  return sum / formula.mu;
}

int most_iterations(const RadauFormula& formula) { return 7 + 5 * (static_cast<int>(formula.stages) - 3) / 2; }

Convergence::Rules newton_rules(const RadauFormula& formula) {
  const double goal = std::pow(safety / least_growth, estimate_order(formula)) / amplification(formula);
  const double first = first_goal * goal;
  return {.most_iterations = most_iterations(formula), .goal = goal, .first_goal = first, .jump_goal = first};
}

const RadauFormula* formula_up_to(int order) {
  const RadauFormula* found = radau_formulas.data();
  for (const RadauFormula& formula : radau_formulas)
    if (formula.order() <= order) found = &formula;
  return found;
}

}  // namespace

Radau::Radau(Callback& f, const Weights& weights, const LinearAlgebra& linear, int max_order)
    : ImplicitBase(f, weights, linear),
      lowest_(radau_formulas.data()),
      highest_(formula_up_to(max_order)),
      formula_(lowest_),
      accepted_(lowest_),
      convergence_(newton_rules(*lowest_)),
      sensitivity_convergence_(newton_rules(*lowest_).for_sensitivities()) {
  polynomial_.resize(highest_->stages * weights.size());
  provide({&f_, &end_f_, &last_y_, &error_vector_, &gap_, &scratch_});
  for (std::vector<double>* v : {&residual_, &earlier_}) v->resize(solver_.system().state().size());
  if (linear.blocks) provide({&sensitivity_weight_});
  if (linear.mass) provide({&slope_});
  if (linear.mass && !linear.mass->constant()) stage_masses_.resize(highest_->stages);
  solver_.take_scratch(candidate_.data(), gap_.data());
}

/// The formula of the next attempt.
void Radau::use(const RadauFormula* formula) {
  formula_ = formula;
  for (std::vector<double>* v : {&increments_, &residuals_}) v->resize(std::max(v->size(), stages() * n()));
  convergence_ = Convergence(newton_rules(*formula));
  sensitivity_convergence_ = Convergence(newton_rules(*formula).for_sensitivities());
  solver_.use(*formula);
}

Outcome Radau::start(double t, const double* y, const Span& span) {
  memory_h_ = last_h_ = 0;
  steps_until_raise_ = 0;
  use(lowest_);
  solver_.forget();
  double* slope = slope_.empty() ? candidate_.data() : slope_.data();
  if (const Outcome outcome = begin(t, y, f_.data(), slope); outcome != Outcome::ok) return outcome;
  return choose_initial_step(span, estimate_order(*formula_), f_.data(), slope, gap_.data(), scratch_.data());
}

Step::Attempt Radau::attempt(double h, double t1) {
  begin_attempt(h, t1);
  end_known_ = false;
  if (solver_.begin(h, t_, y(), f_.data()) == Status::stop) return proposal(Newton::Result::stop);
  Newton::Result result = newton_result(solver_.prepare(t1, convergence_));
  if (result != Newton::Result::converged) return proposal(result);
  if (take_masses() == Status::stop) return proposal(Newton::Result::stop);
  if (!stage_masses_.empty()) convergence_.forget();  // the matrices hold an older M(t) at every step
  if (!convergence_.rate_known()) sensitivity_convergence_.forget();
  predict();
  result = solve();
  if (result == Newton::Result::failed && end_known_ && solver_.may_take_in_place()) {  // by f at the end
    if (solver_.take_in_place(t1, candidate_.data(), end_f_.data()) == Status::stop)
      return proposal(Newton::Result::stop);
    end_known_ = false;
    result = newton_result(solver_.prepare(t1, convergence_));
    if (result == Newton::Result::converged) result = solve();
  }
  return proposal(result);
}

/// The stages, from what they are at hand, and their error.
Newton::Result Radau::solve() {
  Newton::Result result = solve_stages();
  if (result == Newton::Result::converged) {
    for (std::size_t i = 0; i < n(); ++i) candidate_[i] = y_[i] + last_increment()[i];
    result = estimate();
  }
  return result == Newton::Result::converged && error_ <= weights_.rtol() ? look_at_end() : result;
}

/// M(t) at the stages; the last of them is at hand.
Status Radau::take_masses() {
  if (stage_masses_.empty()) return Status::ok;
  const std::size_t last = stages() - 1;
  stage_masses_[last] = *solver_.mass_matrix();
  for (std::size_t k = 0; k < last; ++k) {
    if (solver_.mass()->evaluate(t_ + formula_->nodes[k] * signed_h_) == Status::stop) return Status::stop;
    stage_masses_[k] = *solver_.mass_matrix();
  }
  return Status::ok;
}

/// Increments as the last polynomial, extended, predicts them: its values less the one at its end, where all of its
/// terms but the first vanish.
void Radau::predict() {
  weights_.fill(y(), weight_.data());
  if (memory_h_ == 0) {
    std::fill(increments_.begin(), increments_.end(), 0);
    return;
  }
  for (std::size_t stage = 0; stage < stages(); ++stage) {
    const double x = signed_h_ / memory_h_ * formula_->nodes[stage];
    double* increment = Z(stage);
    for (std::size_t i = 0; i < n(); ++i) increment[i] = x * polynomial_[i];
    double term = 1 + x;
    for (std::size_t k = 1; k < accepted_->stages; ++k) {
      term *= k % 2 == 1 ? -x : 1 + x;
      const double* coefficient = polynomial_.data() + k * n();
      for (std::size_t i = 0; i < n(); ++i) increment[i] += term * coefficient[i];
    }
  }
}

/// The state first; then its sensitivities, whose equations are linear, in an iteration of their own.
Newton::Result Radau::solve_stages() {
  const BlockSystem& system = solver_.system();
  part_ = system.state(), part_weight_ = weight_.data();
  const Newton::Result result = iterate(convergence_);
  if (result != Newton::Result::converged || !system.has_sensitivities()) return result;
  system.sensitivity_weights().fill(y(), sensitivity_weight_.data());
  part_ = system.sensitivities(), part_weight_ = sensitivity_weight_.data();
  return iterate(sensitivity_convergence_);
}

Newton::Result Radau::iterate(Convergence& convergence) {
  const double roundoff = Convergence::roundoff_units * eps * norm_of_part(y());
  convergence.begin(weights_.rtol(), solver_.careful());
  const double tolerance = std::max(linear_half * convergence.goal(), roundoff);
  for (bool forgets = false;;) {
    const Newton::Result evaluated = newton_result(stage_residuals());
    if (evaluated != Newton::Result::converged) return evaluated;
    if (part_.of_state()) {
      residual_.swap(earlier_);
      std::copy_n(residuals_.data() + (stages() - 1) * n(), part_.size(), residual_.data());
    }
    bool negligible = convergence.iterations() > 0;
    const Newton::Result solved = solve_part(tolerance, negligible);
    if (solved != Newton::Result::converged) return solved;
    if (negligible) {
      convergence.settle(tolerance);
      return Newton::Result::converged;
    }
    const double size = update_stages(forgets);
    if (solver_.system().coupled(part_).empty()) return Newton::Result::converged;  // a first update, and exact
    switch (convergence.judge(size, roundoff)) {
      case Convergence::Verdict::converged: return Newton::Result::converged;
      case Convergence::Verdict::diverged:
        if (part_.of_state() && convergence.iterations() > 1 && unmoved(earlier_, residual_.data(), weight_.data(), 0))
          solver_.note_too_large();
        if (part_.of_state() || forgets || solver_.matrix_free()) return Newton::Result::failed;
        forgets = true;  // updates of S that are roundoff
        convergence.begin(weights_.rtol());
        break;
      case Convergence::Verdict::go_on: break;
    }
  }
}

Newton::Result Radau::solve_part(double tolerance, bool& negligible) {
  return solver_.solve(mass(), part_weight_, tolerance, part_, residuals_.data(), scratch_.data(), negligible);
}

double Radau::norm_of_part(const double* v) const {
  v += part_.first;
  return max_norm(part_.size(), [v, w = part_weight_ + part_.first](std::size_t i) { return v[i] / w[i]; });
}

/// Takes the first update of a first step, which nothing predicts, for the size of components that start at 0.
void Radau::weigh_first_update() {
  if (memory_h_ != 0 || convergence_.iterations() > 0 || !part_.of_state()) return;
  for (std::size_t i = 0; i < part_.stop; ++i) weight_[i] = weights_.at(i, y_[i], y_[i] + last_increment()[i]);
}

/// h (f(t_i, Y_i) − M Y'_i), where h Y' = A⁻¹ Z.
Outcome Radau::stage_residuals() {
  formula_->transform(formula_->A_inverse, n(), part_.first, part_.stop, increments_.data(), residuals_.data());
  for (std::size_t stage = 0; stage < stages(); ++stage) {
    double* residual = residuals_.data() + stage * n();
    for (std::size_t i = 0; i < n(); ++i) scratch_[i] = y_[i] + Z(stage)[i];
    const double t = stage + 1 == stages() ? t1_ : t_ + formula_->nodes[stage] * signed_h_;
    const Outcome outcome = solver_.system().evaluate(part_, t, scratch_.data(), error_vector_.data());
    if (outcome != Outcome::ok) return outcome;
    const double* rate = residual;
    if (const Matrix* M = stage_masses_.empty() ? solver_.mass_matrix() : &stage_masses_[stage]) {
      solver_.system().multiply_mass(*M, rate, gap_.data());
      rate = gap_.data();
    }
    for (std::size_t i = part_.first; i < part_.stop; ++i) residual[i] = signed_h_ * error_vector_[i] - rate[i];
  }
  return Outcome::ok;
}

/// Adds the updates, which have replaced the residuals, to Z, and returns their size. `forgets`: without those entries
/// for sensitivities that are roundoff.
double Radau::update_stages(bool forgets) {
  for (std::size_t stage = 0; stage < stages(); ++stage)
    for (std::size_t i = stage * n() + part_.first; i < stage * n() + part_.stop; ++i) increments_[i] += residuals_[i];
  weigh_first_update();
  if (forgets)
    for (std::size_t stage = 0; stage < stages(); ++stage)
      solver_.forget_sensitivity_roundoff(signed_h_, y(), residuals_.data() + stage * n());
  MaxNorm size;
  for (std::size_t stage = 0; stage < stages(); ++stage) size.add(norm_of_part(residuals_.data() + stage * n()));
  return size.value();
}

/// The error of the attempt. Where a first look would fail it in a step that starts anew, the estimate is damped once
/// more: of stiff components, whose estimate does not vanish with h, nothing remains (Hairer & Wanner, eq. IV.8.20).
Newton::Result Radau::estimate() {
  weights_.fill(y(), candidate_.data(), weight_.data());
  std::fill(scratch_.begin(), scratch_.end(), 0);
  for (std::size_t stage = 0; stage < stages(); ++stage) {
    const double weight = -formula_->initial_slope[stage] / formula_->mu;
    for (std::size_t i = 0; i < n(); ++i) scratch_[i] += weight * Z(stage)[i];
  }
  Mass* mass = solver_.mass();
  if (mass && !mass->constant() && mass->evaluate(t_) == Status::stop) return Newton::Result::stop;
  if (const Matrix* M = solver_.mass_matrix())
    solver_.system().multiply_mass(*M, scratch_.data(), error_vector_.data());
  else
    error_vector_ = scratch_;
  const double c = signed_h_ / formula_->mu;
  for (std::size_t i = 0; i < n(); ++i) error_vector_[i] += c * f_[i];
  const Newton::Result first = damp(error_vector_.data());
  error_ = norm(error_vector_.data());
  if (error_ > weights_.rtol() && solver_.forget_sensitivity_roundoff(c, candidate_.data(), error_vector_.data()))
    error_ = norm(error_vector_.data());
  if (first != Newton::Result::converged || error_ <= weights_.rtol() || (memory_h_ != 0 && !failed_)) return first;
  // HW take f at y + e in place of f(y). Where f is linear, that is (M − c J)⁻¹ M e; where f jumps between these
  // points, it is what stages beyond the jump agree with, and they alone: the estimate would be blind.
  const Newton::Result second = damp_again(error_vector_.data());
  error_ = norm(error_vector_.data());
  return second;
}

/// v ← (M − c J)⁻¹ v.
Newton::Result Radau::damp(double* v) {
  return solver_.solve_real(mass(), weight_.data(), sensitivity_weight_.data(), linear_part * weights_.rtol(), t_, y(),
                            f_.data(), v);
}

/// v ← (M − c J)⁻¹ M v.
Newton::Result Radau::damp_again(double* v) {
  std::copy_n(v, n(), scratch_.begin());
  if (const Matrix* M = solver_.mass_matrix()) solver_.system().multiply_mass(*M, scratch_.data(), v);
  return damp(v);
}

Step::Attempt Radau::inspect_extension(const Attempt&) {
  double* defect = residuals_.data() + n();
  std::copy(y_.begin(), y_.end(), scratch_.begin());
  std::fill(gap_.begin(), gap_.end(), 0);
  for (std::size_t stage = 0; stage < stages(); ++stage) {
    const double value = formula_->value_there[stage], slope = formula_->slope_there[stage] / formula_->mu;
    for (std::size_t i = 0; i < n(); ++i) {
      scratch_[i] += value * Z(stage)[i];
      gap_[i] += slope * Z(stage)[i];
    }
  }
  const Newton::Result result = filter_defect(formula_->farthest, defect);
  if (result == Newton::Result::converged) error_ = std::max(error_, norm(defect));
  return proposal(result);
}

double Radau::parts_seen() const { return parts_seen_by_radau; }

/// Between the stages, and between the start and the first of them.
Step::Attempt Radau::inspect_inside(const Attempt&, double gap) {
  inside_.resize(stages() * n());
  formula_->transform(formula_->coefficients, n(), 0, n(), increments_.data(), inside_.data());
  double* defect = residuals_.data() + n();
  double before = 0;
  for (std::size_t stage = 0; stage < stages(); ++stage) {
    const double node = formula_->nodes[stage];
    const int pieces = static_cast<int>(std::ceil((node - before) * h_ / gap));
    for (int piece = 1; piece < pieces; ++piece) {
      const double theta = before + (node - before) * piece / pieces;
      for (std::size_t i = 0; i < n(); ++i) {  // P and h P' / μ, by nested multiplication
        double value = 0, slope = 0;
        for (std::size_t j = stages(); j-- > 0;) {
          const bool even = j % 2 == 0;
          const double factor = even ? theta : 1 - theta;
          value += inside_[j * n() + i];
          slope = factor * slope + (even ? value : -value);
          value *= factor;
        }
        scratch_[i] = y_[i] + value;
        gap_[i] = slope / formula_->mu;
      }
      Newton::Result result = filter_defect(theta, defect);
      if (result == Newton::Result::converged && norm(defect) > error_) result = damp_again(defect);
      if (result != Newton::Result::converged) return proposal(result);
      error_ = std::max(error_, norm(defect));
    }
    before = node;
  }
  return proposal(Newton::Result::converged);
}

/// (M − (h/μ) J)⁻¹ (h/μ) (f(P) − M P') where the polynomial P is farthest from what it interpolates. Where J is large,
/// and in algebraic equations, that is y − P; for y' = λ (y − t^{s+1}) + (s+1) t^s with any λ < 0 it is 0.8 to 1.15
/// times the largest error of P.
Newton::Result Radau::filter_defect(double theta, double* defect) {
  const double t = t_ + theta * signed_h_, c = signed_h_ / formula_->mu;
  const Newton::Result evaluated = newton_result(solver_.evaluate(t, scratch_.data(), residuals_.data()));
  if (evaluated != Newton::Result::converged) return evaluated;
  const double* rate = gap_.data();
  if (Mass* mass = solver_.mass()) {
    if (!mass->constant() && mass->evaluate(t) == Status::stop) return Newton::Result::stop;
    solver_.system().multiply_mass(mass->matrix(), gap_.data(), scratch_.data());
    rate = scratch_.data();
  }
  for (std::size_t i = 0; i < n(); ++i) defect[i] = c * residuals_[i] - rate[i];
  return damp(defect);
}

std::size_t Radau::directions(const double** vectors) const {
  for (std::size_t i = 0; i < stages(); ++i) vectors[i] = increments_.data() + i * n();
  return stages();
}

/// Returns the factor of h; it is smaller where Newton's iteration was long.
double Radau::factor_of_error() const {
  const double most = 2 * most_iterations(*formula_) + 1;
  const double slack = safety * most / (most - 1 + convergence_.iterations());
  const double factor = slack * std::pow(weights_.rtol() / error_, 1 / estimate_order(*formula_));
  return std::clamp(factor, smallest_factor, largest_factor);
}

bool Radau::reject(Cause cause, double hmin) {
  failed_ = true;
  const double before = h_;
  if (cause == Cause::newton) {
    if (!retry_newton(hmin, halved)) return false;
    const bool grown = h_ > most_growth * std::abs(memory_h_);  // even after the cut: the step was too long
    if (h_ < before && formula_ != lowest_ && !grown) lower_order();
    return true;
  }
  if (cause == Cause::error && solver_.has_matrices()) solver_.renew_if_old();
  if (h_ <= hmin) return false;
  h_ = std::max(hmin, h_ * (cause == Cause::error ? factor_of_error() : halved));
  return true;
}

/// The step that the last two errors ask for (Gustafsson; Hairer & Wanner, section IV.8), and no more than the last
/// one alone does.
double Radau::next_h() const {
  double factor = factor_of_error();
  const double error = std::max(error_, smallest_error * weights_.rtol());
  if (last_h_ > 0) {
    const double trend = h_ / last_h_ * std::pow(last_error_ / error, 1 / estimate_order(*formula_));
    factor = std::min(factor, std::max(smallest_factor, factor * trend));
  }
  if (failed_) factor = std::min(factor, 1.0);
  if (factor >= kept_from && factor <= kept_up_to && !solver_.renewal_due()) factor = 1;
  return factor * h_;
}

/// `failed` where J is much too large, and updates were too small to show it: f at the end of the step, which is needed
/// there anyhow unless y is projected, tells what the last stage leaves. Residuals of M y' = f have no scale.
Newton::Result Radau::look_at_end() {
  if (!solver_.has_matrices() || solver_.mass() != nullptr || solver_.noisy()) return Newton::Result::converged;
  const std::size_t states = residual_.size();
  const double before = max_norm(states, [this](std::size_t i) { return residual_[i] / weight_[i]; });
  if (before <= left_at_end * weights_.rtol()) return Newton::Result::converged;
  const Newton::Result evaluated = newton_result(solver_.evaluate(t1_, candidate_.data(), end_f_.data()));
  if (evaluated != Newton::Result::converged) return evaluated;
  end_known_ = true;
  const double* last_row = formula_->A_inverse + (stages() - 1) * stages();
  for (std::size_t i = 0; i < states; ++i) scratch_[i] = signed_h_ * end_f_[i];
  for (std::size_t j = 0; j < stages(); ++j)
    for (std::size_t i = 0; i < states; ++i) scratch_[i] -= last_row[j] * Z(j)[i];
  if (!unmoved(residual_, scratch_.data(), weight_.data(), left_at_end * weights_.rtol()))
    return Newton::Result::converged;
  solver_.be_careful();
  solver_.note_too_large();
  return Newton::Result::failed;
}

Outcome Radau::accept(const double* y1) {
  if (!end_known_ || !std::equal(y1, y1 + n(), candidate_.begin()))
    if (const Outcome outcome = solver_.evaluate(t1_, y1, end_f_.data()); outcome != Outcome::ok) return outcome;
  std::swap(f_, end_f_);
  formula_->transform(formula_->coefficients, n(), 0, n(), increments_.data(), polynomial_.data());
  if (!slope_.empty()) {
    formula_->transform(formula_->A_inverse, n(), 0, n(), increments_.data(), residuals_.data());
    const double* rate = residuals_.data() + (stages() - 1) * n();
    for (std::size_t i = 0; i < n(); ++i) slope_[i] = rate[i] / signed_h_;
  }
  last_y_.swap(y_);
  commit(y1);
  if (solver_.has_matrices() && convergence_.rate() > fast_rate) solver_.renew();
  const double h = next_h();
  last_h_ = h_;
  last_error_ = std::max(error_, smallest_error * weights_.rtol());
  memory_h_ = signed_h_;
  accepted_ = formula_;
  choose_order(h);
  failed_ = false;
  h_ = h;
  return Outcome::ok;
}

/// Chooses the order of the next step, whose |h| is known. More stages are tried where the iteration converges so fast
/// that longer steps would not slow it down, and where the error limits h.
void Radau::choose_order(double h) {
  steps_until_raise_ = std::max(0, steps_until_raise_ - 1);
  const double rate = convergence_.rate(), change = h / h_;
  if (formula_ != lowest_ && rate >= rate_to_lower)
    lower_order();
  else if (may_raise_order() && rate <= rate_to_raise && change >= least_change && change <= most_growth)
    use(formula_ + 1);
  if (formula_ != accepted_) last_h_ = 0;
}

bool Radau::may_raise_order() const {
  if (formula_ == highest_ || failed_ || steps_until_raise_ > 0) return false;
  return formula_ + 1 != &radau_formulas.back() || weights_.rtol() <= seven_stages_from;
}

void Radau::lower_order() {
  use(formula_ - 1);
  steps_until_raise_ = steps_before_raise;
}

void Radau::state(Archive& archive) {
  Step::state(archive);
  for (const RadauFormula** formula : {&formula_, &accepted_}) {
    auto index = *formula - radau_formulas.data();
    archive(index);
    archive.require(index >= lowest_ - radau_formulas.data() && index <= highest_ - radau_formulas.data());
    *formula = radau_formulas.data() + index;
  }
  if (archive.reading()) use(formula_);
  archive(polynomial_, f_, slope_, signed_h_, memory_h_, last_h_, last_error_, failed_, steps_until_raise_);
  convergence_.state(archive);
  sensitivity_convergence_.state(archive);
  solver_.state(archive);
}

Interpolate Radau::interpolate() const { return in_turn<runge_kutta::nested_polynomial>; }

/// y + Σ of the nested terms; the first of them is that of the last stage.
Status Radau::extension(double* data) {
  data = std::copy(last_y_.begin(), last_y_.end(), data);
  std::copy_n(polynomial_.begin(), accepted_->stages * n(), data);
  return Status::ok;
}

Status Radau::extension_of_attempt(double* data, std::size_t& size) {
  size = (stages() + 1) * n();
  data = std::copy(y_.begin(), y_.end(), data);
  formula_->transform(formula_->coefficients, n(), 0, n(), increments_.data(), data);
  return Status::ok;
}

}  // namespace invariode
