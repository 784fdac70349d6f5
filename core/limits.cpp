#include "limits.hpp"

#include <algorithm>
#include <cassert>

namespace invariode {

std::optional<Limit> Limits::look(std::int64_t steps, const Emitter& emitter) {
  if (steps >= max_steps_) return Limit::steps;
  if (out_of_time()) return Limit::time;
  const Kept kept = emitter.kept();
  if (kept.points >= max_points_) return Limit::points;
  if (kept.bytes >= max_bytes_) return Limit::memory;
  next_look_ = steps;
  if (request_ != nullptr || timed()) return {};
  const Kept most = emitter.most_of_step();
  assert(most.points > 0 && most.bytes > 0);
  next_look_ +=
      std::min({max_steps_ - steps, (max_points_ - kept.points) / most.points, (max_bytes_ - kept.bytes) / most.bytes});
  return {};
}

}  // namespace invariode
