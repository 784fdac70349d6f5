#include "manifold/restoration.hpp"

#include <algorithm>
#include <cstddef>
#include <utility>
#include <vector>

namespace invariode {
namespace {

Invariants demanded_of(const Invariants& all, const Weights& weights) {
  std::vector<InvariantBlock> blocks;
  std::vector<double> values;
  const double* value = all.value().data();
  for (const InvariantBlock& block : all.blocks()) {
    if (!block.held) {
      blocks.push_back(block);
      values.insert(values.end(), value, value + block.m);
    }
    value += block.m;
  }
  return {all.n(), std::move(blocks), std::move(values), weights};
}

}  // namespace

bool Restoration::needed(const Invariants& invariants) {
  return std::any_of(invariants.blocks().begin(), invariants.blocks().end(),
                     [](const InvariantBlock& block) { return !block.held && block.level > 0; });
}

bool Restoration::determines(const Invariants& invariants) {
  std::size_t demanded = 0;
  for (const InvariantBlock& block : invariants.blocks())
    if (!block.held && block.sense == 0) demanded += block.m;
  return demanded >= invariants.n();
}

Restoration::Restoration(const Invariants& invariants, const Weights& weights)
    : weights_(weights),
      demanded_(demanded_of(invariants, weights)),
      projector_(demanded_, weights, 1),
      determines_(determines(invariants)) {}

Status Restoration::restore(double t, double* y, bool acted) {
  const Outcome outcome = projector_.linearize_at(t, y);
  if (outcome == Outcome::stop) return Status::stop;
  if (outcome == Outcome::not_finite) return Status::ok;
  const Linearization& at = projector_.linearization();
  std::size_t i = 0;
  for (const InvariantBlock& block : demanded_.blocks())
    for (const std::size_t end = i + block.m; i < end; ++i)
      if (block.level == 0 && (acted || !determines_) && !(at.distance(i) <= weights_.rtol())) return Status::ok;
  return projector_.impose(t, y).outcome == Outcome::stop ? Status::stop : Status::ok;
}

}  // namespace invariode
