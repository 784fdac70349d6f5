#pragma once
// One run of a solver: how it is assembled, and what it comes to.

#include <array>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "callback.hpp"
#include "delays/delays.hpp"
#include "functions/confined.hpp"
#include "functions/piece.hpp"
#include "integrate.hpp"
#include "linear/jacobian.hpp"
#include "linear/mass.hpp"
#include "manifold/invariants.hpp"
#include "manifold/slope.hpp"
#include "run/problem.hpp"
#include "run/sections.hpp"
#include "sensitivity/block_system.hpp"
#include "sensitivity/tangent.hpp"

namespace invariode {

/// The result of a run, with arrays that have one row per point, counts, and why it ended.
struct RunResult {
  std::size_t n = 0;  ///< doubles of a point: of the state, and of its sensitivities behind it
  Trajectory points;
  std::vector<Trajectory> occurrences;  ///< of each event
  Buffer<AcceptedStep> record;
  Drift drift;
  std::vector<Jump> jumps;
  std::optional<DenseOutput> dense;
  std::vector<Section> sections;
  State state = State::created;
  Report report;
  Counts counts;
  std::int64_t switches = 0;  ///< from an explicit to an implicit method, or back
  LinearWork linear;
  std::int64_t nfev = 0;
  std::int64_t nfev_check =
      0;  ///< evaluations of f by the tests of invariants, Jacobians and components below 0, and in search of its jumps
  std::int64_t ng = 0, ngjac = 0;
  std::int64_t ngdiff = 0;  ///< of ng, those for Jacobians
  bool projected_start = false;
  std::vector<Derivative> derivatives;  ///< of each block of invariants: where its Jacobian came from
  std::vector<int> dropped;             ///< redundant invariants, and the t at which the first was seen
  double dropped_at = 0;
  std::vector<double> unresolved;  ///< of each invariant: its roundoff, in tolerances
  Harm harm;
  Component below_zero;  ///< which has fallen there though f did not lead it
  Stiffness stiffness;
  std::vector<double> marks;                 ///< t and level of those that delays have brought
  std::vector<double> discontinuities;       ///< of f, where they were seen
  std::optional<double> sticks_since;        ///< the solution stays where f jumps
  std::optional<Accumulation> accumulation;  ///< of events with actions
  double clipped = 0;                        ///< what bounds have added to the sum of the components
  double t_end = 0;
  std::optional<std::vector<double>> y_end;  ///< nothing: the last of the points
  double next_h = 0;

  static constexpr const char* count_names[] = {
      "steps",   "failed",  "nfev",   "nfev_check", "njev",   "nlu",      "nsolve",   "projections",
      "skipped", "clipped", "ng",     "ngjac",      "ngdiff", "switches", "products", "linear_iterations",
      "dropped", "harmed",  "fallen", "stiff"};
  static constexpr std::size_t count_size = std::size(count_names);
  /// The counts in the order of `count_names`. "dropped" is of invariants; "harmed" is 1 + the component of `harm`,
  /// "fallen" that of `below_zero`, 0: none; "stiff" is 1 where `stiffness` was found.
  [[nodiscard]] std::array<std::int64_t, count_size> counted() const;
  [[nodiscard]] const double* end() const { return y_end ? y_end->data() : points.y.data() + points.y.size() - n; }
};

/// Everything that changes while a solver integrates. The solver outlives it.
class Run {
 public:
  explicit Run(const Solver& solver);
  Run(const Run&) = delete;
  Run& operator=(const Run&) = delete;

  /// Holds the invariants whose values are not demanded at those of the initial value, which is moved before where the
  /// algebraic equations of a singular mass matrix ask for it. For a run whose solver was made for another y0.
  Consistency prepare(double t0, double* y0);
  /// Evaluations of invariants by `prepare`: the result counts them, where a single solve counts its own before the
  /// run.
  [[nodiscard]] std::int64_t evaluations_of_prepare() const;

  /// Goes on by one accepted step, or to the end: as the integration does, with sections where they are wanted.
  State advance();
  State run();

  [[nodiscard]] Integration& integration() { return *integration_; }
  [[nodiscard]] const Integration& integration() const { return *integration_; }
  /// The user's invariants; null without any.
  [[nodiscard]] Invariants* invariants() { return users_invariants_; }
  /// The user's invariants when the run has ended: as functions of every t, not only of those in the last piece.
  [[nodiscard]] Invariants* invariants_everywhere();
  [[nodiscard]] double forward() const;
  /// Evaluations of f by the method; an expansion is one.
  [[nodiscard]] std::int64_t evaluations() const {
    return method_f_->calls() + (blocks_ ? blocks_->whole().calls() : 0) + (series_ ? series_->solution.calls() : 0);
  }

  /// Returns the result of the run when it has ended. Arrays are moved out: once only.
  RunResult take_result();
  /// The lengths of the arrays that are known already.
  struct Marks {
    std::size_t points = 0, steps = 0, jumps = 0, knots = 0;
    std::vector<std::size_t> occurrences;
  };
  /// Returns the result so far, with the arrays from the marks on, which are set to their ends. Rows of jumps count
  /// from the mark.
  [[nodiscard]] RunResult result_since(Marks& marks) const;

  /// Returns the memory of the run, between two steps or when it has ended, before the result is taken; without
  /// matrices of more entries than `most_values`.
  [[nodiscard]] RunMemory memory(std::size_t most_values);
  /// Instead of `Integration::start`: goes on from what another run of the same problem remembered. `anew`: see
  /// `Integration::resume`. Throws std::invalid_argument where the memory does not fit.
  State resume(std::span<const std::byte> memory, bool anew);

 private:
  void wrap_functions();
  void wrap_in_pieces(Problem& problem);
  void wrap_in_bounds(Problem& problem);
  void copy_linear_terms();
  void keep_within_bounds();
  void derive_slope();
  void bind_invariants();
  [[nodiscard]] Invariants bound(std::vector<InvariantBlock> blocks, std::vector<double> value) const;
  [[nodiscard]] bool moves_off_algebraic_equations() const;
  Invariants with_algebraic_equations();
  void start_loop();
  void state(Archive& archive);
  void archive_prepared(Archive& archive);
  void describe(RunResult& result) const;
  void count_evaluations(RunResult& result) const;
  void describe_invariants(RunResult& result) const;
  LinearAlgebra linear_algebra();
  [[nodiscard]] std::optional<DifferentialRate> rate() const;

  /// The functions of the run: the solver's, or what a piece between breakpoints sees of them, within bounds.
  [[nodiscard]] const Problem& problem() const { return wrapped_ ? *wrapped_ : solver_.problem(); }

  const Solver& solver_;
  Piece piece_;
  std::optional<Delays> delays_;
  std::optional<Confined> confined_;
  std::optional<Problem> wrapped_;
  Callback users_f_;  // within bounds: f before it is confined to them
  Callback f_;
  std::optional<SystemSeries> series_;

  // Of its own, since evaluating them changes them.
  std::optional<Jacobian> jacobian_;
  std::optional<Mass> mass_;
  std::optional<Lapack> lapack_;  // with the poll of this run

  std::optional<BoundedSlope> bounded_slope_;
  Callback bounded_f_;
  Callback* method_f_ = &f_;              // the slope of the state: f, or what keeps it within bounds
  std::optional<BlockEquations> blocks_;  // with sensitivities: what the method integrates
  std::unique_ptr<Slope> slope_;
  std::optional<AlgebraicConstraints> algebraic_;
  std::optional<AlgebraicTangent> algebraic_tangent_;
  std::optional<Invariants> steps_;    // imposed on steps: with a singular mass matrix, the algebraic equations too
  std::optional<Invariants> between_;  // where those differ, the user's invariants alone
  Invariants* users_invariants_ = nullptr;
  ManifoldTerms manifold_;

  std::optional<Integration> integration_;
  std::optional<Sections> sections_;
  std::int64_t prepared_ = 0;  // evaluations of invariants by `prepare`,
  std::int64_t before_ = 0;    // and by that of the run that goes on here, which did not count them
};

}  // namespace invariode
