#pragma once
// Many runs of one problem, from different initial values and with different parameters, on several threads.

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <string_view>
#include <vector>

#include "run/lanes/lanes.hpp"
#include "run/problem.hpp"
#include "run/run.hpp"

namespace invariode {

/// The outcomes of the trajectories: one row for each.
class EnsembleResult {
 public:
  /// Occurrences of one event: in which trajectory, when and where.
  struct Occurrences {
    std::vector<std::int64_t> trajectory;
    Trajectory points;
  };
  /// Why a trajectory ended early.
  struct Failure {
    std::size_t trajectory;
    State state;
    Report report;
  };
  /// The states, beside those of State, of a trajectory that could not start: its initial value is not finite, or not
  /// consistent.
  static constexpr std::int8_t not_finite = -1, not_found = -2, index_too_high = -3, undetermined = -4;
  /// The state of a trajectory that was not solved to its end since the ensemble was cancelled. Its row of
  /// outputs may be written in part.
  static constexpr std::int8_t unsolved = -5;
  static constexpr std::size_t counts = RunResult::count_size;
  /// Trajectories that were left to the code for one at a time, by `lanes::Why`.
  using Left = std::array<std::size_t, lanes::whys>;

  EnsembleResult(std::size_t size, const Solver& solver);

  // Several threads may call these, for different trajectories i.

  /// Notes that trajectory i cannot start.
  void refuse(std::size_t i, std::int8_t why, double t0, const double* y0);
  /// Its invariants are held at their present values.
  void hold(std::size_t i, Run& run);
  /// Keeps what it did; ng gets `uncounted` more. The times of y that it did not reach stay NaN.
  void keep(std::size_t i, Run& run, std::int64_t uncounted);
  /// Output number j, y with its sensitivities (n,) with that stride.
  void put_out(std::size_t i, std::size_t j, const double* row, std::size_t stride) {
    for (std::size_t c = 0; c < n; ++c)
      y[((i * n + c - c % parts) / parts * n_t + j) * parts + c % parts] = row[c * stride];
  }
  /// Stores the results of a trajectory that has ended in a lane, except for its outputs.
  void keep(const lanes::Ended& ended, const Solver& solver);
  /// Stores the occurrences of each event.
  void keep_occurrences(std::size_t i, const std::vector<Trajectory>& found);
  /// Adds to the numbers of trajectories that were solved one at a time, though others were not.
  void add_alone(const Left& left);

  std::size_t size, n, parts, m, n_t;  ///< n: of a state and its sensitivities
  std::vector<double> t, y_end;
  std::vector<double> y;  ///< (size, n / parts, n_t, parts): numbers of one or two reals
  /// For each invariant the value held, and the largest residual before and after projection; the largest correction.
  std::vector<double> value, before, after, correction;
  std::vector<double> clipped;  ///< what bounds have added to the sum of the components
  /// The t from which on stability limits the steps, where f jumps for the first time that was seen, after which
  /// actions of an event that came closer and closer are missing; NaN: nowhere.
  std::vector<double> stiff_since, discontinuity, accumulation;
  std::vector<std::int64_t> count;  ///< (size, counts)
  std::vector<std::int8_t> state;   ///< a State, or why it could not start, or `unsolved`
  std::vector<Occurrences> occurrences;
  std::vector<Failure> failures;
  Left alone{};  ///< of an ensemble in lanes

 private:
  std::int64_t& count_of(std::size_t i, std::string_view name);
  void keep_held(const lanes::Lane& lane, std::size_t states, double rtol);
  void keep_outputs(std::size_t i, const RunResult& run);
  void measure_drift(std::size_t i, const RunResult& run, Invariants& invariants, double forward);
  void keep_happenings(std::size_t i, const RunResult& run);

  std::mutex shared_;  // for occurrences, failures and alone
};

/// The rows that are integrated: `size` rows of y0, with its sensitivities (n doubles each), and of parameters
/// (`parameters` doubles each).
struct Ensemble {
  std::size_t size;
  const double* y0;
  const double* rows;  ///< of parameters
  std::size_t n, parameters;
  const double* tolerances = nullptr;  ///< rows of those of the sensitivities, if there are any
};

/// The functions of a problem in the lanes of an instruction set: f, and its series if the method takes them, and of an
/// invariant that is held g and its Jacobian, and the events; the slope of sensitivities, and their tangent to the
/// invariant.
struct LaneForm {
  const lanes::Instructions* instructions = nullptr;
  lanes::Called f;
  lanes::CalledSeries series;
  lanes::Called g, jacobian;
  lanes::Called slope, tangent;
  std::vector<lanes::Called> events;
};

/// Trajectory i, on a thread that has the solver to itself.
void integrate_one(Solver& solver, const Ensemble& ensemble, std::size_t i, const std::atomic<bool>& cancelled,
                   EnsembleResult& result);

/// Integrates from each row, on as many threads as there are solvers: one for each, all of the same problem, with
/// functions that need no interpreter; in lanes, if f has a form for them and nothing speaks against it
/// (`obstacle_to_lanes`). Every `watch_interval`, and at the end, watch(done) is called on this thread; by
/// returning false it cancels the rest, whose states stay `EnsembleResult::unsolved`. Throws std::invalid_argument
/// where sizes do not match or where solvers share the place of their parameters.
std::unique_ptr<EnsembleResult> integrate_all(std::span<Solver* const> solvers, const Ensemble& ensemble,
                                              const std::function<bool(std::uint32_t done)>& watch,
                                              const std::optional<LaneForm>& form = {});

}  // namespace invariode
