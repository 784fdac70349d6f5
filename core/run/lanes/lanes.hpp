#pragma once
// Many trajectories of an explicit Runge-Kutta pair or of Taylor series side by side, one in each lane of vector
// registers: what the kernels, compiled once per instruction set, are asked for and what they ask for.

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

/// Taylor coefficients in all lanes, as `invariode::Series` has them for one: t and unit (lanes,), y (n, lanes), out
/// (order + 1, n, lanes). NaN in a lane of the last rows: there is no series.
using SeriesFunction = void(void* context, const double* t, const double* unit, const double* y, double* out,
                            const double* p);

/// A `SeriesFunction` with its context.
struct CalledSeries {
  SeriesFunction* function = nullptr;
  void* context = nullptr;
};

/// An invariant that is held.
struct Invariant {
  Called g, jacobian;  ///< (1, lanes), (n, lanes)
  bool held;           ///< at its value at the start; else at `value`
  double value;
  int iterations;                                ///< of the projection
  bool tested;                                   ///< whether f conserves it: what follows is of these tests
  const double* direction;                       ///< (n,) in which the Jacobian is compared with a difference
  double (*time_increment)(double t, double h);  ///< of differences with respect to t
  Called tangent;                                ///< of sensitivities, if there are any: ∇g S_j + g_pj, (k, lanes)
};

/// Sensitivities behind the state: k of them, none by default.
struct Sensitivities {
  std::size_t k = 0;
  Called slope;              ///< J S_j + f_pj, (k n, lanes)
  const double* tolerances;  ///< absolute ones, rows (k n,) of all trajectories
  bool counts;               ///< in the error test
};

/// A problem to be integrated in lanes, without parts that only some runs have: bounds, breakpoints, other limits.
struct Job {
  Called f;
  CalledSeries series;  ///< of methods by series
  std::size_t order;    ///< of the series
  std::size_t n;        ///< of the state
  Sensitivities varied;
  std::size_t all;  ///< what is integrated: (1 + k) n
  std::size_t parameters;
  std::size_t memory;  ///< rows that the method keeps of a trajectory
  const double* y0;    ///< rows (all,) of all trajectories
  const double* rows;  ///< of their parameters
  double t0, tf;       ///< finite, and different
  double hmax;         ///< finite
  double first_step;   ///< 0: chosen by the method
  double rtol;
  double max_steps;            ///< a trajectory that would need more is left
  const double* threshold;     ///< (n,)
  const double* notable;       ///< (n,): the depth below 0 at which components that start above it are judged
  const double* scale;         ///< (all,), or null: all 1
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

/// The data of a trajectory, as rows of numbers: where it is and the next |h|, whether the last attempt failed, whether
/// it is still at rest at its start, counts of steps, failures, looks at steps that stability limits, steps that were
/// looked into, evaluations of f by `BelowZero`; y with its sensitivities (all,); the history of the method, such as f
/// there (all,); its parameters; its thresholds (all,); how `BelowZero` watches its components (n,); of each event its
/// value and sign, how often it has occurred, and its slope; then the data of the invariant.
struct Rows {
  enum : std::size_t { t, h, retries, rests, steps, failed, limited, looked, falls, y };
  enum : std::size_t { last, sign, occurrences, slope, of_event };
  /// The value, the largest residuals of candidates and at outputs or the end, the largest correction in units of rtol;
  /// counts of its evaluations, of f by its tests, of its Jacobian; ‖∇g W‖; when g is tested for a change with t,
  /// and f for a rate, the drift that was acquitted; g at the end of the step, if known. Sums (n,) of the errors and
  /// the corrections that `HarmDetector` looks at; what the tangent holds of each sensitivity (k,).
  enum : std::size_t {
    value,
    before,
    after,
    correction,
    evaluations,
    checks,
    jacobians,
    norm,
    next_look,
    quiet,
    acquitted,
    end,
    known,
    errors
  };
  std::size_t memory, parameters, thresholds, watch, events, invariant, size;

  explicit Rows(const Job& job)
      : memory(y + job.all),
        parameters(memory + job.memory),
        thresholds(parameters + job.parameters),
        watch(thresholds + job.all),
        events(watch + job.n),
        invariant(events + of_event * job.count_of_events),
        size(invariant + (job.invariant != nullptr ? errors + 2 * job.n + job.varied.k : 0)) {}
};

/// A trajectory in its lane: rows that are `stride` apart.
struct Lane {
  std::uint32_t trajectory;
  const Rows& rows;
  double* state;
  std::size_t stride;

  double& operator[](std::size_t row) const { return state[row * stride]; }
};

/// It has reached tf, or a terminal event. Evaluations of f, and those in search of its jumps.
struct Ended {
  Lane lane;
  bool by_event;
  std::int64_t evaluations, checks;
};

/// It is between two attempts. `series`: of failed attempts, whose two points are (2, n).
struct Suspended {
  Lane lane;
  std::size_t output;  ///< the number of the next one
  std::int64_t checks;
  SeriesState series;
  const double* points;
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

/// A step to (t1, y1) in which components fall below 0, y1 (n,) with the stride of the lane, after so many attempts.
struct Fallen {
  Lane lane;
  double t1;
  const double* y1;
  std::int64_t attempts;
};

/// A step in which the sign of an event changes, from where the lane is to (t1, y1), y1 (n,) and the numbers of its
/// `Segment` with the stride of the lane. What is known of the events is that at t1 when it has been searched.
struct Crossed {
  Lane lane;
  double t1;
  const double *y1, *segment;
};

/// The result of a search. Unless it is sound the trajectory is to be left. `terminal`: it ends at (t, y), y (n,).
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

/// Hands out trajectories and takes them back; one for each thread.
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
  /// y with its sensitivities (all,) with that stride, at output time number `output`.
  virtual void put_out(std::uint32_t trajectory, std::size_t output, const double* y, std::size_t stride) = 0;
  virtual void keep(const Ended& ended) = 0;
  /// Something rare has happened to it: it is to be integrated from its start by the code that knows everything.
  virtual void leave(std::uint32_t trajectory, Why why) = 0;
  /// It has too few neighbours left: it is to go on alone.
  virtual void go_on(const Suspended& suspended) = 0;
  /// Returns whether f is discontinuous there; evaluations of f in search of it are added to `checks`.
  virtual bool jumps(const Suspicion& suspicion, std::int64_t& checks) = 0;
  /// Judges components that fall. Returns whether f can be evaluated there.
  [[nodiscard]] virtual bool judge(const Fallen& step) = 0;
  [[nodiscard]] virtual bool cancelled() const = 0;
  /// Memory aligned to 64 bytes, until the host ends.
  [[nodiscard]] virtual void* allocate(std::size_t bytes) = 0;
};

/// A method's integrator in lanes.
struct Kernel {
  std::string_view method;
  std::size_t lanes;  ///< trajectories side by side
  /// Integrates what the host hands out, until it has no more.
  void (*run)(const Job& job, Host& host);
  /// Goes on with one trajectory of a pair, f having one lane. Null, but for the instructions that every processor has.
  void (*go_on)(const Job& job, const Suspended& from, Host& host);
};

/// An instruction set for which there are kernels.
struct Instructions {
  std::string_view name;
  std::size_t lanes;  ///< trajectories side by side of Runge-Kutta pairs
  std::span<const Kernel> kernels;

  /// The kernel of the method; null unless it is a Runge-Kutta pair, or Taylor series.
  [[nodiscard]] const Kernel* kernel(std::string_view method) const;
};

/// Each has an object file of its own, compiled with flags of its own; there are the last two on x86 only.
extern const Instructions of_baseline, of_avx2, of_avx512;

/// The instruction sets that this processor has, the best one first; the last one is that of every processor.
[[nodiscard]] std::span<const Instructions* const> instructions();

}  // namespace invariode::lanes
