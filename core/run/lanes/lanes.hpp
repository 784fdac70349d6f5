#pragma once
// Many trajectories of an explicit Runge-Kutta pair side by side, one in each lane of vector registers: what the
// kernels, compiled once per instruction set, are asked for and what they ask for.

#include <cstddef>
#include <cstdint>
#include <span>
#include <string_view>

#include "detect/failed_series.hpp"

namespace invariode::lanes {

/// A function in all lanes: t (lanes,), y (n, lanes), out (its values, lanes), p (parameters, lanes), each aligned to
/// 64 bytes. NaN in a lane of out: it is not defined there. It is asked at finite points only.
using Function = void(void* context, const double* t, const double* y, double* out, const double* p);

/// A function with its context.
struct Called {
  Function* function = nullptr;
  void* context = nullptr;
};

/// An invariant that is held.
struct Invariant {
  Called g, jacobian;  ///< (1, lanes), (n, lanes)
  bool held;           ///< at its value at the start; else at `value`
  double value;
  int iterations;  ///< of the projection
  bool tested;     ///< whether f conserves it
  // Of these tests:
  double interval;                               ///< length of the integration
  double increment;                              ///< of differences, relative: ε^{1/3}
  const double* direction;                       ///< (n,) in which the Jacobian is compared with a difference
  double (*time_increment)(double t, double h);  ///< of differences with respect to t
};

/// What is integrated, without anything that only some runs have: bounds, breakpoints, other limits.
struct Job {
  Called f;
  std::size_t n, parameters;
  const double* y0;    ///< rows (n,) of all trajectories
  const double* rows;  ///< of their parameters
  double t0, tf;       ///< finite, and different
  double hmax;         ///< finite
  double first_step;   ///< 0: chosen by the method
  double rtol;
  double max_steps;            ///< a trajectory that would need more is left
  double real_limit;           ///< of the pair's stability on the negative real axis
  const double* threshold;     ///< (n,)
  const double* scale;         ///< (n,), or null: all 1
  const Invariant* invariant;  ///< or null: none is held
  // Output on the way:
  const double* times;  ///< in the order of integration
  std::size_t count_of_times;
  bool corrects, projects;  ///< the extension at the ends of a step; values between them
  const Called* events;     ///< (1, lanes) each
  std::size_t count_of_events;

  [[nodiscard]] double forward() const { return tf >= t0 ? 1 : -1; }
  [[nodiscard]] bool output_at_times() const { return count_of_times > 0; }
  [[nodiscard]] bool looks_inside() const { return output_at_times() || count_of_events > 0; }
};

/// What holding the invariant came to: its value, the largest residuals of candidates and at the end, the largest
/// correction in units of rtol, evaluations of g, of f by its tests, and of its Jacobian, and sums of what the errors
/// and the corrections of the components were in the looks of `HarmDetector`, with the stride of y.
struct HeldToEnd {
  double value, before, after, correction;  ///< `after`: at outputs and at the end
  std::int64_t evaluations, checks, jacobians;
  const double *errors, *corrections;
};

/// A trajectory that has reached tf, or a terminal event: y (n,) with that stride.
struct Ended {
  std::uint32_t trajectory;
  double t;
  bool by_event;
  const double* y;
  std::size_t stride;
  std::int64_t steps, failed, evaluations;
  std::int64_t checks;  ///< evaluations of f in search of its jumps
  HeldToEnd held;       ///< where there is an invariant
};

/// A trajectory between two attempts: where it is, f there, |h| of the next attempt, whether the last one failed, and
/// its counts; and what belongs to the invariant. y, k, p and `held` have that stride.
struct Suspended {
  std::uint32_t trajectory;
  double t, h;
  bool retries;
  double steps, failed, limited;
  const double *y, *k, *p, *held, *watched;
  std::size_t stride;
  double looked;       ///< into so many steps
  std::size_t output;  ///< the number of the next one
  std::int64_t checks;
  SeriesMemory series;  ///< of failed attempts, and its points (n,)
  const double *from, *latest;
};

/// A way on which f may jump, from (t0, y0) to (t1, y1), after so many attempts, the latest that failed of size
/// `latest`. y1 (n,) has that stride.
struct Suspicion {
  std::uint32_t trajectory;
  double t0, t1, latest;
  const double *y0, *y1;
  std::size_t stride;
  std::int64_t attempts;
};

/// A step in which the sign of an event changes: from (t0, y0), where the slope is k, with the signed size h to
/// (t1, y1). `watched`: of each event its value and sign at t0, and how often it has occurred; at t1 when it has been
/// searched. y0, k, y1 and `watched` have that stride.
struct Crossed {
  std::uint32_t trajectory;
  double t0, t1, h;
  const double *y0, *k, *y1;
  double* watched;
  std::size_t stride;
};

/// What a search has found. Unless it is sound the trajectory is to be left. `terminal`: it ends at (t, y), y (n,).
struct Found {
  bool sound = false, terminal = false;
  double t = 0;
  const double* y = nullptr;
  std::int64_t evaluations = 0, jacobians = 0;  ///< of the invariant, beside those of the step as it is
};

/// Why a trajectory is left: something is not finite, or a step falls to its minimum; stability may limit its steps;
/// its invariant asks for a closer look; so does an event or an output inside a step; f jumps; it has too many steps;
/// too many others were left.
enum class Why { undefined, stability, invariant, inside, jump, limit, others };
inline constexpr std::size_t whys = 7;

/// Who hands out trajectories and takes them back. One for each thread.
class Host {
 public:
  Host() = default;
  Host(const Host&) = delete;
  Host& operator=(const Host&) = delete;
  virtual ~Host() = default;

  /// The next trajectory, whose initial value is finite; false: there are no more.
  virtual bool take(std::uint32_t& trajectory) = 0;
  /// Searches the step, and keeps the events of the trajectory that it finds.
  virtual Found search(const Crossed& step) = 0;
  /// y (n,) with that stride, at output time number `output`.
  virtual void put_out(std::uint32_t trajectory, std::size_t output, const double* y, std::size_t stride) = 0;
  virtual void keep(const Ended& ended) = 0;
  /// Something rare has happened to it: it is to be integrated from its start by the code that knows everything.
  virtual void leave(std::uint32_t trajectory, Why why) = 0;
  /// It has too few neighbours left: it is to go on alone.
  virtual void go_on(const Suspended& suspended) = 0;
  /// Whether f jumps there; evaluations of f in search of it are added to `checks`.
  virtual bool jumps(const Suspicion& suspicion, std::int64_t& checks) = 0;
  [[nodiscard]] virtual bool cancelled() const = 0;
};

/// The kernels of one pair.
struct Pair {
  std::string_view method;
  /// Bytes of memory, aligned to 64, that both of these need.
  std::size_t (*memory)(const Job& job);
  /// Integrates what the host hands out, until it has no more.
  void (*run)(const Job& job, Host& host, void* memory);
  /// Goes on with one trajectory, f having one lane. Null, but for the instructions that every processor has.
  void (*go_on)(const Job& job, const Suspended& from, Host& host, void* memory);
};

/// An instruction set for which there are kernels.
struct Instructions {
  std::string_view name;
  std::size_t lanes;  ///< in a block
  std::size_t bits;   ///< of a vector register
  std::span<const Pair> pairs;

  /// Null if the method is not a pair.
  [[nodiscard]] const Pair* pair(std::string_view method) const;
};

/// The instruction sets that this processor has, the best one first; the last one is that of every processor.
[[nodiscard]] std::span<const Instructions* const> instructions();

}  // namespace invariode::lanes
