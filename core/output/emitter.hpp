#pragma once
// Puts out what the steps of a run contribute to its results.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "output/interpolant.hpp"
#include "output/output.hpp"
#include "settings.hpp"

namespace invariode {

/// A point of the solution; y belongs to whoever made it.
struct Reached {
  double t;
  const double* y;
};

/// Points and bytes.
struct Kept {
  std::int64_t points, bytes;
};

/// Emits the outputs of a run. A function returns `stop` where a user function asked to.
class Emitter {
 public:
  /// The settings and the interpolant belong to the loop. `dense`: the continuous solution, if it is wanted.
  Emitter(const Settings& settings, StepInterpolant& interpolant, std::size_t n, std::size_t events,
          std::optional<DenseOutput> dense);

  /// The results, to be moved out when the run has ended.
  Output output;

  /// The continuous solution starts at `from`, or goes on there after a jump.
  void begin(const Reached& from) {
    if (output.dense) output.dense->start(from.t, from.y);
  }
  /// A record of each step is wanted.
  [[nodiscard]] bool records() const { return settings_.save_all && settings_.record; }
  /// The accepted step up to the point reached, into the continuous solution.
  Status add_segment(const Reached& reached);
  /// The points of the step from t0 to t1, which is used up to the point reached; or the start of the run, where all
  /// are the same. `jumps`: the solution jumps there.
  Status emit(double t0, double t1, const Reached& reached, bool jumps);
  /// The values at output times up to the point reached. `jumps`: the one there is still to come.
  Status emit_times(const Reached& reached, bool jumps);
  /// The run goes on at a point, in results of its own.
  Status resume(const Reached& at, bool jumps);
  /// The solution is constant from here to the end.
  void constant(const double* y);
  /// The solution has jumped: where its output goes on, with the values of the invariants.
  void jump(double t, std::vector<double> values);

  [[nodiscard]] Kept kept() const;
  /// The most that one step adds to that, if no event occurs in it.
  [[nodiscard]] Kept most_of_step() const;

 private:
  [[nodiscard]] bool at_times() const { return settings_.save_all && settings_.output_at_times; }
  Status emit_inside(std::span<const double> times);

  const Settings& settings_;
  StepInterpolant& interpolant_;
  std::size_t n_;
  double forward_;
  std::size_t next_time_ = 0;
};

}  // namespace invariode
