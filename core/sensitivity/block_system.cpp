#include "sensitivity/block_system.hpp"

#include <cmath>

namespace invariode {
namespace {

// Of y in units of the weights, over which what y does to the slopes of S is a difference, ε^{1/4}: it need not be
// exact, and laws of S are disturbed by roundoff of it.
const double coupling_increment = std::pow(eps, 0.25);
constexpr int tangent_corrections = 3;  // of linear equations: one, and what differences leave of the Jacobian
}  // namespace

BlockEquations::BlockEquations(Callback& f, const Variations& variations, const Weights& weights,
                               const Weights& iteration, BoundedSlope* bounded)
    : extent_(weights.size(), variations.k),
      quadratures_(variations.quadratures),
      state_(f),
      f_(f),
      slope_(variations.slope),
      whole_(&whole_entry, this),
      sensitivities_(&sensitivities_entry, this),
      weights_(weights),
      iteration_(iteration),
      bounded_(bounded) {}

Status BlockEquations::whole_entry(void* self, double t, const double* Y, double* out) {
  auto& me = *static_cast<BlockEquations*>(self);
  if (me.f_(t, Y, out) == Status::stop) return Status::stop;
  return sensitivities_entry(self, t, Y, out + me.extent_.n);
}

Status BlockEquations::sensitivities_entry(void* self, double t, const double* Y, double* out) {
  auto& me = *static_cast<BlockEquations*>(self);
  const bool rests = me.bounded_ != nullptr && !me.bounded_->held().empty();
  if (me.slope_(t, rests ? me.at_rest(Y) : Y, out) == Status::stop) return Status::stop;
  for (std::size_t j = 0; rests && j < me.extent_.k; ++j) me.bounded_->rest(out + j * me.extent_.n);
  return Status::ok;
}

/// Y with S = 0 of the components that rest, of which iterations leave roundoff: f may have no derivative there.
const double* BlockEquations::at_rest(const double* Y) {
  at_rest_.assign(Y, Y + extent_.size());
  for (const std::size_t i : bounded_->held())
    for (std::size_t j = 1; j <= extent_.k; ++j) at_rest_[j * extent_.n + i] = 0;
  return at_rest_.data();
}

BlockSystem::BlockSystem(Callback& f, const Weights& weights, const LinearAlgebra& linear, Jacobian& jacobian)
    : equations_(linear.blocks),
      f_(f),
      state_f_(equations_ != nullptr ? equations_->state() : f),
      weights_(equations_ != nullptr ? equations_->weights() : weights),
      extent_(equations_ != nullptr ? equations_->extent() : Extent(weights.size())),
      coupled_(equations_ != nullptr ? equations_->coupled() : weights.size()),
      jacobian_(jacobian) {}

Outcome BlockSystem::evaluate(Callback& f, double t, const double* Y, double* out, std::size_t count) {
  undefined_ = -1;
  if (!all_finite(Y, count)) return Outcome::not_finite;
  if (f(t, Y, out) == Status::stop) return Outcome::stop;
  jacobian_.extend(Y, out);
  if (all_finite(out, count)) return Outcome::ok;
  undefined_ = static_cast<int>(std::find_if_not(out, out + count, [](double x) { return std::isfinite(x); }) - out);
  return Outcome::not_finite;
}

Outcome BlockSystem::evaluate_sensitivities(double t, const double* Y, double* out) {
  undefined_ = -1;
  if (!all_finite(Y, extent_.size())) return Outcome::not_finite;
  if (equations_->sensitivities()(t, Y, out + extent_.n) == Status::stop) return Outcome::stop;
  return all_finite(out + extent_.n, extent_.n * extent_.k) ? Outcome::ok : Outcome::not_finite;
}

void BlockSystem::multiply_mass(const Matrix& M, const double* v, double* out) const {
  for (const std::size_t block : coupled(all())) M.multiply(v + block, out + block);
  std::copy(v + coupled_, v + extent_.size(), out + coupled_);
}

Status BlockSystem::sensitivity_rate(double t, const double* Y, const double* slope, const double* f, double h,
                                     double* rate) {
  if (!has_sensitivities()) return Status::ok;
  const std::size_t n = extent_.n;
  const double least = std::sqrt(eps) * std::max(std::abs(t), std::abs(t + h));
  const double dt = t + std::copysign(std::min(least, std::abs(h)), h) - t;
  beyond_.assign(Y, Y + extent_.size());
  for (std::size_t i = 0; i < n && slope != nullptr; ++i) beyond_[i] += dt * slope[i];
  if (equations_->sensitivities()(t + dt, beyond_.data(), rate + n) == Status::stop) return Status::stop;
  for (std::size_t i = n; i < extent_.size(); ++i) rate[i] = dt == 0 ? 0 : (rate[i] - f[i]) / dt;
  if (!all_finite(rate + n, n * extent_.k)) std::fill_n(rate + n, n * extent_.k, 0);
  return Status::ok;
}

/// b_j += c ∂(J S_j + f_pj)/∂y b_0, by a difference along b_0. It need not be exact: the formulas have their order with
/// any matrix, and it is what keeps S stable where y is stiff.
Status BlockSystem::couple(double c, double t, const double* Y, const double* f, double* b) {
  if (!has_sensitivities()) return Status::ok;
  const std::size_t n = extent_.n;
  const double size = max_norm(n, [&](std::size_t i) { return b[i] / weights_.at(i, Y[i]); });
  if (!(size > 0) || !std::isfinite(size)) return Status::ok;
  const double part = coupling_increment / size;
  beyond_.assign(Y, Y + extent_.size());
  changed_.resize(n * extent_.k);
  for (std::size_t i = 0; i < n; ++i) beyond_[i] += part * b[i];
  if (equations_->sensitivities()(t, beyond_.data(), changed_.data()) == Status::stop) return Status::stop;
  if (!all_finite(changed_.data(), changed_.size())) return Status::ok;
  for (std::size_t i = 0; i < changed_.size(); ++i) b[n + i] += c * ((changed_[i] - f[n + i]) / part);
  return Status::ok;
}

Status make_tangent_consistent(const LinearAlgebra& linear, double t, double* Y) {
  BlockEquations& equations = *linear.blocks;
  const auto [n, k] = equations.extent();
  if (equations.coupled() == n) return Status::ok;  // no equation says what quadratures are
  Mass& mass = *linear.mass;
  Jacobian jacobian = *linear.jacobian;
  Callback uncounted = equations.state();
  std::vector<double> slope(n), delta(k * n);
  if (mass.evaluate(t) == Status::stop || uncounted(t, Y, slope.data()) == Status::stop) return Status::stop;
  if (!all_finite(slope.data(), n)) return Status::ok;
  if (jacobian.evaluate(uncounted, t, Y, slope.data()) == Status::stop) return Status::stop;
  MassSolver solver;
  if (!solver.factor(mass, jacobian.matrix(), linear.lapack)) return Status::ok;
  for (int correction = 0; correction < tangent_corrections; ++correction) {
    if (equations.sensitivities()(t, Y, delta.data()) == Status::stop) return Status::stop;
    if (!all_finite(delta.data(), delta.size())) return Status::ok;
    for (std::size_t j = 0; j < k; ++j) solver.correction(mass, delta.data() + j * n);
    for (std::size_t i = 0; i < delta.size(); ++i) Y[n + i] += delta[i];
  }
  return Status::ok;
}

}  // namespace invariode
