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
  if (me.slope_(t, Y, out) == Status::stop) return Status::stop;
  if (me.bounded_ != nullptr) me.rest(out);
  return Status::ok;
}

void AugmentedSlope::rest(double* out) const {
  for (const std::size_t i : bounded_->held())
    for (std::size_t j = 0; j < extent_.k; ++j) out[j * extent_.n + i] = 0;
}

}  // namespace invariode
