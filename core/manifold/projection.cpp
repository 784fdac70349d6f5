#include "manifold/projection.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>

#include "manifold/gradient.hpp"

namespace invariode {
namespace {

// A pivot's row depends on the others below this part of the largest: max(rtol, least_pivot), but never above
// largest_pivot, however crude rtol is; and below what an error of the derivatives makes of a row that depends on them.
constexpr double least_pivot = 1e-10;
constexpr double largest_pivot = 0.1;
constexpr double derivative_errors = 100;  // in units of ε^{2/3}, ε^{1/2}: rows are sums of several entries
// Along given directions: an invariant whose gradient has less than this share of its length among them is left out of
// a step, since its correction would be longer by the inverse; which matters if it is off by so much of the tolerance.
constexpr double least_share = 0.01;
constexpr double matters = 1e-3;
constexpr double least_direction = 1e-12;  // of vectors that are good to some ε
// Of the largest term of a gradient: below it a coefficient is what computing the others has left of 0 (laws from a
// singular value decomposition of 30 species: some ε; measured up to 2e-15).
constexpr double roundoff_of_coefficients = 1e-13;
constexpr double slight = 1.0 / 16;   // a power that orders parts from 1e-13 to 1, and leaves them within a factor of 7
constexpr double often = 0.2;         // share of corrections and of time in which redundant ones depend on others,
constexpr double now_and_then = 0.1;  // and in which each of them is the one that is left out
constexpr int impose_iterations = 50;
constexpr int impose_patience = 2;  // iterations without a gain: roundoff is reached, or there is no way on
constexpr double recovery = 0.5;    // of the residual before: Newton's iteration comes back from a step too far

double norm2(const double* v, std::size_t n) {
  const double sum = sum_of_squares(v, n);
  if (sum > small_square && sum < large_square) return std::sqrt(sum);
  return Eigen::Map<const Eigen::VectorXd>(v, index(n)).stableNorm();
}

/// Returns the tolerances as units of the components; without an absolute tolerance the largest of the others, or 1.
std::vector<double> units_of(const Weights& weights) {
  std::vector<double> unit = weights.threshold();
  double largest = 0;
  for (std::size_t j = 0; j < unit.size(); ++j)
    if (!weights.pure_relative(j)) largest = std::max(largest, unit[j]);
  for (std::size_t j = 0; j < unit.size(); ++j)
    if (weights.pure_relative(j)) unit[j] = largest > 0 ? largest : 1;
  return unit;
}

}  // namespace

Projector::Projector(Invariants& invariants, const Weights& weights, int iterations, double negligible,
                     const Projector* partner)
    : invariants_(invariants),
      n_(invariants.n()),
      m_(invariants.m()),
      tolerances_(weights),
      iterations_(iterations),
      negligible_(negligible * weights.rtol()),
      at_{&invariants.layout(), std::vector<double>(m_), std::vector<double>(m_), {}, {}, {}},
      residual_before_(m_),
      distance_before_(m_),
      unit_(m_),
      room_(partner != nullptr ? partner->room_ : std::make_shared<Room>()),
      left_out_(m_),
      dropped_(m_) {
  assert(partner == nullptr || &partner->invariants_ == &invariants);
  if (partner == nullptr) {
    room_->delta.resize(n_);
    if (Levels::needed(invariants))
      room_->levels.emplace(invariants);
    else
      room_->basis.provide(n_, m_);
    provide();
  }
  if (invariants.any_one_sided()) idle_.resize(m_);
  rest_one_sided();
  one_sided_ = idle_count_;
}

/// Returns W of the linearization, whose memory is made when it is first asked for: some projectors are never used.
double* Projector::provide() {
  at_.y.resize(n_);
  at_.J.resize(invariants_.layout().size());
  at_.w.resize(n_);
  return at_.w.data();
}

Projected Projector::project(double t, const double* from, double* y) {
  tolerances_.fill(from, y, provide());
  room_->original.assign(y, y + n_);
  Projected did{.residual = residual_before_, .distance = distance_before_};
  did.outcome = measure(t, y);
  if (did.outcome != Outcome::ok) return did;
  did.skipped = all_idle() || close_enough(y);
  if (did.skipped) return did;
  bool doubtful = false;
  for (int iteration = 0; iteration < iterations_; ++iteration) {
    if (iteration > 0 && invariants_.residual(t, y, at_.r.data()) == Status::stop) did.outcome = Outcome::stop;
    if (iteration > 0 && did.outcome == Outcome::ok && correct_again(y)) break;
    if (did.outcome == Outcome::ok) did.outcome = linearize_known(t, y);
    if (did.outcome != Outcome::ok) return did;
    if (iteration == 0) {
      for (std::size_t i = 0; i < m_; ++i) distance_before_[i] = idle(i) ? 0 : at_.distance(i);
      doubtful = far_off(y);
    }
    did.rank = solve(t);
    doubtful = doubtful || bends(from, y);
    for (std::size_t i = 0; i < n_; ++i) y[i] -= room_->delta[i];
    if (room_->levels && settled()) break;
  }
  did.correction = max_norm(n_, [&](std::size_t i) { return (room_->original[i] - y[i]) / at_.w[i]; });
  if (!std::isfinite(did.correction)) did.outcome = Outcome::not_finite;
  if (did.outcome == Outcome::ok && (doubtful || crossed_zero(y))) did.outcome = measure_after(t, y);
  return did;
}

Outcome Projector::onto(double t, const double* w, const double* target, double* y, int most) {
  std::copy(w, w + n_, provide());
  for (int iteration = 0; iteration < most; ++iteration) {
    if (invariants_.residual(t, y, at_.r.data()) == Status::stop) return Outcome::stop;
    for (std::size_t i = 0; i < m_; ++i) at_.r[i] -= target[i];
    if (iteration > 0 && correct_again(y)) break;
    if (const Outcome outcome = linearize_known(t, y); outcome != Outcome::ok) return outcome;
    solve(t);
    for (std::size_t i = 0; i < n_; ++i) y[i] -= room_->delta[i];
    if (settled()) break;
  }
  return all_finite(y, n_) ? Outcome::ok : Outcome::not_finite;
}

/// Makes Newton's next correction δ' with the gradients of the last correction δ, if that leaves no more than roundoff:
/// along δ the gradients have changed by the fraction 2 |δ'| / |δ|, since r(y − δ) is half of their change times δ, and
/// this fraction of δ' is left. Distances decide, and with several invariants the corrections too.
bool Projector::correct_again(double* y) {
  const auto negligible = [&](double size, double before) {
    for (std::size_t i = 0; i < m_; ++i) {
      if (idle(i) || left_out(i)) continue;
      const double terms = size_of_terms(invariants_.value()[i], at_.gradient(i), at_.y.data());
      if (!(2 * size * size * at_.norm[i] <= eps * terms * before)) return false;
    }
    return true;
  };
  if (!all_finite(at_.r.data(), m_) || !negligible(largest_distance(), distance_)) return false;
  const double before = size_of_correction();
  correction_for(at_.r.data(), room_->delta.data(), unit_.data());
  if (m_ > 1 && !negligible(size_of_correction(), before)) return false;
  for (std::size_t i = 0; i < n_; ++i) y[i] -= room_->delta[i];
  return true;
}

/// Returns the largest distance from a level set in units of the weights, of the invariants that take part.
double Projector::largest_distance() const {
  double largest = 0;
  for (std::size_t i = 0; i < m_; ++i)
    if (!idle(i) && !left_out(i)) largest = std::max(largest, at_.distance(i));
  return largest;
}

void Projector::seek_along(std::span<const double* const> vectors) {
  if (!directions_) directions_.emplace(n_);
  directions_->take(vectors);
}

/// Cuts the rows to the directions. A part p of a vector that the others do not have has roundoff ε / p in the laws
/// that the vectors keep; in a correction of size d that is no more than ε where p ≥ d.
void Projector::keep_to_directions() {
  double largest = least_direction;
  for (std::size_t i = 0; i < m_; ++i)
    if (!idle(i)) largest = std::max(largest, at_.distance(i));
  directions_->orthonormalize(at_.w.data(), std::min(largest, largest_pivot));
  for (std::size_t i = 0; i < m_; ++i)
    if (at_.norm[i] > 0) directions_->cut(room_->basis.vector(i).data());
}

/// Returns whether only `share` of the length of gradient i is left among the directions, too little to correct its
/// residual.
bool Projector::out_of_reach(std::size_t i, double share) const {
  return directions_ && share < least_share && std::abs(at_.r[i]) > matters * tolerances_.rtol() * at_.norm[i];
}

Outcome Projector::linearize_at(double t, const double* y) {
  tolerances_.fill(y, provide());
  return linearize(t, y);
}

Outcome Projector::factorize_at(double t, const double* y) {
  const Outcome outcome = linearize_at(t, y);
  if (outcome == Outcome::ok) solve(t);
  return outcome;
}

void Projector::correction_for(const double* r, double* delta, const double* noise) {
  if (rank_ == 0)
    std::fill_n(delta, n_, 0);
  else if (room_->levels)
    room_->levels->solve(at_.J.data(), r, noise != nullptr ? noise : std::vector<double>(m_).data(), movable_w_,
                         pivot_threshold(), apart_, delta);
  else if (m_ == 1)
    correct_one(r[0], delta);
  else
    apply_factors(r, delta);
}

Imposed Projector::impose(double t, double* y) {
  room_->original.assign(y, y + n_);
  const Imposed imposed = approach(t, y);
  if (!imposed.converged) std::copy(room_->original.begin(), room_->original.end(), y);
  return imposed;
}

Imposed Projector::approach(double t, double* y) {
  tolerances_.fill(y, provide());
  room_->best.assign(y, y + n_);
  double first = 0, before = 0, least = std::numeric_limits<double>::infinity();
  int iterations = 0;
  for (int without_gain = 0; iterations < impose_iterations && without_gain < impose_patience; ++iterations) {
    const Outcome outcome = linearize(t, y);
    if (outcome == Outcome::stop) return {.outcome = outcome, .iterations = iterations};
    if (outcome == Outcome::not_finite) break;
    const double left = in_units();  // in the units of the iterate before: units grow with the terms, as residuals do
    take_units(y);
    const double size = in_units();
    if (size < least) {
      if (iterations == 0) first = size;
      least = size;
      without_gain = 0;
      room_->best.assign(y, y + n_);
      if (size == 0) break;
    } else if (size <= 1 || !(left <= recovery * before)) {
      ++without_gain;
    }
    before = size;
    solve(t);
    for (std::size_t i = 0; i < n_; ++i) y[i] -= room_->delta[i];
  }
  std::copy(room_->best.begin(), room_->best.end(), y);
  return {.outcome = Outcome::ok, .converged = least <= 1, .iterations = iterations, .gain = least / first};
}

/// Takes the sizes below which residuals at y, where J is known, are roundoff.
void Projector::take_units(const double* y) {
  const double* size = invariants_.sizes(y);
  for (std::size_t i = 0; i < m_; ++i) unit_[i] = std::max(noise(i, y, size), std::numeric_limits<double>::min());
}

/// Returns the residual that roundoff of g and of the point y, of these sizes, makes of invariant i.
double Projector::noise(std::size_t i, const double* y, const double* size) const {
  const double* J = at_.J.data();
  return std::max(invariants_.roundoff(i, y, J), invariants_.resolution(i, size, J));
}

/// Returns the largest residual, in the units that were taken last.
double Projector::in_units() const {
  double size = 0;
  for (std::size_t i = 0; i < m_; ++i)
    if (!idle(i)) size = std::max(size, std::abs(at_.r[i]) / unit_[i]);
  return size;
}

/// Takes the residual of a candidate.
Outcome Projector::measure(double t, const double* y) {
  if (invariants_.residual(t, y, at_.r.data()) == Status::stop) return Outcome::stop;
  if (!defined(at_.r.data())) return Outcome::not_finite;
  residual_before_ = at_.r;
  return Outcome::ok;
}

/// Checks that g is defined at y₁, and that Newton's iteration has led towards the manifold, not away from a pole or to
/// another branch. The linearization stays the last one.
Outcome Projector::measure_after(double t, const double* y) {
  std::vector<double>& after = unit_;  // whose sizes this projection has used
  if (invariants_.residual(t, y, after.data()) == Status::stop) return Outcome::stop;
  if (!defined(after.data())) return Outcome::not_finite;
  const double allowed = std::pow(slowest_newton, iterations_);
  const double largest = *std::ranges::max_element(distance_before_);
  const double* size = invariants_.sizes(y);
  for (std::size_t i = 0; i < m_; ++i) {
    if (left_out_[i] != 0 || idle(i)) continue;
    const double left = std::abs(after[i]);
    if (left > noise(i, y, size) && left > allowed * std::abs(residual_before_[i]) &&
        left > allowed * (largest * at_.norm[i]))
      return Outcome::not_finite;
  }
  return Outcome::ok;
}

/// Returns whether a residual is of the size of its terms, so that the correction changes some of them by as much.
bool Projector::far_off(const double* y) const {
  for (std::size_t i = 0; i < m_; ++i) {
    if (idle(i)) continue;
    if (std::abs(at_.r[i]) > large_residual * size_of_terms(invariants_.value()[i], at_.gradient(i), y)) return true;
  }
  return false;
}

bool Projector::defined(const double* r) {
  undefined_ = -1;
  for (std::size_t i = m_; i-- > 0;)
    if (!std::isfinite(r[i])) undefined_ = static_cast<int>(i);
  return undefined_ < 0;
}

/// Returns whether the gradients of the invariants may change in the correction by as much as they are, as near the end
/// of a domain, judged by how they have changed in the step.
bool Projector::bends(const double* from, const double* y) const {
  return bent_ > slight_bend && bends_sharply(bent_, from, y, room_->delta.data(), n_);
}

/// Returns whether the projection took a component to the other side of 0, where logarithms and roots are not defined.
bool Projector::crossed_zero(const double* y) const {
  for (std::size_t i = 0; i < n_; ++i)
    if (room_->original[i] * y[i] < 0) return true;
  return false;
}

/// Returns the factor by which a distance judged by the last gradients may be wrong: these change by (1 + d)³ at most
/// over a distance of d sizes of the components, if g is made of powers to the third.
double Projector::doubt(const double* y) const {
  const auto moved = [&](std::size_t i) { return (y[i] - at_.y[i]) / std::min(at_.w[i], linearized_w_[i]); };
  const double factor = 1 + max_norm(n_, moved);
  return factor * factor * factor;
}

/// Returns whether the candidate is to be left alone: judged by the gradients of the last linearization.
bool Projector::close_enough(const double* y) {
  if (negligible_ == 0 || !linearized_ || any_engaged()) return false;
  const double most = negligible_ / doubt(y);
  for (std::size_t i = 0; i < m_; ++i) {
    distance_before_[i] = idle(i) ? 0 : at_.distance(i);
    if (!(distance_before_[i] <= most)) return false;
  }
  return true;
}

Outcome Projector::linearize(double t, const double* y) {
  if (invariants_.residual(t, y, at_.r.data()) == Status::stop) return Outcome::stop;
  return linearize_known(t, y);
}

/// Linearizes at (t, y), where the residual is known already.
Outcome Projector::linearize_known(double t, const double* y) {
  const std::size_t n = n_, m = m_;
  std::copy(y, y + n, at_.y.begin());
  if (invariants_.jacobian(t, y, at_.J.data()) == Status::stop) return Outcome::stop;
  if (room_->levels && room_->levels->update(t, y) == Status::stop) return Outcome::stop;
  if (!defined(at_.r.data())) return Outcome::not_finite;
  for (std::size_t i = 0; i < m; ++i)
    if (const Row row = at_.gradient(i); !all_finite(row.values, row.size)) {
      undefined_ = static_cast<int>(i);
      return Outcome::not_finite;
    }
  bent_ = 0;
  if (negligible_ > 0) linearized_w_ = at_.w;
  for (std::size_t i = 0; i < m; ++i) {
    const double before = at_.norm[i];
    scale_row(i);
    if (linearized_ && !idle(i)) bent_ = std::max(bent_, bend(at_.norm[i], before));
  }
  linearized_ = true;
  if (directions_) keep_to_directions();
  return Outcome::ok;
}

/// Returns a factor of row i that settles ties between pivots in favour of the invariant that was given first; those
/// that may only rise or fall come last, and of those that components fixed at bounds make dependent the one that has
/// lost least: its residual has the least roundoff in units of what is left. (A row and its residual may be multiplied
/// by anything.)
double Projector::preference(std::size_t i) const {
  const std::size_t place = invariants_.sense(i) == 0 ? i : i + m_;
  const double first = 1 / (1 + 1e-6 * static_cast<double>(place));
  return m_ == 1 || movable_.empty() || movable_[i] == 1 ? first : first * std::pow(movable_[i], slight);
}

/// Returns the largest coefficient that components which may move have in invariant i, as a part of the largest of all.
/// In the units of the tolerances: in those of the weights, a component at its bound 0 would hardly count.
double Projector::movable_part(std::size_t i) const {
  double all = 0, free = 0;
  at_.gradient(i).for_each([&](std::size_t j, double value) {
    const double term = std::abs(value) * unit_of_component_[j];
    all = std::max(all, term);
    if (!fixed(j)) free = std::max(free, term);
  });
  return all > 0 ? free / all : 0;
}

/// Returns whether only the roundoff of its coefficients is left of invariant i, since components are fixed.
bool Projector::stuck(std::size_t i) const { return !movable_.empty() && movable_[i] <= roundoff_of_coefficients; }

double Projector::roundoff(std::size_t i, const double* y) {
  const double roundoff = noise(i, y, invariants_.sizes(y));
  if (!any_fixed()) return roundoff;
  double largest = 0, sizes = 0;
  at_.gradient(i).for_each([&](std::size_t j, double value) {
    largest = std::max(largest, std::abs(value) * unit_of_component_[j]);
    sizes += std::abs(y[j]) / unit_of_component_[j];
  });
  return std::max(roundoff, roundoff_of_coefficients * largest * sizes);
}

/// Computes the norm of row i of J W and, where all invariants are corrected together, the row itself with norm 1.
/// Fixed components are left out, unless nothing else is left: the norm is then that of all of them, and the row 0.
/// (Levels scale rows themselves.)
void Projector::scale_row(std::size_t i) {
  const std::size_t n = n_;
  const Row gradient = at_.gradient(i);
  const bool sparse = gradient.columns != nullptr;
  double* row = room_->levels ? room_->delta.data() : room_->basis.vector(i).data();
  if (sparse && !room_->levels) std::fill(row, row + n, 0.0);
  if (!movable_.empty()) movable_[i] = any_fixed() ? movable_part(i) : 1;
  if (sparse || any_fixed()) {
    std::size_t k = 0;
    gradient.for_each([&](std::size_t j, double value) {
      row[room_->levels ? k++ : j] = fixed(j) && !stuck(i) ? 0 : value * at_.w[j];
    });
  } else {
    for (std::size_t j = 0; j < n; ++j) row[j] = gradient.values[j] * at_.w[j];
  }
  at_.norm[i] = norm2(row, room_->levels ? gradient.size : n);
  if (!(at_.norm[i] > 0) || room_->levels) return;
  const double factor = stuck(i) ? 0 : preference(i) / at_.norm[i];
  for (std::size_t j = 0; j < n; ++j) row[j] *= factor;
}

/// Writes δ = W (J W)⁺ r of the last linearization, and returns its rank. One row needs no factorisation.
std::size_t Projector::solve(double t) {
  std::fill(left_out_.begin(), left_out_.end(), 0);
  rank_ = room_->levels ? solve_in_levels(t) : m_ > 1 ? solve_several(t) : solve_one(t);
  count_correction(t, rank_);
  distance_ = largest_distance();
  return rank_;
}

/// Counts for the verdict which invariants are redundant, about which corrections with fixed components say nothing.
void Projector::count_correction(double t, std::size_t rank) {
  if (any_fixed()) return;
  const double since = corrections_ == 0 ? 0 : std::abs(t - corrected_at_);
  corrected_at_ = t;
  ++corrections_;
  covered_ += since;
  if (rank == m_ - idle_count_ || std::count(left_out_.begin(), left_out_.end(), 0) == std::ssize(left_out_)) return;
  ++deficient_;
  covered_deficient_ += since;
}

std::size_t Projector::solve_one(double t) {
  const double share = directions_ ? room_->basis.vector(0).norm() : 1;
  const bool immovable = at_.norm[0] == 0 || stuck(0) || all_idle();
  if (!immovable && !(share < least_share)) {
    correct_one(at_.r[0], room_->delta.data());
    return 1;
  }
  if (immovable ? !all_idle() : out_of_reach(0, share)) leave_out(0, t);
  std::fill(room_->delta.begin(), room_->delta.end(), 0);
  return 0;
}

/// Writes the correction of the only invariant for the residual r.
void Projector::correct_one(double r, double* delta) {
  double distance = r / at_.norm[0];
  if (directions_) {
    const double share = room_->basis.vector(0).norm();
    distance /= share * share;
  }
  correction(at_.w.data(), room_->basis.vector(0).data(), distance, n_, delta);
}

/// Writes W Q z with Rᵀ z = r, where Q R is the basis of (J W)ᵀ; rows that are not in it are left out. What is
/// one-sided depends on the others where it is at its minimum on their manifold, and its residual then falls with its
/// pivot: it stays as long as it can. Where components are fixed, a row also depends on the others if what they leave
/// of it is roundoff of its coefficients: its free part may be a combination of theirs, of the size of that roundoff.
std::size_t Projector::solve_several(double t) {
  room_->order.clear();
  for (std::size_t i = 0; i < m_; ++i)
    if (!idle(i)) room_->order.push_back(i);
  room_->basis.clear();
  double first = 0;
  const double threshold = pivot_threshold();
  const std::size_t rank = room_->basis.add(room_->order, [&](std::size_t i, double size) {
    if (room_->basis.members().empty()) first = size;
    if (!movable_.empty() && size * movable_[i] <= roundoff_of_coefficients * preference(i)) return true;
    return (directions_ && size < least_share) || size <= (invariants_.sense(i) == 0 ? threshold : least_pivot) * first;
  });
  for (std::size_t k = rank; k < room_->order.size(); ++k)
    if (!directions_ || out_of_reach(room_->order[k], 0)) leave_out(room_->order[k], t);
  apply_factors(at_.r.data(), room_->delta.data());
  return rank;
}

void Projector::apply_factors(const double* r, double* delta) {
  std::fill_n(delta, n_, 0);
  const auto right = [&](std::size_t i) { return preference(i) * r[i] / at_.norm[i]; };
  room_->basis.solve(0, right, [&](std::size_t i, double z) {
    const auto q = room_->basis.vector(i);
    for (std::size_t j = 0; j < n_; ++j) delta[j] += at_.w[j] * (q[index(j)] * z);
  });
}

std::size_t Projector::solve_in_levels(double t) {
  const double* w = at_.w.data();
  if (any_fixed()) {
    free_w_ = at_.w;
    for (std::size_t j = 0; j < n_; ++j)
      if (fixed(j)) free_w_[j] = 0;
    w = free_w_.data();
  }
  take_units(at_.y.data());
  room_->levels->keep(any_fixed() ? fixed_.data() : nullptr);
  movable_w_ = w;
  apart_ = without_part();
  const std::size_t rank =
      room_->levels->solve(at_.J.data(), at_.r.data(), unit_.data(), w, pivot_threshold(), apart_, room_->delta.data());
  for (std::size_t i = 0; i < m_; ++i)
    if (room_->levels->left_out()[i] != 0 || (stuck(i) && !idle(i))) leave_out(i, t);
  return rank;
}

/// Returns which invariants take no part in the correction, being idle or stuck; null: all take part.
const char* Projector::without_part() {
  if (!any_fixed()) return idle_count_ > 0 ? idle_.data() : nullptr;
  for (std::size_t i = 0; i < m_; ++i) without_part_[i] = idle(i) || stuck(i);
  return without_part_.data();
}

void Projector::fix(std::size_t j) {
  if (fixed_.empty()) {
    fixed_.resize(n_);
    unit_of_component_ = units_of(tolerances_);
    movable_.assign(m_, 1);
    without_part_.resize(m_);
  }
  fixed_count_ += fixed_[j] == 0 ? 1 : 0;
  fixed_[j] = 1;
}

void Projector::release(std::size_t j) {
  if (!fixed(j)) return;
  fixed_[j] = 0;
  --fixed_count_;
}

void Projector::rest(std::size_t i) {
  idle_count_ += idle_[i] == 0 ? 1 : 0;
  idle_[i] = 1;
}

void Projector::engage(std::size_t i) {
  idle_count_ -= idle_[i] != 0 ? 1 : 0;
  idle_[i] = 0;
}

void Projector::rest_one_sided() {
  for (std::size_t i = 0; i < idle_.size(); ++i)
    if (invariants_.sense(i) != 0) rest(i);
}

void Projector::release_all() {
  std::fill(fixed_.begin(), fixed_.end(), 0);
  fixed_count_ = 0;
}

/// Returns whether the latest correction was so small that its remainder is roundoff.
bool Projector::settled() const { return size_of_correction() <= last_correction; }

double Projector::size_of_correction() const {
  return max_norm(n_, [this](std::size_t i) { return room_->delta[i] / at_.w[i]; });
}

double Projector::pivot_threshold() const {
  const double error = derivative_errors * invariants_.relative_error_of_derivatives();
  return std::clamp(std::max(tolerances_.rtol(), error), least_pivot, largest_pivot);
}

void Projector::leave_out(std::size_t i, double t) {
  left_out_[i] = 1;
  if (any_fixed()) return;
  if (deficient_ == 0) dropped_at_ = t;
  ++dropped_[i];
}

/// Archives the latest linearization and the counts.
void Projector::state(Archive& archive) {
  archive(linearized_, bent_, at_.r, at_.J, at_.norm, at_.w, at_.y, left_out_, dropped_, corrections_, deficient_,
          corrected_at_);
  archive(covered_, covered_deficient_, dropped_at_);
  archive(idle_);
  archive.resizable(linearized_w_);
  if (!archive.reading()) return;
  archive.require(linearized_w_.size() == n_ || (linearized_w_.empty() && (!linearized_ || negligible_ == 0)));
  idle_count_ = idle_.size() - static_cast<std::size_t>(std::ranges::count(idle_, char{0}));
}

std::vector<char> Projector::dropped() const {
  std::vector<char> result(dropped_.size());
  const auto all = static_cast<double>(corrections_);
  if (deficient_ == 0 || static_cast<double>(deficient_) < often * all || covered_deficient_ < often * covered_)
    return result;
  for (std::size_t i = 0; i < result.size(); ++i) result[i] = static_cast<double>(dropped_[i]) >= now_and_then * all;
  return result;
}

}  // namespace invariode
