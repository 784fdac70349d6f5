#pragma once
// What a run is to do, beyond the problem and the method.

#include <algorithm>
#include <cstdint>
#include <limits>
#include <memory>
#include <span>
#include <utility>

#include "buffer.hpp"
#include "output/interpolant.hpp"

namespace invariode {

/// Times of output, in the order of integration, inside the interval. Copies share them.
class Times {
 public:
  Times() = default;
  explicit Times(std::span<const double> times) {
    auto values = std::make_shared<Buffer<double>>();
    values->append(times.data(), times.size());
    values_ = std::move(values);
  }

  [[nodiscard]] std::size_t size() const { return values_ ? values_->size() : 0; }
  [[nodiscard]] bool empty() const { return size() == 0; }
  [[nodiscard]] const double* data() const { return values_ ? values_->data() : nullptr; }
  [[nodiscard]] double operator[](std::size_t i) const { return (*values_)[i]; }
  /// Some of them are inside an interval, not only at its ends.
  [[nodiscard]] bool any_inside(double t0, double tf) const {
    return std::any_of(data(), data() + size(), [&](double t) { return t != t0 && t != tf; });
  }
  /// Returns the values from number i on.
  [[nodiscard]] std::span<const double> from(std::size_t i) const { return {data() + i, size() - i}; }

 private:
  std::shared_ptr<const Buffer<double>> values_;
};

struct Settings {
  double t0 = 0;
  double tf = 0;
  double hmax = 0;               ///< infinite: no cap
  double first_step = 0;         ///< 0: chosen by the method
  int iterations = 1;            ///< of the projection in a step
  int refine = 1;                ///< points per step
  bool output_at_times = false;  ///< `times` instead of the steps
  Times times;
  Interpolation interpolation = Interpolation::projected;
  bool dense = false;
  bool sections = false;  ///< what the run remembers is kept at some of its steps: see `Sections`
  bool save_all = true;   ///< false: the final point only
  bool record = true;     ///< with save_all: a record of each step too
  bool check = true;      ///< the tests that may find that an invariant is not conserved
  double negligible = 0;  ///< candidates so close to the manifold, in units of rtol, are not projected

  // Where one of these is reached, the run ends early.
  static constexpr std::int64_t unlimited = std::numeric_limits<std::int64_t>::max();
  std::int64_t max_steps = unlimited;                           ///< accepted ones
  double time_limit = std::numeric_limits<double>::infinity();  ///< seconds of the wall clock
  std::int64_t max_points = unlimited;                          ///< kept
  std::int64_t max_bytes = unlimited;                           ///< of all that is kept

  /// Returns whether results have values between steps, and not only at their ends.
  [[nodiscard]] bool looks_between() const {
    if (dense || sections) return true;
    return save_all && (output_at_times ? times.any_inside(t0, tf) : refine > 1);
  }
};

}  // namespace invariode
