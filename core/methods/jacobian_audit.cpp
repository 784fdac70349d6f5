#include "methods/jacobian_audit.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <utility>

namespace invariode {
namespace {

// Differences of f that tell branches apart consist of so many roundoffs, and differ by more than this part from J e.
constexpr double resolved = 1000, of_another_branch = 0.5;

// How far from y, in units of the weights, J is tested: rtol, or where that is large this, since f may end there.
constexpr double widest_reach = 1e-3;
constexpr double on_one_side = 0.25;      // of that, from a point half of it at least away from where f jumps
const double part_of_y = std::sqrt(eps);  // in which missing entries are sought
constexpr double suspicious_growth = 10;  // of the size of J

}  // namespace

JacobianAudit::JacobianAudit(Jacobian& jacobian, Callback& f, const Weights& weights)
    : jacobian_(jacobian),
      f_(f),
      weights_(weights),
      check_(weights.size()),
      reach_(weights.size()),
      branch_y_(weights.size()) {}

void JacobianAudit::begin(double t, const double* y) {
  branch_examined_ = false;
  note_branch(t, y);
}

Status JacobianAudit::look(double t, const double* y, const double* slope) {
  if (slope != nullptr) return due(y) ? fit_or_mend(t, y, slope) : Status::ok;
  if (jacobian_.kind() != Jacobian::Kind::function || !due(y)) return Status::ok;
  std::vector<double> value(weights_.size());
  switch (evaluate(t, y, value.data())) {
    case Outcome::stop: return Status::stop;
    case Outcome::not_finite: return Status::ok;
    case Outcome::ok: break;
  }
  return fit_or_mend(t, y, value.data());
}

Outcome JacobianAudit::evaluate(double t, const double* y, double* out) {
  Callback f = f_;
  ++evaluations_;
  if (f(t, y, out) == Status::stop) return Outcome::stop;
  jacobian_.extend(y, out);
  return all_finite(out, weights_.size()) ? Outcome::ok : Outcome::not_finite;
}

/// The first J of a start, the evaluations 1, 2, 4, 8, …, and one that has grown much beyond those that fitted. Of
/// those that are given, which no look can improve, the evaluations 1, 2, 4, 8, … until one does not fit: at the start
/// many of their entries may not count. A J that is not larger than the right one cannot make Newton's iteration look
/// converged.
bool JacobianAudit::due(const double* y) {
  const bool first = std::exchange(first_, false);
  const bool in_turn = std::has_single_bit(static_cast<std::uint64_t>(jacobian_.count()));
  if (!jacobian_.computed()) return !fitting_ || (in_turn && !misfit_ && jacobian_.kind() == Jacobian::Kind::function);
  if (first || !fitting_ || in_turn) return true;
  weights_.fill(y, reach_.data());
  return check_.size(jacobian_.matrix(), reach_.data()) > suspicious_growth * *fitting_;
}

/// J is to describe f as far as steps are accurate: otherwise Newton's iteration may seem to converge at once, to what
/// does not solve the equations. This takes evaluations of f that are counted apart.
Status JacobianAudit::fit_or_mend(double t, const double* y, const double* slope) {
  Callback f = f_;
  // Columns that are differenced together and share a row after all fit in the direction of the increments: random
  // signs tell them apart, in parts of y that leave its signs as they are.
  const auto seek_missing = [&] {
    if (!jacobian_.computed() || jacobian_.matrix().structure.kind == Structure::Kind::dense) return Status::ok;
    for (std::size_t j = 0; j < reach_.size(); ++j) reach_[j] = part_of_y * std::abs(y[j]);
    const auto turn = static_cast<std::size_t>(jacobian_.count());
    switch (check_.examine(f, t, y, slope, jacobian_.matrix(), reach_.data(), turn, jacobian_.box())) {
      case JacobianCheck::Verdict::stop: return Status::stop;
      case JacobianCheck::Verdict::wrong: return jacobian_.complete(f, t, y, slope, check_.direction());
      case JacobianCheck::Verdict::right: break;
    }
    return Status::ok;
  };
  Status result = Status::stop;
  switch (fit(f, t, y, slope, 1)) {
    case JacobianCheck::Fit::stop: break;
    case JacobianCheck::Fit::good: result = seek_missing(); break;
    case JacobianCheck::Fit::wrong: result = mend(f, t, y, slope); break;
    case JacobianCheck::Fit::bent: result = take_beside(f, t, y); break;
  }
  evaluations_ += f.calls() - f_.calls();
  weights_.fill(y, reach_.data());
  fitting_ = std::max(fitting_.value_or(0), check_.size(jacobian_.matrix(), reach_.data()));
  check_.rest();
  return result;
}

/// Judges J as far as that part of the tolerance.
JacobianCheck::Fit JacobianAudit::fit(Callback& f, double t, const double* y, const double* slope, double part) {
  const double reach = part * std::min(weights_.rtol(), widest_reach);
  for (std::size_t j = 0; j < reach_.size(); ++j) reach_[j] = reach * jacobian_.scale(j, y);
  const auto turn = static_cast<std::size_t>(jacobian_.count());
  const bool again = jacobian_.kind() == Jacobian::Kind::function && turn > 1;  // other signs may show more
  return check_.fit(f, t, y, slope, jacobian_.matrix(), reach_.data(), turn, jacobian_.box(), again);
}

/// f jumps, or bends sharply, within the tolerance: J is taken on the side to which f leads.
Status JacobianAudit::take_beside(Callback& f, double t, const double* y) {
  const std::size_t n = weights_.size();
  if (jacobian_.kind() == Jacobian::Kind::constant) return Status::ok;
  std::vector<double> point(y, y + n), slope(n);
  for (std::size_t j = 0; j < n; ++j) point[j] += check_.direction()[j];
  if (f(t, point.data(), slope.data()) == Status::stop) return Status::stop;
  if (!all_finite(slope.data(), n)) return Status::ok;
  note_branch(t, point.data());
  if (jacobian_.evaluate(f, t, point.data(), slope.data()) == Status::stop) return Status::stop;
  switch (fit(f, t, point.data(), slope.data(), on_one_side)) {
    case JacobianCheck::Fit::stop: return Status::stop;
    case JacobianCheck::Fit::wrong:
      if (mend(f, t, point.data(), slope.data()) == Status::stop) return Status::stop;
      break;
    case JacobianCheck::Fit::good:
    case JacobianCheck::Fit::bent: break;
  }
  return Status::ok;
}

/// f is smooth, and J is not its derivative: entries are missing, increments are too small for the noise of f, or the
/// user's function is wrong.
Status JacobianAudit::mend(Callback& f, double t, const double* y, const double* slope) {
  if (jacobian_.computed()) return jacobian_.complete(f, t, y, slope, check_.direction());
  if (jacobian_.kind() == Jacobian::Kind::derived) return Status::ok;
  if (!misfit_ && !check_.understates())
    misfit_ = Misfit{.kind = Misfit::Kind::matrix,
                     .t = t,
                     .row = check_.row(),
                     .change = check_.change(),
                     .predicted = check_.predicted()};
  return Status::ok;
}

void JacobianAudit::note_branch(double t, const double* y) {
  branch_t_ = t;
  std::copy_n(y, branch_y_.size(), branch_y_.begin());
}

JacobianAudit::Fitness JacobianAudit::examine(double c, double t, const double* y, const double* r, const double* w) {
  const std::size_t n = weights_.size();
  const auto evaluate_here = [](void* self, double at, const double* point, double* out) {
    return static_cast<JacobianAudit*>(self)->evaluate(at, point, out) == Outcome::stop ? Status::stop : Status::ok;
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
void JacobianAudit::find_increment(const double* y, const double* r, const double* w) {
  const std::size_t n = weights_.size();
  increment_.resize(n);
  changes_.resize(n);
  std::fill(reach_.begin(), reach_.end(), 0);
  jacobian_.matrix().for_each([&](std::size_t i, std::size_t j, double value) {
    reach_[i] += roundoffs_of_f * eps * std::abs(value) * std::max(std::abs(y[j]), std::abs(branch_y_[j]));
  });
  jacobian_.matrix().multiply(r, changes_.data());
  std::size_t row = 0;
  for (std::size_t i = 1; i < n; ++i)
    if (std::abs(changes_[i] / w[i]) > std::abs(changes_[row] / w[row])) row = i;
  const double part = changes_[row] != 0 ? resolved * reach_[row] / std::abs(changes_[row]) : 0;
  for (std::size_t j = 0; j < n; ++j) {
    increment_[j] = part * r[j];
    changes_[j] *= part;
  }
}

/// Tests whether J e is the change of f to both sides of where J was taken. `not_finite`: it is not, beyond the
/// roundoff in `reach_`: the point is on a kink, or differences have led through one.
Outcome JacobianAudit::examine_branch(Callback& f, const double* w) {
  const std::size_t n = weights_.size();
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

void JacobianAudit::state(Archive& archive) {
  archive(evaluations_, fitting_, misfit_, first_, branch_t_, branch_y_, branch_examined_);
}

}  // namespace invariode
