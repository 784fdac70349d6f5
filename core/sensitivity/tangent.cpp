#include "sensitivity/tangent.hpp"

#include <algorithm>
#include <cmath>

#include "manifold/gradient.hpp"
#include "manifold/thresholds.hpp"

namespace invariode {

TangentProjector::TangentProjector(Invariants& invariants, const Weights& weights, std::size_t size,
                                   const Bounds* bounds)
    : invariants_(invariants),
      bounds_(bounds),
      n_(weights.size()),
      k_(size / n_ - 1),
      m_(invariants.m()),
      weights_(weights),
      rate_(k_ * m_),
      value_(k_ * m_),
      delta_(n_) {
  std::size_t largest = 0;
  for (const InvariantBlock& block : invariants.blocks()) {
    blocks_.push_back({block.tangent, block.m, block.held});
    largest = std::max(largest, block.m);
  }
  block_value_.resize(k_ * largest);
}

Status TangentProjector::evaluate(double t, const double* Y, double* out) {
  std::size_t first = 0;
  for (Block& block : blocks_) {
    if (block.tangent(t, Y, block_value_.data()) == Status::stop) return Status::stop;
    for (std::size_t j = 0; j < k_; ++j) std::copy_n(block_value_.data() + j * block.m, block.m, out + j * m_ + first);
    first += block.m;
  }
  return Status::ok;
}

Status TangentProjector::hold(double t, const double* Y) {
  if (evaluate(t, Y, rate_.data()) == Status::stop) return Status::stop;
  std::size_t first = 0;
  for (const Block& block : blocks_) {
    for (std::size_t j = 0; j < k_ && !block.held; ++j) std::fill_n(rate_.data() + j * m_ + first, block.m, 0);
    first += block.m;
  }
  return Status::ok;
}

Outcome TangentProjector::onto(Projector& state, double t, const double* target, double* Y) {
  for (int correction = 0; correction < tangent_iterations; ++correction) {
    if (evaluate(t, Y, value_.data()) == Status::stop) return Outcome::stop;
    if (!all_finite(value_.data(), value_.size())) return Outcome::not_finite;
    bool moved = false;
    for (std::size_t j = 0; j < k_; ++j) {
      double* S = Y + (1 + j) * n_;
      double* residual = value_.data() + j * m_;
      if (!off_tangent(state, S, target + j * m_, residual)) continue;
      state.correction_for(residual, delta_.data());
      for (std::size_t i = 0; i < n_; ++i) S[i] -= delta_[i];
      moved = true;
    }
    if (!moved) break;
  }
  return Outcome::ok;
}

/// The value becomes the residual. Whether it is more than roundoff in an invariant that takes part.
bool TangentProjector::off_tangent(const Projector& state, const double* S, const double* target,
                                   double* residual) const {
  const double* J = state.linearization().J.data();
  bool off = false;
  for (std::size_t i = 0; i < m_; ++i) {
    const double value = residual[i];
    residual[i] = invariants_.sense(i) == 0 ? value - target[i] : 0;
    if (state.left_out(i) || residual[i] == 0) continue;
    const double terms = size_of_terms(std::abs(value) + std::abs(target[i]), invariants_.row(i, J), S);
    off = off || std::abs(residual[i]) > eps * terms;
  }
  return off;
}

Outcome TangentProjector::settle(double t, double* Y) {
  if (!own_) own_.emplace(invariants_, weights_, 1);
  if (bounds_ != nullptr)
    for (const auto& [i, lower, upper] : bounds_->intervals())
      if (Y[i] <= lower || Y[i] >= upper) own_->fix(i);
  Outcome outcome = own_->factorize_at(t, Y);
  if (outcome == Outcome::ok) outcome = follow(*own_, t, Y);
  own_->release_all();
  return outcome;
}

Status AlgebraicTangent::entry(void* self, double t, const double* Y, double* out) {
  auto& [slopes, mass, slope] = *static_cast<AlgebraicTangent*>(self);
  if (slopes(t, Y, slope.data()) == Status::stop) return Status::stop;
  const std::size_t n = mass.matrix().n();
  for (std::size_t first = 0; first < slope.size(); first += n, out += mass.equations())
    mass.algebraic_part(slope.data() + first, out);
  return Status::ok;
}

namespace {

/// S of component i becomes 0, in a Y of blocks of n.
void forget(std::span<double> Y, std::size_t n, std::size_t i) {
  for (std::size_t at = n + i; at < Y.size(); at += n) Y[at] = 0;
}

}  // namespace

void clip(const Bounds& bounds, std::span<double> Y) {
  for (const auto& [i, lower, upper] : bounds.intervals())
    if (Y[i] < lower || Y[i] > upper) forget(Y, bounds.n(), i);
  bounds.clip(Y.data());
}

void forget_at_bounds(const Bounds& bounds, std::span<const std::size_t> held, std::span<double> Y) {
  for (const auto& [i, lower, upper] : bounds.intervals())
    if ((Y[i] <= lower || Y[i] >= upper) && std::find(held.begin(), held.end(), i) != held.end())
      forget(Y, bounds.n(), i);
}

bool rest_at_bounds(const Bounds& bounds, const double* candidate, std::span<double> Y) {
  bool any = false;
  for (const auto& [i, lower, upper] : bounds.intervals()) {
    if (Y[i] == candidate[i] || (Y[i] != lower && Y[i] != upper)) continue;
    forget(Y, bounds.n(), i);
    any = true;
  }
  return any;
}

}  // namespace invariode
