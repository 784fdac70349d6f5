#pragma once
// What ends a run early: a request from outside, or a limit on its steps, time, points or memory.

#include <atomic>
#include <chrono>
#include <cstdint>
#include <limits>
#include <optional>

#include "output/emitter.hpp"
#include "report.hpp"
#include "settings.hpp"

namespace invariode {

/// The limits of a run, tested after steps, and as rarely as possible: after a test none is due for as many steps as
/// cannot reach a limit.
class Limits {
 public:
  explicit Limits(const Settings& settings)
      : max_steps_(settings.max_steps),
        max_points_(settings.max_points),
        max_bytes_(settings.max_bytes),
        time_limit_(settings.time_limit) {}

  /// The request belongs to the caller and outlives the run.
  void stop_on(const std::atomic<bool>& request) {
    request_ = &request;
    look_soon();
  }
  /// The clock starts, after so many steps, which do not count.
  void begin(std::int64_t steps) {
    started_ = Clock::now();
    before_ = steps;
    if (max_steps_ < Settings::unlimited - before_) max_steps_ += before_;
  }

  [[nodiscard]] bool due(std::int64_t steps) const { return steps >= next_look_; }
  /// More than the most that a step keeps has been kept: an event has occurred.
  void look_soon() { next_look_ = 0; }
  [[nodiscard]] bool requested() const { return request_ != nullptr && request_->load(std::memory_order_relaxed); }
  /// The limit that is reached after so many steps, if there is one.
  [[nodiscard]] std::optional<Limit> look(std::int64_t steps, const Emitter& emitter);
  /// Returns whether a limit of the steps or of the time was set, up to which the run goes on in any case.
  [[nodiscard]] bool given() const { return timed() || max_steps_ < Settings::unlimited; }
  [[nodiscard]] bool out_of_time() const { return timed() && seconds() >= time_limit_; }

  [[nodiscard]] double seconds() const { return std::chrono::duration<double>(Clock::now() - started_).count(); }
  /// Returns how many of so many steps in all were made since `begin`.
  [[nodiscard]] std::int64_t counted(std::int64_t steps) const { return steps - before_; }

 private:
  using Clock = std::chrono::steady_clock;
  [[nodiscard]] bool timed() const { return time_limit_ < std::numeric_limits<double>::infinity(); }

  std::int64_t max_steps_, max_points_, max_bytes_;
  double time_limit_;
  const std::atomic<bool>* request_ = nullptr;
  std::int64_t before_ = 0;
  std::int64_t next_look_ = 0;
  Clock::time_point started_;
};

}  // namespace invariode
