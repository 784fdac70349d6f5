#pragma once
// An ensemble in lanes: which ones can be, and what one thread does.

#include <cstddef>
#include <cstdint>
#include <memory>
#include <new>
#include <optional>
#include <unordered_map>
#include <vector>

#include "callback.hpp"
#include "detect/below_zero.hpp"
#include "detect/discontinuity.hpp"
#include "run/ensemble.hpp"
#include "run/lanes/event_search.hpp"
#include "run/lanes/lanes.hpp"
#include "run/problem.hpp"
#include "run/threads.hpp"

namespace invariode {

/// Returns the reason why trajectories of this solver cannot be integrated in lanes, in words, or null if they can.
[[nodiscard]] const char* obstacle_to_lanes(const Solver& solver);

/// Takes trajectories from a queue and integrates them in lanes, on a thread that has the solver to itself. What the
/// lanes leave is integrated alone.
class LaneWorker final : public lanes::Host {
 public:
  LaneWorker(Solver& solver, const Ensemble& ensemble, const LaneForm& form, Queue& queue, EnsembleResult& result);

  void run();

  bool take(std::uint32_t& trajectory) override;
  lanes::Found search(const lanes::Crossed& step) override;
  void put_out(std::uint32_t trajectory, std::size_t output, const double* y, std::size_t stride) override {
    result_.put_out(trajectory, output, y, stride);
  }
  void keep(const lanes::Ended& ended) override;
  void leave(std::uint32_t trajectory, lanes::Why why) override;
  void go_on(const lanes::Suspended& suspended) override;
  bool jumps(const lanes::Suspicion& suspicion, std::int64_t& checks) override;
  bool judge(const lanes::Fallen& step) override;
  void* allocate(std::size_t bytes) override;
  [[nodiscard]] bool cancelled() const override { return queue_.cancelled().load(std::memory_order_relaxed); }

 private:
  void set_parameters(std::uint32_t trajectory);

  /// The data that a kernel receives.
  struct Order {
    Order(const Solver& solver, const Ensemble& ensemble, LaneForm functions, const std::vector<double>& direction);
    Order(const Order&) = delete;
    Order& operator=(const Order&) = delete;

    const LaneForm form;
    const lanes::Kernel& kernel;
    const lanes::Invariant invariant;
    const std::vector<double> scale, notable;
    const lanes::Job job;
  };

  static constexpr std::size_t alignment = 64;  // of the widest registers
  static constexpr std::size_t least_memory = std::size_t{1} << 16U;
  struct Free {
    void operator()(std::byte* bytes) const { ::operator delete(bytes, std::align_val_t{alignment}); }
  };

  Solver& solver_;
  const Ensemble& ensemble_;
  Queue& queue_;
  EnsembleResult& result_;
  std::vector<Callback> functions_;  // of one trajectory
  std::vector<double> direction_;
  Order order_, alone_;  // in lanes, and for those that go on alone
  std::optional<EventSearch> search_;
  std::unordered_map<std::uint32_t, std::vector<Trajectory>> occurrences_;  // of trajectories that have not ended
  std::vector<std::unique_ptr<std::byte, Free>> memory_;
  std::byte* next_memory_ = nullptr;
  std::size_t left_in_memory_ = 0;
  std::size_t kept_ = 0, left_ = 0;
  EnsembleResult::Left left_why_{};
  JumpSearch jump_search_;
  BelowZero below_zero_;
  std::vector<double> end_;  // of the way that it searches
};

}  // namespace invariode
