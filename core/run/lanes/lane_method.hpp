#pragma once
// What the loop asks of a method that steps in all lanes at once. (INVARIODE_LANES: see pack.hpp.)

#include <array>
#include <cstddef>
#include <cstdint>

#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

/// The rows of the trajectories in lanes, and of those that are ready to take their places.
template <int W>
struct LaneRows {
  Rows layout;
  Pack<W>*now, *ready;

  LaneRows(const Job& job, Host& host)
      : layout(job), now(take<W>(host, layout.size)), ready(take<W>(host, layout.size)) {}
};

/// Constants of a method and its continuous extension, as the loop over attempts uses them.
template <int W>
struct LaneTraits {
  std::size_t degree;  ///< of the continuous extension in θ
  LaneExtension<W>* evaluate_extension;
  double limit;      ///< of |h λ|, where the formula is stable
  int fewest_lanes;  ///< trajectories in fewer lanes than this are faster one at a time (benchmarks/lanes.py)
};

/// A method in W lanes, LanePair or LaneTaylor: the operations of which attempts have no or few. Those of each attempt
/// are a part of the loop, which is compiled for each method as far as that:
///
///   P attempt(step, candidate, M& odd)               the candidates and their errors; where something is not finite
///   M bends(step, candidate, error, nearly)          where single runs look for a jump of f that the errors may not
///                                                    show, and nearly where they do (if `may_miss_jumps`)
///   M finish(step)                                   evaluates the rest at the ends; where that is not defined
///   P accept(accepted, step, error, hmin, retries)   takes these steps; |h| of the next attempt, as `accept` and
///                                                    `reject` of the method choose it in single runs
template <int W>
class LaneMethod {
 public:
  using P = Pack<W>;
  using M = Mask<W>;
  static constexpr int width = W;
  const LaneTraits<W> traits;

  /// |h| of the first steps, as the method's `start` chooses it in single runs. Sets where f (or its series) is not
  /// defined, and where the start is at rest.
  virtual P start(const P& t0, const P* y, const P* p, M& undefined, M& rests) = 0;
  /// y′ at the starts.
  [[nodiscard]] virtual const P* slope_at_start() const = 0;
  /// The memory of a trajectory that was made ready, or is in another lane, beside its rows.
  virtual void adopt(int /*lane*/, int /*from*/) {}
  virtual void keep_defined(int /*lane*/, int /*from*/) {}

  /// y′ at the ends of steps.
  virtual const P* slope() = 0;
  /// Estimated errors of the candidates, whose slopes are asked for afterwards.
  virtual const P* errors(const P& length) = 0;
  /// Coefficients of the extension behind y0. Returns where they are not sound.
  virtual M extend(const LaneStep<W>& step, P* coefficients) = 0;
  /// |h λ| as a quotient, numerator first.
  virtual std::array<P, 2> stability(const LaneStep<W>& step, const P* candidate) = 0;
  [[nodiscard]] virtual std::int64_t evaluations(std::int64_t steps, std::int64_t failed,
                                                 std::int64_t looked) const = 0;

 protected:
  explicit LaneMethod(const LaneTraits<W>& of_method) : traits(of_method) {}
  ~LaneMethod() = default;
};

}  // namespace invariode::lanes::INVARIODE_LANES
