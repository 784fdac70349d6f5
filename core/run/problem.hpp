#pragma once
// The problem as the core sees it, and a solver: a problem with a method, tolerances and settings.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "callback.hpp"
#include "delays/delays.hpp"
#include "integrate.hpp"
#include "landings.hpp"
#include "linear/jacobian.hpp"
#include "linear/mass.hpp"
#include "linear/matrix.hpp"
#include "linear/matrix_free.hpp"
#include "manifold/bounds.hpp"
#include "manifold/invariants.hpp"
#include "methods/registry.hpp"
#include "output/events.hpp"
#include "sensitivity/variations.hpp"
#include "series.hpp"
#include "weights.hpp"

namespace invariode {

/// ∂f/∂y and the mass matrix, which has the structure of `jacobian`, as far as they are known.
struct LinearTerms {
  Jacobian::Source source;
  Matrix jacobian;  ///< the values of a constant one, else the structure
  std::optional<Mass> mass;
  std::optional<Lapack> lapack;
  std::optional<KrylovTerms> krylov;  ///< with the kind `products`
};

/// An initial value problem but for the initial value. Whoever makes it keeps what its callbacks point to.
struct Problem {
  std::size_t n = 0;     ///< doubles in a state
  bool complex = false;  ///< these are pairs: n / 2 complex numbers
  Callback f;
  std::optional<SystemSeries> series;  ///< of the solution, with its sensitivities if there are any
  double f_error = 0;                  ///< of f, relative: of derivatives that it is made of; 0: roundoff
  Callback callback;                   ///< asked after each accepted step whether to stop; may be empty
  std::vector<EventFunction> events;
  std::vector<RootVector> vectors;      ///< of which some events are components
  std::vector<Breakpoint> breakpoints;  ///< in the order of integration, inside the interval
  Landings landings;                    ///< where f changes its branch with t alone
  std::optional<DelayTerms> delays;     ///< then f takes (y, z_1, …, z_k): y, and y at earlier times
  std::vector<InvariantBlock> invariants;
  std::vector<double> value;  ///< of the invariants, one block after the other
  std::optional<LinearTerms> linear;
  std::optional<Bounds> bounds;
  bool signed_states = false;            ///< components may be negative: none that falls below 0 is reported
  bool autonomous = false;               ///< f does not depend on t
  std::optional<Variations> variations;  ///< runs integrate sensitivities too
  /// The place from which the functions read their parameters, if they have any that can be changed from run to run.
  std::span<double> parameters;

  /// The extent of the values that runs integrate, and its size, which their initial values and results have.
  [[nodiscard]] Extent extent() const { return Extent(n, variations ? variations->k : 0); }
  [[nodiscard]] std::size_t size() const { return extent().size(); }
};

/// Throws std::invalid_argument where sizes do not match: a mistake of whoever called, which would read past an array.
void require_sizes(const Problem& problem, const Weights& weights);

/// All that is known before the initial value. A solver serves any number of runs, one after the other or together, as
/// long as its functions may be called by several threads and its parameters stay. Its members do not change but by
/// `cover`, `interrupt`, `hold` and `set_tolerances`, and by what is written to the parameters.
class Solver {
 public:
  /// Throws std::invalid_argument where sizes do not match, or the method needs linear algebra that is not there.
  Solver(const Method& method, Problem problem, Weights weights, Settings settings, MethodOptions options);
  Solver(const Solver&) = delete;
  Solver& operator=(const Solver&) = delete;

  /// Its next runs cover another interval, with other output times and limits, those of the settings. Throws
  /// std::invalid_argument where a setting cannot be.
  void cover(Settings settings);
  /// Its next runs have other breakpoints and another callback.
  void interrupt(std::vector<Breakpoint> breakpoints, Callback callback);
  /// Its next runs hold the invariants at these values.
  void hold(std::span<const double> value);
  /// Its next runs have other absolute tolerances of the sensitivities, (k, n).
  void set_tolerances(std::span<const double> tolerance);

  [[nodiscard]] const Method& method() const { return method_; }
  [[nodiscard]] const Problem& problem() const { return problem_; }
  /// The weights of the state.
  [[nodiscard]] const Weights& weights() const { return weights_; }
  /// The weights of the state and its sensitivities; those of the state without sensitivities.
  [[nodiscard]] const Weights& augmented_weights() const { return augmented_weights_ ? *augmented_weights_ : weights_; }
  /// The weights in which Newton's iteration converges, also for sensitivities that are not in the error test.
  [[nodiscard]] const Weights& iteration_weights() const { return iteration_weights_ ? *iteration_weights_ : weights_; }
  [[nodiscard]] const Settings& settings() const { return settings_; }
  [[nodiscard]] const MethodOptions& options() const { return options_; }
  /// The Jacobian, to be copied, since each run has increments of its own; null without linear terms.
  [[nodiscard]] const Jacobian* jacobian() const { return jacobian_ ? &*jacobian_ : nullptr; }

 private:
  void weigh_variations();

  const Method& method_;
  Problem problem_;
  Weights weights_;
  std::optional<Weights> augmented_weights_, iteration_weights_;
  Settings settings_;
  MethodOptions options_;
  std::optional<Jacobian> jacobian_;
};

/// The Jacobian that the problem, which has linear terms, describes; with increments that stay within its bounds. The
/// weights belong to the caller and outlive it.
Jacobian make_jacobian(const Problem& problem, const Weights& weights);
Box box_of(const Bounds& bounds);

}  // namespace invariode
