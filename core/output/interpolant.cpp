#include "output/interpolant.hpp"

#include <algorithm>
#include <array>
#include <cassert>

#include "manifold/active_set.hpp"
#include "manifold/one_sided.hpp"
#include "manifold/thresholds.hpp"
#include "output/polynomial.hpp"

namespace invariode {
namespace {

constexpr std::size_t points_at_once = 64;    // whose θ are kept together
constexpr std::size_t fewest_directions = 4;  // of corrections there: as many as a cubic extension has, and one more
constexpr std::array<double, 2> ends_of_step = {0, 1};

}  // namespace

void Interpolant::corrected(const Segment& segment, std::span<const double> t, double* y) const {
  assert(segment.t0 != segment.t1 && segment.size >= kind_.overhead());
  const std::size_t raw_size = segment.size - kind_.overhead();
  for (std::array<double, points_at_once> room; !t.empty(); t = t.subspan(std::min(t.size(), room.size()))) {
    const std::span<double> theta(room.data(), std::min(t.size(), room.size()));
    for (std::size_t p = 0; p < theta.size(); ++p) theta[p] = (t[p] - segment.t0) / (segment.t1 - segment.t0);
    kind_.raw(segment.data, raw_size, n_, theta, y);
    for (const double one : theta) {
      if (kind_.mode != Interpolation::raw) correct_ends(segment.data + raw_size, one, y);
      if (bounds_ != nullptr) clip(*bounds_, {y, n_});
      y += n_;
    }
  }
}

void Interpolant::correct_ends(const double* e0, double theta, double* y) const {
  const double s = std::clamp(theta, 0.0, 1.0);
  const double at0 = (1 - s) * (1 - s) * (1 + 2 * s), at1 = part_of_end(s);
  const double* e1 = e0 + n_;
  for (std::size_t i = 0; i < n_; ++i) y[i] += e0[i] * at0 + e1[i] * at1;
}

/// Differences of points of the segment: among these are all linear functions that the steps keep, as they are among
/// what a step is made of.
void Interpolant::choose_directions(const Segment& segment) {
  const std::size_t count = std::max(fewest_directions, m_ + 2);
  if (path_.empty()) {
    path_.resize((count + 1) * n_);
    for (std::size_t k = 1; k <= count; ++k) directions_.push_back(path_.data() + k * n_);
  }
  for (std::size_t k = 0; k <= count; ++k) {
    const double theta = static_cast<double>(k) / static_cast<double>(count);
    double* point = path_.data() + k * n_;
    corrected(segment, segment.t0 + theta * (segment.t1 - segment.t0), point);
    for (std::size_t i = 0; i < n_ && k > 0; ++i) point[i] -= path_[i];
  }
  projector_->seek_along(directions_);
}

Status Interpolant::value(const Segment& segment, double t, double* y) {
  corrected(segment, t, y);
  const double theta = (t - segment.t0) / (segment.t1 - segment.t0);
  if (projector_ == nullptr || m_ == 0 || theta <= 0 || theta >= 1) return Status::ok;
  const double* w = segment.data + segment.size - kind_.overhead() + 2 * n_;
  const double* g0 = segment.data + segment.size - 2 * (m_ + tangent_target_.size());
  const double* g1 = g0 + m_;
  const std::vector<double>& held = projector_->invariants().value();
  for (std::size_t i = 0; i < m_; ++i) target_[i] = (1 - theta) * g0[i] + theta * g1[i] - held[i];
  if (projector_->invariants().along_steps()) choose_directions(segment);
  const int most = interpolation_iterations;
  Outcome outcome = projector_->invariants().any_one_sided()
                        ? onto_between(*projector_, bounds_, t, w, g0, g1, target_, y, most)
                    : bounds_ != nullptr ? onto_within(*projector_, *bounds_, t, w, target_.data(), y, most)
                                         : projector_->onto(t, w, target_.data(), y, most);
  if (outcome == Outcome::ok && tangent_ != nullptr) outcome = follow_tangent(t, theta, g1 + m_, y);
  switch (outcome) {
    case Outcome::stop: return Status::stop;
    case Outcome::not_finite: corrected(segment, t, y); break;  // g is not defined here
    case Outcome::ok: break;
  }
  return Status::ok;
}

/// The tangent at t, where the state has just been projected.
Outcome Interpolant::follow_tangent(double t, double theta, const double* T0, double* y) {
  const double* T1 = T0 + tangent_target_.size();
  for (std::size_t i = 0; i < tangent_target_.size(); ++i) tangent_target_[i] = (1 - theta) * T0[i] + theta * T1[i];
  return tangent_->onto(*projector_, t, tangent_target_.data(), y);
}

StepInterpolant::StepInterpolant(Step& step, std::size_t n, Interpolation mode, Projector* between,
                                 TangentProjector* tangent, const Projector* steps, const Bounds* bounds)
    : step_(step),
      invariants_(between ? &between->invariants() : nullptr),
      projector_(steps),
      interpolant_({Extent::within(n, step.n()), invariants_ ? invariants_->m() : 0, mode, step.interpolate()}, between,
                   tangent, bounds),
      g_end_(interpolant_.m_),
      tangent_end_(interpolant_.tangent_target_.size()) {}

Status StepInterpolant::make() {
  if (made_) return Status::ok;
  assert(start_y_ != nullptr);  // a step was accepted
  const std::size_t n = interpolant_.n_;
  const std::size_t raw_size = step_.extension_size();
  size_ = raw_size + kind().overhead();
  if (data_.empty()) data_.resize(max_size());
  assert(size_ <= data_.size());
  if (step_.extension(data_.data()) == Status::stop) return Status::stop;
  if (kind().mode != Interpolation::raw) {
    double* e0 = data_.data() + raw_size;
    double* e1 = e0 + n;
    kind().raw(data_.data(), raw_size, n, ends_of_step, e0);
    for (std::size_t i = 0; i < n; ++i) e0[i] = start_y_[i] - e0[i];
    for (std::size_t i = 0; i < n; ++i) e1[i] = step_.y()[i] - e1[i];
    if (kind().projects()) {
      const std::span<const double> w = projector_->linearization().w;
      double* g0 = std::copy(w.begin(), w.end(), e1 + n);
      double* T0 = g0 + 2 * interpolant_.m_;
      if (interpolant_.tangent_ != nullptr && tangents(T0, T0 + tangent_end_.size()) == Status::stop)
        return Status::stop;
      if (residuals(g0, g0 + interpolant_.m_) == Status::stop) return Status::stop;
    }
  }
  made_ = true;
  return Status::ok;
}

double* StepInterpolant::take(double t0, const double* y0, double t1) {
  start_t_ = t0;
  start_y_ = y0;
  end_t_ = t1;
  size_ = max_size();
  data_.resize(size_);
  made_ = true;
  return data_.data();
}

/// g at both ends of the step.
Status StepInterpolant::residuals(double* g0, double* g1) {
  if (g_known_ && g_t_ == start_t_)
    std::copy(g_end_.begin(), g_end_.end(), g0);
  else if (invariants_->evaluate(start_t_, start_y_, g0) == Status::stop)
    return Status::stop;
  if (invariants_->evaluate(end_t_, step_.y(), g1) == Status::stop) return Status::stop;
  std::copy(g1, g1 + g_end_.size(), g_end_.begin());
  g_t_ = end_t_;
  g_known_ = true;
  return Status::ok;
}

/// G S + g_p at both ends, which are known where g is.
Status StepInterpolant::tangents(double* T0, double* T1) {
  TangentProjector& tangent = *interpolant_.tangent_;
  if (g_known_ && g_t_ == start_t_)
    std::copy(tangent_end_.begin(), tangent_end_.end(), T0);
  else if (tangent.evaluate(start_t_, start_y_, T0) == Status::stop)
    return Status::stop;
  if (tangent.evaluate(end_t_, step_.y(), T1) == Status::stop) return Status::stop;
  std::copy_n(T1, tangent_end_.size(), tangent_end_.begin());
  return Status::ok;
}

Segment StepInterpolant::segment() {
  if (make() == Status::stop) return {start_t_, end_t_, nullptr, 0};
  return {start_t_, end_t_, data_.data(), size_};
}

Status StepInterpolant::value(double t, double* y) {
  const Segment s = segment();
  return s.data ? interpolant_.value(s, t, y) : Status::stop;
}

/// Adds the corrections as powers: e₀ (1−θ)²(1+2θ) + e₁ θ²(3−2θ) = e₀ + 3 (e₁ − e₀) θ² + 2 (e₀ − e₁) θ³.
Status StepInterpolant::powers(std::vector<double>& c) {
  const Segment s = segment();
  if (!s.data) return Status::stop;
  const std::size_t n = interpolant_.n_, raw_size = s.size - kind().overhead();
  assert(order_of_powers() && *order_of_powers() >= 3);
  c.assign(s.data, s.data + raw_size);
  if (kind().mode == Interpolation::raw) return Status::ok;
  const double* e0 = s.data + raw_size;
  const double* e1 = e0 + n;
  for (std::size_t i = 0; i < n; ++i) {
    c[i] += e0[i];
    c[2 * n + i] += 3 * (e1[i] - e0[i]);
    c[3 * n + i] += 2 * (e0[i] - e1[i]);
  }
  return Status::ok;
}

Status StepInterpolant::values(std::span<const double> t, double* y) {
  const Segment s = segment();
  if (!s.data) return Status::stop;
  if (!kind().projects()) {
    interpolant_.corrected(s, t, y);
    return Status::ok;
  }
  for (std::size_t p = 0; p < t.size(); ++p)
    if (interpolant_.value(s, t[p], y + p * interpolant_.n_) == Status::stop) return Status::stop;
  return Status::ok;
}

Status StepInterpolant::corrected(double t, double* y) {
  const Segment s = segment();
  if (!s.data) return Status::stop;
  interpolant_.corrected(s, t, y);
  return Status::ok;
}

}  // namespace invariode
