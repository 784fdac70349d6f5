#include "sensitivity/variations.hpp"

#include <limits>
#include <utility>

namespace invariode {

Weights augmented(const Weights& state, const Variations& variations, bool counts) {
  std::vector<double> threshold = state.threshold(), scale;
  for (const double tolerance : variations.tolerance)
    threshold.push_back(counts ? tolerance / state.rtol() : std::numeric_limits<double>::infinity());
  if (!state.scale().empty())
    for (std::size_t block = 0; block <= variations.k; ++block)
      scale.insert(scale.end(), state.scale().begin(), state.scale().end());
  return {state.rtol(), std::move(threshold), std::move(scale)};
}

Status AugmentedSlope::whole_entry(void* self, double t, const double* Y, double* out) {
  auto& me = *static_cast<AugmentedSlope*>(self);
  if (me.f_(t, Y, out) == Status::stop) return Status::stop;
  return sensitivities_entry(self, t, Y, out + me.extent_.n);
}

Status AugmentedSlope::sensitivities_entry(void* self, double t, const double* Y, double* out) {
  auto& me = *static_cast<AugmentedSlope*>(self);
  const bool rests = me.bounded_ != nullptr && !me.bounded_->held().empty();
  if (me.slope_(t, rests ? me.at_rest(Y) : Y, out) == Status::stop) return Status::stop;
  for (std::size_t j = 0; rests && j < me.extent_.k; ++j) me.bounded_->rest(out + j * me.extent_.n);
  return Status::ok;
}

/// Y with S = 0 of the components that rest, of which iterations leave roundoff: f may have no derivative there.
const double* AugmentedSlope::at_rest(const double* Y) {
  at_rest_.assign(Y, Y + extent_.size());
  for (const std::size_t i : bounded_->held())
    for (std::size_t j = 1; j <= extent_.k; ++j) at_rest_[j * extent_.n + i] = 0;
  return at_rest_.data();
}

}  // namespace invariode
