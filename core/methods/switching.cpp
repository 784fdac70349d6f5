#include "methods/switching.hpp"

#include <cassert>
#include <cmath>
#include <utility>

#include "detect/stiffness.hpp"
#include "linear/matrix.hpp"
#include "linear/scattered.hpp"

namespace invariode {
namespace {

// All measured with benchmarks/auto.py.
constexpr double trial_cost = 20;            // evaluations of f that a trial takes beyond its Jacobian
constexpr double largest_change = 0.2;       // what a step limited by stability changes at most, in the weights
constexpr double strongest = 20;             // so much more than one that just hardly changes y may a step count
constexpr double low_order = 0.7;            // interval of stability below which a lower order would do instead
constexpr int end_of_streak = 2;             // steps that stability does not limit
constexpr std::int64_t first_steps = 16;     // of a turn, each of which is tested
constexpr std::int64_t look_every = 8;       // afterwards, until one is limited
constexpr double stable_part = 0.9;          // of the |h| ρ(J) with which it handed over, for the way back
constexpr double explicit_gain = 0.5;        // the explicit member's steps are at most this times their cost longer
constexpr double overhead = 1;               // of an implicit step, in evaluations of f
constexpr int favourable_steps = 10;         // after which the implicit member hands back
constexpr double growing = 1.1;              // where |h| still grows so fast, it tells nothing of the cost
constexpr double backoff = 4;                // of the threshold, after a trial that has failed
constexpr double highest_threshold = 64;     // in units of the least: a problem may become stiff at last
constexpr double room = 100;                 // of the first |h| above hmin: it starts at a low order, with caution
constexpr int most_failures = 8;             // attempts of a first step before the other member goes on
constexpr double remembered = 0.9;           // of the average cost of a step
constexpr int powers = 12, first_power = 6;  // of J, and the first one from which growth is averaged
constexpr std::int64_t new_radius = 25;      // implicit steps, after which ρ(J) is estimated again if J has no matrix

void average(double& mean, double value) { mean = mean == 0 ? value : remembered * mean + (1 - remembered) * value; }

}  // namespace

Switching::Switching(Callback& f, const Weights& weights, Members members)
    : Step(f, weights),
      explicit_(std::move(members.explicit_one)),
      implicit_(std::move(members.implicit_one)),
      algebra_(dynamic_cast<ImplicitInterface*>(implicit_.get())),
      active_(explicit_ ? explicit_.get() : implicit_.get()),
      matrix_free_(members.matrix_free),
      differences_(members.differences),
      state_f_(members.state_f),
      least_trial_threshold_(trial_cost + members.jacobian_cost),
      trial_threshold_(least_trial_threshold_) {
  assert(active_ != nullptr && !implicit_ == (algebra_ == nullptr));
  if (!explicit_ || !implicit_) return;
  for (std::vector<double>* v : {&start_y_, &vector_, &product_}) v->resize(n());
  if (matrix_free_ && differences_) f_value_.resize(n());
}

std::size_t Switching::max_extension_size() const {
  return 1 + most_of([](const Step& member) { return member.max_extension_size(); });
}

int Switching::max_degree() const {
  return most_of([](const Step& member) { return member.max_degree(); });
}

std::size_t Switching::max_directions() const {
  return most_of([](const Step& member) { return member.max_directions(); });
}

Status Switching::extension(double* data) {
  data[0] = number_of_extension(active_->interpolate());
  return active_->extension(data + 1);
}

Status Switching::extension_of_attempt(double* data, std::size_t& size) {
  data[0] = number_of_extension(active_->interpolate());
  const Status status = active_->extension_of_attempt(data + 1, size);
  ++size;
  return status;
}

/// Starts the active member, which after a jump is the one that was active before.
Outcome Switching::start(double t, const double* y, const Span& span) {
  const Outcome outcome = active_->start(t, y, span);
  if (outcome != Outcome::ok) return outcome;
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  h_ = active_->h();
  begin_turn();
  return outcome;
}

/// Evaluations of f so far, and products with J that take none.
std::int64_t Switching::cost() const {
  return f_.calls() + (state_f_ != nullptr ? state_f_->calls() : 0) +
         (matrix_free_ && !differences_ ? implicit_->linear_work().products : 0);
}

void Switching::begin_turn() {
  turn_ = {.calls = cost(), .t = t_};
  wanted_ = false;
  calls_ = cost();
}

// ------------------------------------------------------------------------------------------------------- the hand-over

/// Starts the other member, unless it cannot start, or only with steps near the smallest ones.
Outcome Switching::hand_over(const Span& span) {
  const bool looks = explicit_ && matrix_free_ && active_ == implicit_.get() && turn_.steps % new_radius == 0;
  if (looks && find_radius() == Status::stop) return Outcome::stop;
  if (explicit_ && implicit_ && stays_) wanted_ = active_ == implicit_.get();
  if (!wanted_ || !pays(std::abs(span.tf - t_))) return Outcome::ok;
  wanted_ = false;
  const bool to_implicit = active_ == explicit_.get();
  Step& next = to_implicit ? *implicit_ : *explicit_;
  switch (next.start(t_, y(), span)) {
    case Outcome::stop: return Outcome::stop;
    case Outcome::not_finite: raise_trial_threshold(); return Outcome::ok;
    case Outcome::ok: break;
  }
  if (next.h() < room * span.hmin) {
    turn_.spent = turn_.favourable = 0;
    return Outcome::ok;
  }
  if (!to_implicit) judge_implicit_turn();
  const double before = h_, calls = to_implicit ? explicit_calls_ : implicit_calls_;
  h_ = std::min({initial_step_after(next, before), span.hmax, std::abs(span.tf - t_)});
  active_ = &next;
  ++switches_;
  begin_turn();
  turn_.handed_over = true;
  turn_.h_before = before;
  turn_.speed_before = before / calls;
  implicit_calls_ = 0;
  return to_implicit && matrix_free_ && find_radius() == Status::stop ? Outcome::stop : Outcome::ok;
}

/// Would the explicit member spend more on the rest of the interval than on a trial?
bool Switching::pays(double distance) const {
  return active_ != explicit_.get() || distance / h_ * explicit_calls_ > trial_threshold_;
}

/// A first |h| is chosen with caution. Steps that were short for the sake of stability are accurate for the implicit
/// member too; what was accurate with that one is for the explicit member, where it is stable.
double Switching::initial_step_after(const Step& next, double before) const {
  const double known = &next == implicit_.get() ? before : std::min(before, stable_h());
  return std::max(next.h(), known);
}

void Switching::judge_implicit_turn() {
  const double speed = std::abs(t_ - turn_.t) / static_cast<double>(cost() - turn_.calls);
  if (speed < turn_.speed_before)
    raise_trial_threshold();
  else
    trial_threshold_ = least_trial_threshold_;
}

/// The next trial has to wait longer.
void Switching::raise_trial_threshold() {
  trial_threshold_ = std::min(backoff * trial_threshold_, highest_threshold * least_trial_threshold_);
}

/// Rejects the attempt; if the first step after a hand-over fails again and again, the member before takes over.
bool Switching::reject(Cause cause, double hmin) {
  const bool more = active_->reject(cause, hmin);
  h_ = active_->h();
  if (!turn_.handed_over || turn_.steps > 0) return more;
  if (more && ++turn_.failures < most_failures) return true;
  active_ = active_ == explicit_.get() ? implicit_.get() : explicit_.get();
  h_ = turn_.h_before;
  raise_trial_threshold();
  ++switches_;
  begin_turn();
  return true;
}

void Switching::end_attempts() {
  for (Step* member : {explicit_.get(), implicit_.get()})
    if (member != nullptr) member->end_attempts();
}

/// Archives both members: where the first step after a hand-over fails, the member before resumes.
void Switching::state(Archive& archive) {
  Step::state(archive);
  for (Step* member : {explicit_.get(), implicit_.get()})
    if (member != nullptr) member->state(archive);
  bool implicit_is_active = active_ == implicit_.get();
  archive(implicit_is_active, wanted_, switches_, trial_threshold_, explicit_calls_, implicit_calls_, calls_, radius_,
          reach_, jacobians_);
  archive(turn_.steps, turn_.calls, turn_.t, turn_.handed_over, turn_.h_before, turn_.speed_before, turn_.failures,
          turn_.last_h, turn_.spent, turn_.free, turn_.favourable);
  if (!archive.reading()) return;
  active_ = implicit_is_active ? implicit_.get() : explicit_.get();
  archive.require(active_ != nullptr);
}

// ------------------------------------------------------------------------------------------------- after a step

Outcome Switching::accept(const double* y1) {
  active_->moved_onto_bounds(moved_onto_bounds_);
  const Outcome outcome = active_->accept(y1);
  if (outcome != Outcome::ok) return outcome;
  const bool choice = explicit_ && implicit_;
  if (choice) start_y_.swap(y_);
  t_ = active_->t();
  std::copy(active_->y(), active_->y() + n(), y_.begin());
  h_ = active_->h();
  ++turn_.steps;
  if (!choice) return outcome;
  const auto calls = static_cast<double>(cost() - std::exchange(calls_, cost()));
  if (active_ == explicit_.get())
    watch_explicit(calls);
  else
    watch_implicit(calls);
  return outcome;
}

/// A step at the limit of stability counts the more, the less it changes.
void Switching::watch_explicit(double calls) {
  average(explicit_calls_, calls);
  const bool looks = turn_.steps <= first_steps || turn_.spent > 0 || turn_.steps % look_every == 0;
  if (!looks) return;
  const StepLook step = look_at(*explicit_, weights_, start_y_.data());
  const bool limited = step.at_limit && step.moved <= largest_change && explicit_->real_limit() >= low_order;
  if (!limited) {
    if (++turn_.free >= end_of_streak) turn_.spent = 0;
    return;
  }
  turn_.free = 0;
  turn_.spent += calls * std::clamp(StepLook::slow / step.moved, 1.0, strongest);
  wanted_ = turn_.spent >= trial_threshold_;
}

void Switching::watch_implicit(double calls) {
  average(implicit_calls_, calls);
  if (const std::int64_t taken = implicit_->linear_work().jacobians;
      !matrix_free_ && (taken != jacobians_ || turn_.steps == 1)) {
    jacobians_ = taken;
    static_cast<void>(find_radius());  // of a matrix, it calls nothing
  }
  if (turn_.handed_over && turn_.steps == 1) reach_ = turn_.h_before * radius_;
  const double explicit_h = std::min(stable_h(), explicit_gain * explicit_calls_ * h_);
  const bool cheaper = explicit_calls_ / explicit_h < (implicit_calls_ + overhead) / h_;
  const bool grows = turn_.last_h > 0 && h_ > growing * turn_.last_h;
  turn_.favourable = cheaper && !grows ? turn_.favourable + 1 : 0;
  turn_.last_h = h_;
  wanted_ = turn_.favourable >= favourable_steps;
}

/// |h| with which explicit steps are stable.
double Switching::stable_h() const { return stable_part * reach_ / radius_; }

/// ρ(J), by powers of J, from a vector with a part in every direction.
Status Switching::find_radius() {
  if (!f_value_.empty() && f_(t_, y(), f_value_.data()) == Status::stop) return Status::stop;
  const std::size_t states = algebra_->jacobian()->n();  // sensitivities have the same J
  const auto size = [&](const std::vector<double>& v) {
    return max_norm(states, [&](std::size_t i) { return v[i] / weights_.at(i, y_[i]); });
  };
  for (std::size_t i = 0; i < states; ++i) {
    const double part = 1 + spread(i);
    vector_[i] = weights_.at(i, y_[i]) * (i % 2 == 0 ? part : -part);
  }
  double sum = 0;  // of the logarithms
  for (int k = 0; k < powers; ++k) {
    if (multiply_vector() == Status::stop) return Status::stop;
    radius_ = size(product_) / size(vector_);
    if (!(radius_ > 0)) break;  // J is 0, or not finite
    for (std::size_t i = 0; i < states; ++i) vector_[i] = product_[i] / radius_;
    if (k >= first_power) sum += std::log(radius_);
    if (k + 1 == powers) radius_ = std::exp(sum / (powers - first_power));
  }
  calls_ = cost();  // that was not part of a step
  return Status::ok;
}

/// The vector times J.
Status Switching::multiply_vector() {
  if (matrix_free_) return algebra_->multiply_jacobian(f_value_.data(), vector_.data(), product_.data());
  algebra_->jacobian()->multiply(vector_.data(), product_.data());
  return Status::ok;
}

}  // namespace invariode
