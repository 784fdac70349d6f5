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
constexpr double large_stiffness = 10;     // c ‖J‖ above which a Jacobian of another point may do harm
constexpr double tolerated_noise = 0.01;   // of c J: the rate that it costs Newton's iteration
constexpr double noise_growth = 100;       // of |c|, after which a J that may be roundoff is taken anew

// What residuals may say that an iteration has left, in units of the goal that its updates have to reach, and a part of
// a residual that is as good as nothing. (The old Jacobians of HIRES, whose counts are published, leave 56 of it at
// 1e-6, by iterations that remove 6 % of a residual.)
constexpr double most_left = 60, hardly = 0.03;
// Differences of f that tell branches apart consist of so many roundoffs, and differ by more than this part from J e.
constexpr double resolved = 1000, of_another_branch = 0.5;
constexpr double roundoffs_of_f = 10;  // in a residual, each of the size of its terms
// Where an iteration had converged that solved nothing, the next steps may leave so much less, in more iterations.
constexpr int most_full_iterations = 25;
constexpr int careful_steps = 10, careful_iterations = 20;
constexpr double careful_part = 1e-3;

// Of y in units of the weights, over which what y does to the slopes of S is a difference, ε^{1/4}: it need not be
// exact, and laws of S are disturbed by roundoff of it.
const double coupling_increment = std::pow(eps, 0.25);

// How far from y, in units of the weights, J is tested: rtol, or where that is large this, since f may end there.
constexpr double widest_reach = 1e-3;
constexpr double on_one_side = 0.25;      // of that, from a point half of it at least away from where f jumps
const double part_of_y = std::sqrt(eps);  // in which missing entries are sought
constexpr double suspicious_growth = 10;  // of the size of J

// Matrix-free (Brown & Hindmarsh, 1989, and CVODE's defaults).
constexpr double tolerated_change = 0.3;  // of c, with a preconditioner, or sparse factors, for the old one
constexpr std::size_t fewest_kept = 200;  // rows of such factors: those of smaller matrices cost no more than a step
constexpr int old_preconditioner = 20;    // steps

}  // namespace

void Convergence::begin(double rtol, double roundoff, bool careful) {
  rtol_ = careful ? careful_part * rtol : rtol;
  most_iterations_ = careful ? careful_iterations : rules_.most_iterations;
  roundoff_ = roundoff;
  iteration_ = 0;
}

/// A first update is judged by the rate from before. That may have been roundoff, where f was linear, and then says
/// nothing of an update that leads far away, such as into the range of an exponential.
Convergence::Verdict Convergence::judge(double size) {
  ++iteration_;
  if (!std::isfinite(size)) return Verdict::diverged;
  if (size <= roundoff_) return Verdict::converged;
  if (iteration_ == 1) {
    const double rate = std::max(rate_, least_first_rate);
    if (rate_known_ && size * rate / (1 - rate) <= rules_.first_goal * rtol_) return Verdict::converged;
    if (!rate_known_) rate_ = 0;
  } else if (size > slowest_rate * previous_) {
    if (size > rules_.jump_goal * rtol_) return Verdict::diverged;
  } else {
    rate_ = std::max(rate_memory * rate_, size / previous_);
    rate_known_ = true;
    const double left = size * rate_ / (1 - rate_);
    if (left <= rules_.goal * rtol_) return Verdict::converged;
    if (left * std::pow(rate_, most_iterations_ - iteration_) > rules_.goal * rtol_) return Verdict::diverged;
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
    : f_(f),
      state_f_(linear.state ? *linear.state->f : f),
      weights_(linear.state ? *linear.state->weights : weights),
      extent_(linear.state ? linear.state->extent : Extent(weights.size())),
      coupled_(linear.state ? linear.state->coupled() : weights.size()),
      sensitivity_weights_(linear.state ? linear.state->iteration : nullptr),
      jacobian_(*linear.jacobian),
      mass_(linear.mass),
      scratch_(linear.krylov ? 0 : extent_.n),
      reach_(scratch_.size()),
      branch_y_(scratch_.size()) {
  if (linear.state) sensitivities_ = *linear.state->sensitivities;
  if (linear.krylov)
    free_.emplace(state_f_, weights_, linear, complex);
  else
    check_.emplace(extent_.n);
}

void AgingJacobian::forget() {
  if (free_) free_->forget_failures();
  factored_.reset();
  renew_ = false;
  noisy_ = false;
  careful_ = 0;
  first_ = true;
}

Outcome AgingJacobian::evaluate(double t, const double* y, double* out) {
  undefined_ = -1;
  if (!all_finite(y, extent_.size())) return Outcome::not_finite;
  if (f_(t, y, out) == Status::stop) return Outcome::stop;
  jacobian_.extend(y, out);
  return finite_or_noted(out, extent_.size());
}

Outcome AgingJacobian::evaluate_state(double t, const double* y, double* out) {
  undefined_ = -1;
  if (!all_finite(y, extent_.n)) return Outcome::not_finite;
  if (state_f_(t, y, out) == Status::stop) return Outcome::stop;
  jacobian_.extend(y, out);
  return finite_or_noted(out, extent_.n);
}

Outcome AgingJacobian::evaluate_sensitivities(double t, const double* Y, double* out) {
  undefined_ = -1;
  if (!all_finite(Y, extent_.size())) return Outcome::not_finite;
  if ((*sensitivities_)(t, Y, out + extent_.n) == Status::stop) return Outcome::stop;
  return all_finite(out + extent_.n, extent_.n * extent_.k) ? Outcome::ok : Outcome::not_finite;
}

Outcome AgingJacobian::finite_or_noted(const double* out, std::size_t count) {
  if (all_finite(out, count)) return Outcome::ok;
  undefined_ = static_cast<int>(std::find_if_not(out, out + count, [](double x) { return std::isfinite(x); }) - out);
  return Outcome::not_finite;
}

Status AgingJacobian::sensitivity_rate(double t, const double* Y, const double* slope, const double* f, double h,
                                       double* rate) {
  const std::size_t n = extent_.n;
  const double least = std::sqrt(eps) * std::max(std::abs(t), std::abs(t + h));
  const double dt = t + std::copysign(std::min(least, std::abs(h)), h) - t;
  beyond_.assign(Y, Y + extent_.size());
  for (std::size_t i = 0; i < n && slope != nullptr; ++i) beyond_[i] += dt * slope[i];
  if ((*sensitivities_)(t + dt, beyond_.data(), rate + n) == Status::stop) return Status::stop;
  for (std::size_t i = n; i < extent_.size(); ++i) rate[i] = dt == 0 ? 0 : (rate[i] - f[i]) / dt;
  if (!all_finite(rate + n, n * extent_.k)) std::fill_n(rate + n, n * extent_.k, 0);
  return Status::ok;
}

/// The blocks below the first, which is solved.
Status AgingJacobian::solve_below(Factorization& factors, double c, double t, const double* Y, const double* f,
                                  double* b) {
  if (couple(c, t, Y, f, b) == Status::stop) return Status::stop;
  solve_blocks(factors, b, extent_.n, extent_.size());
  return Status::ok;
}

/// b_j += c ∂(J S_j + f_pj)/∂y b_0, by a difference along b_0. It need not be exact: the formulas have their order with
/// any matrix, and it is what keeps S stable where y is stiff.
Status AgingJacobian::couple(double c, double t, const double* Y, const double* f, double* b) {
  const std::size_t n = extent_.n;
  const double size = max_norm(n, [&](std::size_t i) { return b[i] / weights_.at(i, Y[i]); });
  if (!(size > 0) || !std::isfinite(size)) return Status::ok;
  const double part = coupling_increment / size;
  beyond_.assign(Y, Y + extent_.size());
  changed_.resize(n * extent_.k);
  for (std::size_t i = 0; i < n; ++i) beyond_[i] += part * b[i];
  if ((*sensitivities_)(t, beyond_.data(), changed_.data()) == Status::stop) return Status::stop;
  if (!all_finite(changed_.data(), changed_.size())) return Status::ok;
  for (std::size_t i = 0; i < changed_.size(); ++i) b[n + i] += c * ((changed_[i] - f[n + i]) / part);
  return Status::ok;
}

Outcome AgingJacobian::evaluate_apart(double t, const double* y, double* out) {
  Callback f = state_f_;
  ++work_.checks;
  if (f(t, y, out) == Status::stop) return Outcome::stop;
  jacobian_.extend(y, out);
  return all_finite(out, weights_.size()) ? Outcome::ok : Outcome::not_finite;
}

Status AgingJacobian::take_jacobian(double t, const double* y, const double* slope) {
  factored_.reset();
  first_c_.reset();
  renew_ = false;
  current_ = true;
  age_ = 0;
  too_large_ = beside_ = false;
  branch_examined_ = false;
  if (!free_) note_branch(t, y);
  if (plainly_) return jacobian_.evaluate_plainly(state_f_, t, y, slope);
  if (jacobian_.evaluate(state_f_, t, y, slope) == Status::stop) return Status::stop;
  return slope != nullptr && fit_due(y) ? make_fit(t, y, slope) : Status::ok;
}

/// The first J of a start, the evaluations 1, 2, 4, 8, …, and one that has grown much beyond those that fitted; of
/// those that are given, which no look can improve, the first. A J that is not larger than the right one cannot make
/// Newton's iteration look converged.
bool AgingJacobian::fit_due(const double* y) {
  if (!check_) return false;
  const bool first = std::exchange(first_, false);
  if (!jacobian_.computed()) return !fitting_;
  if (first || !fitting_ || std::has_single_bit(static_cast<std::uint64_t>(jacobian_.count()))) return true;
  weights_.fill(y, reach_.data());
  return check_->size(jacobian(), reach_.data()) > suspicious_growth * *fitting_;
}

/// J is to describe f as far as steps are accurate: otherwise Newton's iteration may seem to converge at once, to what
/// does not solve the equations. This takes evaluations of f that are counted apart.
Status AgingJacobian::make_fit(double t, const double* y, const double* slope) {
  Callback f = state_f_;
  // Columns that are differenced together and share a row after all fit in the direction of the increments: random
  // signs tell them apart, in parts of y that leave its signs as they are.
  const auto seek_missing = [&] {
    if (!jacobian_.computed() || jacobian().structure.kind == Structure::Kind::dense) return Status::ok;
    for (std::size_t j = 0; j < reach_.size(); ++j) reach_[j] = part_of_y * std::abs(y[j]);
    const auto turn = static_cast<std::size_t>(jacobian_.count());
    switch (check_->examine(f, t, y, slope, jacobian(), reach_.data(), turn, jacobian_.box())) {
      case JacobianCheck::Verdict::stop: return Status::stop;
      case JacobianCheck::Verdict::wrong: return jacobian_.complete(f, t, y, slope, check_->direction());
      case JacobianCheck::Verdict::right: break;
    }
    return Status::ok;
  };
  Status status = Status::ok;
  switch (fit(f, t, y, slope, 1)) {
    case JacobianCheck::Fit::stop: status = Status::stop; break;
    case JacobianCheck::Fit::good: status = seek_missing(); break;
    case JacobianCheck::Fit::wrong: status = mend(f, t, y, slope); break;
    case JacobianCheck::Fit::bent: status = take_beside(f, t, y); break;
  }
  work_.checks += f.calls() - state_f_.calls();
  weights_.fill(y, reach_.data());
  fitting_ = std::max(fitting_.value_or(0), check_->size(jacobian(), reach_.data()));
  return status;
}

/// As far as that part of the tolerance.
JacobianCheck::Fit AgingJacobian::fit(Callback& f, double t, const double* y, const double* slope, double part) {
  const double reach = part * std::min(weights_.rtol(), widest_reach);
  for (std::size_t j = 0; j < reach_.size(); ++j) reach_[j] = reach * jacobian_.scale(j, y);
  const auto turn = static_cast<std::size_t>(jacobian_.count());
  return check_->fit(f, t, y, slope, jacobian(), reach_.data(), turn, jacobian_.box());
}

/// f jumps, or bends sharply, within the tolerance: J is taken on the side to which f leads.
Status AgingJacobian::take_beside(Callback& f, double t, const double* y) {
  const std::size_t n = weights_.size();
  if (jacobian_.kind() == Jacobian::Kind::constant) return Status::ok;
  std::vector<double> point(y, y + n), slope(n);
  for (std::size_t j = 0; j < n; ++j) point[j] += check_->direction()[j];
  if (f(t, point.data(), slope.data()) == Status::stop) return Status::stop;
  if (!all_finite(slope.data(), n)) return Status::ok;
  beside_ = true;
  note_branch(t, point.data());
  if (jacobian_.evaluate(f, t, point.data(), slope.data()) == Status::stop) return Status::stop;
  switch (fit(f, t, point.data(), slope.data(), on_one_side)) {
    case JacobianCheck::Fit::stop: return Status::stop;
    case JacobianCheck::Fit::wrong: return mend(f, t, point.data(), slope.data());
    case JacobianCheck::Fit::good:
    case JacobianCheck::Fit::bent: break;
  }
  return Status::ok;
}

/// f is smooth, and J is not its derivative: entries are missing, increments are too small for the noise of f, or the
/// user's function is wrong.
Status AgingJacobian::mend(Callback& f, double t, const double* y, const double* slope) {
  if (jacobian_.computed()) return jacobian_.complete(f, t, y, slope, check_->direction());
  if (jacobian_.kind() == Jacobian::Kind::derived) return Status::ok;
  const bool too_small = std::abs(check_->predicted()) < 0.5 * std::abs(check_->change());  // which costs steps only
  if (!misfit_ && !too_small)
    misfit_ = Misfit{.kind = Misfit::Kind::matrix,
                     .t = t,
                     .row = check_->row(),
                     .change = check_->change(),
                     .predicted = check_->predicted()};
  return Status::ok;
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
    if (age_ >= old_preconditioner) renew();
  }
  if (!renew_) return Status::ok;
  if (slope == nullptr) {
    slope = scratch_.data();
    if (!jacobian_.needs_slope()) return take_jacobian(t, y, nullptr);
    if (evaluate_state(t, y, scratch_.data()) == Outcome::stop) return Status::stop;
  }
  return take_jacobian(t, y, slope);
}

void AgingJacobian::note_branch(double t, const double* y) {
  branch_t_ = t;
  std::copy_n(y, branch_y_.size(), branch_y_.begin());
}

AgingJacobian::Fitness AgingJacobian::examine(double c, double t, const double* y, const double* r, const double* w) {
  const std::size_t n = extent_.n;
  const auto evaluate_here = [](void* self, double at, const double* point, double* out) {
    return static_cast<AgingJacobian*>(self)->evaluate_apart(at, point, out) == Outcome::stop ? Status::stop
                                                                                              : Status::ok;
  };
  Callback f(evaluate_here, this);
  find_increment(y, r, w);
  const auto norm = [&](const double* v) { return max_norm(n, [&](std::size_t i) { return v[i] / w[i]; }); };
  const double change = norm(changes_.data());
  if (!(change > 0)) return Fitness::fits;
  if (!branch_examined_) {
    const Outcome outcome = examine_branch(f, w);
    if (outcome == Outcome::stop) return Fitness::stop;
    if (outcome == Outcome::not_finite) return Fitness::of_another_branch;
    branch_examined_ = true;
  }
  switch (kinks_.search(f, branch_t_, branch_y_.data(), t, y, increment_.data(), {w, n}, reach_.data())) {
    case KinkSearch::Verdict::stop: return Fitness::stop;
    case KinkSearch::Verdict::kink: return Fitness::of_another_branch;
    case KinkSearch::Verdict::smooth: break;
  }
  note_branch(t, y);
  const bool stiff = std::abs(c) * norm(kinks_.at_end()) > large_stiffness * norm(increment_.data());
  return stiff ? Fitness::fits : Fitness::stiffness_has_gone;
}

/// The increment e along r is the shortest that f resolves, since kinks are not seen any sharper: J e, in `changes_`,
/// is so many roundoffs of f in its largest row. `reach_`: that roundoff, between where J was taken and y.
void AgingJacobian::find_increment(const double* y, const double* r, const double* w) {
  const std::size_t n = extent_.n;
  increment_.resize(n);
  changes_.resize(n);
  std::fill(reach_.begin(), reach_.end(), 0);
  jacobian().for_each([&](std::size_t i, std::size_t j, double value) {
    reach_[i] += roundoffs_of_f * eps * std::abs(value) * std::max(std::abs(y[j]), std::abs(branch_y_[j]));
  });
  jacobian().multiply(r, changes_.data());
  std::size_t row = 0;
  for (std::size_t i = 1; i < n; ++i)
    if (std::abs(changes_[i] / w[i]) > std::abs(changes_[row] / w[row])) row = i;
  const double part = changes_[row] != 0 ? resolved * reach_[row] / std::abs(changes_[row]) : 0;
  for (std::size_t j = 0; j < n; ++j) {
    increment_[j] = part * r[j];
    changes_[j] *= part;
  }
}

/// Is J e the change of f to both sides of where J was taken? `not_finite`: it is not, beyond the roundoff in `reach_`:
/// the point is on a kink, or differences have led through one.
Outcome AgingJacobian::examine_branch(Callback& f, const double* w) {
  const std::size_t n = extent_.n;
  std::vector<double> here(n), there(n), point(n);
  if (f(branch_t_, branch_y_.data(), here.data()) == Status::stop) return Outcome::stop;
  const double change = max_norm(n, [&](std::size_t i) { return changes_[i] / w[i]; });
  for (const double side : {1.0, -1.0}) {
    for (std::size_t j = 0; j < n; ++j) point[j] = branch_y_[j] + side * increment_[j];
    if (f(branch_t_, point.data(), there.data()) == Status::stop) return Outcome::stop;
    const auto off = [&](std::size_t i) {
      return std::max(0.0, std::abs(side * (there[i] - here[i]) - changes_[i]) - reach_[i]) / w[i];
    };
    if (max_norm(n, off) > of_another_branch * change) return Outcome::not_finite;
  }
  return Outcome::ok;
}

void AgingJacobian::be_careful() { careful_ = careful_steps; }

bool AgingJacobian::may_take_in_place() const { return !in_place_ && jacobian_.kind() != Jacobian::Kind::constant; }

Status AgingJacobian::take_in_place(double t, const double* y, const double* slope) {
  in_place_ = plainly_ = true;
  return take_jacobian(t, y, slope);
}

bool AgingJacobian::renew_if_old() {
  jacobian_.doubt();
  if (std::exchange(in_place_, false)) {
    renew();
    return false;
  }
  if (!current_) return renew();
  const bool elsewhere = beside_ || jacobian_.adapted();
  if (!too_large_ || plainly_ || !elsewhere) return false;
  plainly_ = renew();
  return plainly_;
}

bool AgingJacobian::renew() {
  if (jacobian_.kind() == Jacobian::Kind::constant || (free_ && !free_->preconditioned())) return false;
  return renew_ = true;
}

/// Roundoff in J that looks like stiffness damps the updates: the iteration converges, to what does not solve the
/// equations. Where it has counted once (components that start at 0 cause it), J is taken anew, with wide increments,
/// as |c| grows: those of the first steps, with y tiny still, are not good enough for long ones.
void AgingJacobian::renew_if_noise(double c) {
  if (current_) return;
  c = std::abs(c);
  if (noisy_ ? first_c_ && c < noise_growth * *first_c_ : c * jacobian_.noise() <= tolerated_noise) return;
  noisy_ = true;
  jacobian_.widen_increments();
  renew();
}

void AgingJacobian::step_accepted() {
  if (free_) free_->forget_failures();
  current_ = plainly_ = in_place_ = false;
  careful_ = std::max(careful_ - 1, 0);
  ++age_;
}

/// Returns whether the values of M(t) are finite, which are tested where M is a function.
bool AgingJacobian::defined_mass() {
  work_.undefined_mass =
      mass_ && !mass_->constant() && !all_finite(mass_->matrix().values.data(), mass_->matrix().values.size());
  return !work_.undefined_mass;
}

/// Forgets the factors at hand if they are not those for c.
bool AgingJacobian::needs_factors(double c, double tolerated) {
  if (factored_ && std::abs(c - *factored_) <= tolerated * std::abs(*factored_)) return false;
  if (!first_c_) first_c_ = std::abs(c);
  factored_.reset();
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

Outcome AgingJacobian::prepare_preconditioner(double c, double t1) {
  bool stopped = false;
  const auto set_up = [&] {
    if (free_->preconditioned()) count_factorization();
    current_ = true;
    age_ = 0;
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

void AgingJacobian::forget_roundoff(double c, const double* y, std::initializer_list<std::vector<double>*> residuals) {
  std::fill(scratch_.begin(), scratch_.end(), 0);
  jacobian().for_each([&](std::size_t i, std::size_t j, double value) { scratch_[i] += std::abs(value * y[j]); });
  for (std::vector<double>* r : residuals)
    for (std::size_t i = 0; i < scratch_.size(); ++i)
      if (std::abs((*r)[i]) <= roundoffs_of_f * eps * std::abs(c) * scratch_[i]) (*r)[i] = 0;
}

bool AgingJacobian::stiff(double c, const double* w) {
  if (mass_) return true;
  if (free_) return false;  // J is never an old one
  std::fill(scratch_.begin(), scratch_.end(), 0);
  jacobian().for_each([&](std::size_t i, std::size_t j, double value) { scratch_[i] += std::abs(value) * w[j]; });
  MaxNorm norm;
  for (std::size_t i = 0; i < scratch_.size(); ++i) norm.add(scratch_[i] / w[i]);
  return norm.value() * std::abs(c) > large_stiffness;
}

void AgingJacobian::fields(Archive& archive) {
  jacobian_.state(archive);
  jacobian_.matrix_state(archive);
  if (free_) free_->state(archive);
  archive(work_.checks, fitting_, misfit_, first_);
  archive(work_.factorizations, work_.solves, factored_, factored_at_, first_c_, noisy_, current_, renew_, age_,
          beside_, careful_, branch_t_, branch_y_, branch_examined_);
  archive.require(careful_ >= 0);
}

LinearWork AgingJacobian::work() const {
  LinearWork work = work_;
  work.jacobians = jacobian_.count();
  work.misfit = misfit_ ? misfit_ : jacobian_.misfit();
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
  const Extent extent = jacobian.extent();
  std::copy(f, f + extent.size(), slope);
  Mass* mass = jacobian.mass();
  if (!mass) return Outcome::ok;
  if (mass->evaluate(t) == Status::stop) return Outcome::stop;
  if (!solver_.factor(*mass, jacobian.jacobian(), lapack_)) {
    jacobian.note_singular();
    return Outcome::not_finite;
  }
  for (std::size_t first = 0; first < jacobian.coupled(); first += extent.n)
    solver_.slope(*mass, nullptr, slope + first);
  return Outcome::ok;
}

/// M y'' = f_t + J y'; of sensitivities f_t is what changes in their slopes but for S. A product that is not finite is
/// left out: the attempts will tell whether it matters.
Status InitialSlopes::second(AgingJacobian& jacobian, double t, const double* y, double h, const double* f,
                             double* slope, double* ft, double* second) {
  const auto& [n, k] = jacobian.extent();
  const std::size_t all = jacobian.extent().size(), coupled = jacobian.coupled();
  const Mass* mass = jacobian.mass();
  const bool singular = mass && mass->singular();
  if (jacobian.time_derivative(t, y, f, h, ft) == Status::stop) return Status::stop;
  if (singular) {
    std::copy(f, f + all, slope);
    solver_.slope(*mass, ft, slope);
  }
  if (k > 0 && jacobian.sensitivity_rate(t, y, slope, f, h, ft) == Status::stop) return Status::stop;
  for (std::size_t first = n; first < coupled && singular; first += n) solver_.slope(*mass, ft + first, slope + first);
  for (std::size_t first = 0; first < coupled; first += n) {
    if (jacobian.multiply(t, y, f, slope + first, second + first) == Status::stop) return Status::stop;
    if (jacobian.matrix_free() && !all_finite(second + first, n)) std::fill_n(second + first, n, 0);
  }
  std::fill(second + coupled, second + all, 0);
  for (std::size_t i = 0; i < all; ++i) second[i] += ft[i];
  for (std::size_t first = 0; first < coupled && mass; first += n) solver_.slope(*mass, nullptr, second + first);
  return Status::ok;
}

/// Where M is singular, f at t + δ along y' shows at which rates the algebraic variables leave y, and f along these
/// what they do to the others.
Status InitialSlopes::beside(AgingJacobian& jacobian, double t, const double* y, double delta, const double* f,
                             const double* slope, double* rates, double* quotient) {
  const auto& [n, k] = jacobian.extent();
  const std::size_t all = jacobian.extent().size();
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
    for (std::size_t first = 0; first < all; first += n) solver_.slope(*mass, quotient + first, slopes.data() + first);
    for (std::size_t i = 0; i < all; ++i) rates[i] = slopes[i] - slope[i];
  }
  for (std::size_t first = 0; first < all && mass; first += n) solver_.slope(*mass, nullptr, quotient + first);
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
      before_(linear.krylov ? 0 : extent().n),
      earlier_(before_.size()),
      sensitivity_weight_(linear.state ? weights.size() : 0) {}

void Newton::keep_factors() {
  const Structure& J = jacobian().structure;
  keeps_factors_ = !matrix_free() && extent().k == 0 && J.kind == Structure::Kind::sparse && J.n >= fewest_kept;
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
    count_factorization();
    convergence_.forget();
    sensitivity_convergence_.forget();
    return lu_->factor(mass_matrix(), c, jacobian());
  };
  return AgingJacobian::prepare(c, t1, factor, keeps_factors_ ? tolerated_change : 0);
}

Newton::Result Newton::solve(double c, double t1, const double* p, const double* psi, const double* w, double* d,
                             double* y) {
  assert(c != 0 && std::isfinite(c));
  place_ = {c, t1, y, w};
  const Result result = fully_ ? solve_fully(p, psi, d, y) : solve_state(p, psi, d, y);
  if (result != Result::converged || extent().k == 0) return result;
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

/// Newton's iteration as it is in the books. What it converges to from p is a solution however J changes between.
Newton::Result Newton::solve_fully(const double* p, const double* psi, double* d, double* y) {
  const auto [c, t1, place_y, w] = place_;
  const std::size_t n = extent().n;
  const auto norm = [&](const double* v) { return max_norm(n, [v, w = w](std::size_t i) { return v[i] / w[i]; }); };
  std::fill(d, d + n, 0);
  std::copy(p, p + n, y);
  const double roundoff = Convergence::roundoff_units * eps * norm(p);
  convergence_.begin(weights_.rtol(), roundoff, careful());
  for (int k = 0; k < most_full_iterations; ++k) {
    Result result = newton_result(evaluate_state(t1, y, f_value_.data()));
    if (result == Result::converged && take_in_place(t1, y, f_value_.data()) == Status::stop) result = Result::stop;
    if (result == Result::converged) result = newton_result(prepare(c, t1));
    if (result != Result::converged) return result;
    residual(c, psi, d, 0, n);
    lu_->solve(residual_.data());
    count_solve();
    const double size = norm(residual_.data());
    for (std::size_t i = 0; i < n; ++i) {
      d[i] += residual_[i];
      y[i] = p[i] + d[i];
    }
    if (size <= std::max(convergence_.goal(), roundoff)) return Result::converged;
  }
  return Result::failed;
}

Newton::Result Newton::solve_state(const double* p, const double* psi, double* d, double* y) {
  const auto [c, t1, place_y, w] = place_;
  const std::size_t n = extent().n;
  const auto norm = [&](const double* v) { return max_norm(n, [v, w = w](std::size_t i) { return v[i] / w[i]; }); };
  std::fill(d, d + n, 0);
  std::copy(p, p + n, y);
  const double roundoff = Convergence::roundoff_units * eps * norm(p);
  convergence_.begin(weights_.rtol(), roundoff, careful());
  double before = 0;
  const double tolerance = std::max(linear_part * convergence_.goal(), roundoff);
  for (;;) {
    if (const Result evaluated = newton_result(evaluate_state(t1, y, f_value_.data())); evaluated != Result::converged)
      return evaluated;
    residual(c, psi, d, 0, n);
    const double last = std::exchange(before, matrix_free() ? 0 : norm(residual_.data()));
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
    switch (convergence_.judge(size)) {
      case Convergence::Verdict::converged:
        if (const Result confirmed = confirm(psi, d, size, last, before); confirmed != Result::failed) return confirmed;
        if (const Result renewed = renew_in_place(); renewed != Result::converged) return renewed;
        convergence_.begin(weights_.rtol(), roundoff, careful());
        before = 0;
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
  const std::size_t n = extent().n, all = extent().size();
  sensitivity_weights().fill(p, sensitivity_weight_.data());  // y still holds what an earlier attempt left there
  const double* w = sensitivity_weight_.data();
  const auto norm = [&](const double* v) {
    return max_norm(all - n, [&](std::size_t i) { return v[n + i] / w[n + i]; });
  };
  std::fill(d + n, d + all, 0);
  std::copy(p + n, p + all, y + n);
  sensitivity_convergence_.begin(weights_.rtol(), Convergence::roundoff_units * eps * norm(p));
  if (const Result ready = look_at_product(); ready != Result::converged) return ready;
  for (;;) {
    const Result evaluated = newton_result(evaluate_sensitivities(place_.t, y, f_value_.data()));
    if (evaluated != Result::converged) return evaluated;
    residual(place_.c, psi, d, n, all);
    if (const Result solved = solve_columns(sensitivity_convergence_.goal(), residual_.data());
        solved != Result::converged)
      return solved;
    const double size = norm(residual_.data());
    for (std::size_t i = n; i < all; ++i) {
      d[i] += residual_[i];
      y[i] = p[i] + d[i];
    }
    if (coupled() == n) return Result::converged;
    switch (sensitivity_convergence_.judge(size)) {
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
    if (const Result evaluated = newton_result(evaluate_state(place_.t, place_.y, f_value_.data()));
        evaluated != Result::converged)
      return evaluated;
  matrix_free()->product().at(place_.t, place_.y, f_value_.data());
  return Result::converged;
}

/// The blocks of b behind the state become solutions. By GMRES each alone, in its own weights, about as far as `goal`
/// lets the iteration end, with J where `product()` is.
Newton::Result Newton::solve_columns(double goal, double* b) {
  const std::size_t n = extent().n;
  if (!matrix_free()) {
    solve_blocks(*lu_, b, n, extent().size());
    return Result::converged;
  }
  for (std::size_t block = n; block < coupled(); block += n) {
    count_solve();
    const double* w = sensitivity_weight_.data() + block;
    if (const Result ready = newton_result(precondition(b + block)); ready != Result::converged) return ready;
    const Result solved =
        newton_result(matrix_free()->solve(place_.c, mass_matrix(), w, linear_part * goal, b + block));
    if (solved != Result::converged) return solved;
  }
  return Result::converged;
}

/// Updates say that the iteration has converged. Do its residuals: of an update of that size, after a residual of the
/// size `before` and, if it is not the first, one of the size `last`? J of another branch of f may be so much too large
/// that updates are too small to show that nothing is solved. What is not stiff cannot be: there the solution is not
/// farther off than its residual.
Newton::Result Newton::confirm(const double* psi, const double* d, double size, double last, double before) {
  if (matrix_free() || mass() != nullptr || noisy()) return Result::converged;
  const bool several = convergence_.iterations() > 1;
  if (before <= tolerated_residual() && (!several || solved(size, last, before))) return Result::converged;
  const auto norm = [this](const std::vector<double>& v) {
    return max_norm(extent().n, [&](std::size_t i) { return v[i] / place_.w[i]; });
  };
  const bool stiff = this->stiff(place_.c, place_.w);
  forget_roundoff(place_.c, place_.y, {&before_, &earlier_});
  before = norm(before_);
  const bool slow = several && !solved(size, norm(earlier_), before);
  if (!slow && (before <= tolerated_residual() || !stiff)) return Result::converged;
  switch (evaluate_apart(place_.t, place_.y, f_value_.data())) {
    case Outcome::stop: return Result::stop;
    case Outcome::not_finite: return slow ? Result::failed : Result::converged;
    case Outcome::ok: break;
  }
  residual(place_.c, psi, d, 0, extent().n);
  forget_roundoff(place_.c, place_.y, {&residual_});
  const bool stuck = unmoved(before_, residual_.data(), place_.w, tolerated_residual(), hardly);
  if (!slow && !stuck && solved(size, before, norm(residual_))) return Result::converged;
  for (std::size_t i = 0; i < extent().n; ++i) residual_[i] -= before_[i];
  const Result result = doubt(norm(residual_) <= large_stiffness * size);
  if (result == Result::failed && stuck) be_careful();
  return result;
}

/// Residuals contradict the updates. As long as f is smooth and stiff this is left to the rule of the suite, whose
/// steps are published: what is left of the solution is much less than the residual. `soft`: f is not stiff along the
/// update.
Newton::Result Newton::doubt(bool soft) {
  switch (examine(place_.c, place_.t, place_.y, before_.data(), place_.w)) {
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
  const Result evaluated = newton_result(evaluate_state(place_.t, place_.y, f_value_.data()));
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
  for (std::size_t i = 0; i < extent().n; ++i) b[i] *= factor;
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
    multiply_mass(*M, sum_.data(), v);
  }
  return filter(v);
}

Newton::Result Newton::filter(double* v) {
  if (!matrix_free()) {
    assert(has_factors());
    solve_blocks(*lu_, v, 0, extent().size());
    return Result::converged;
  }
  Result result = newton_result(evaluate(place_.t, place_.y, f_value_.data()));
  if (result == Result::converged) result = newton_result(precondition(v));
  if (result == Result::converged) result = solve_linear(linear_part * weights_.rtol(), v);
  return result == Result::converged ? solve_columns(weights_.rtol(), v) : result;
}

/// c f − M (ψ + d) of the blocks from `first` to `end`, with f at hand.
void Newton::residual(double c, const double* psi, const double* d, std::size_t first, std::size_t end) {
  for (std::size_t i = first; i < end; ++i) sum_[i] = psi[i] + d[i];
  const Matrix* M = mass_matrix();
  if (M != nullptr && first < coupled())
    for (std::size_t block = first; block < end; block += extent().n)
      M->multiply(sum_.data() + block, residual_.data() + block);
  else
    std::swap(sum_, residual_);
  for (std::size_t i = first; i < end; ++i) residual_[i] = c * f_value_[i] - residual_[i];
}

}  // namespace invariode
