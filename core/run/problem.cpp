#include "run/problem.hpp"

#include <string>
#include <utility>

#include "require.hpp"

namespace invariode {
namespace {

void require_settings(const Settings& settings) {
  require(settings.hmax > 0 || settings.t0 == settings.tf, "max_step must be positive: infinity for no cap");
  require(settings.refine >= 1, "refine must be at least 1");
  require(settings.output_at_times || settings.times.empty(), "times are given and not asked for");
}

/// Checks that the problem has what its sensitivities need.
void require_variations(const Problem& problem) {
  const Variations& variations = *problem.variations;
  require(static_cast<bool>(variations.slope), "the sensitivities have no slope");
  require(variations.tolerance.size() == variations.k * problem.n,
          "tolerances of sensitivities do not fit " + std::to_string(variations.k) + " parameters of a problem of " +
              std::to_string(problem.n));
  require(!variations.quadratures || (problem.invariants.empty() && !problem.bounds),
          "quadratures go with neither invariants nor bounds");
  for (const InvariantBlock& block : problem.invariants)
    require(static_cast<bool>(block.tangent), "an invariant has no tangent for the sensitivities");
  for (const EventFunction& event : problem.events)
    require(!event.action || event.jump, "an event has an action and no jump of the sensitivities");
  for (const Breakpoint& point : problem.breakpoints)
    require(!point.action || point.jump, "a breakpoint has an action and no jump of the sensitivities");
}

void require_series(const Method& method, const Problem& problem) {
  const std::string name = method.name;
  require(problem.series.has_value(), name + " needs the Taylor coefficients of the solution");
  const int order = problem.series->solution.order();
  require(method.min_order <= order && order <= method.order, name + " has orders " + std::to_string(method.min_order) +
                                                                  " to " + std::to_string(method.order) + ", not " +
                                                                  std::to_string(order));
  require(problem.series->count == 0 || problem.series->conditions.order() == order,
          "conditions are expanded to another order than the solution");
}

bool takes_mass(const Method& method, const Problem& problem) {
  if (method.mass != MassMatrices::constant_regular || !problem.linear || !problem.linear->mass) return true;
  return problem.linear->mass->constant() && !problem.linear->mass->singular();
}

}  // namespace

void require_sizes(const Problem& problem, const Weights& weights) {
  require(weights.size() == problem.n, "tolerances for " + std::to_string(weights.size()) +
                                           " components do not fit a problem of " + std::to_string(problem.n));
  require(weights.scale().empty() || weights.scale().size() == problem.n, "scale and threshold differ in length");
  require(!problem.complex || problem.n % 2 == 0, "a complex state is an even number of reals");
  std::size_t m = 0;
  for (const InvariantBlock& block : problem.invariants) m += block.m;
  require(m == problem.value.size(), std::to_string(m) + " invariants and " + std::to_string(problem.value.size()) +
                                         " values: give one value for each invariant");
  require(!problem.bounds || problem.bounds->n() == problem.n, "bounds are not of the size of the problem");
  require(!problem.bounds || !problem.complex, "a complex state has no bounds");
  if (!problem.linear) return;
  const LinearTerms& linear = *problem.linear;
  require(linear.jacobian.n() == problem.n, "the Jacobian is not of the size of the problem");
  require(!linear.mass || linear.mass->matrix().n() == problem.n, "the mass matrix is not of the size of the problem");
}

Jacobian make_jacobian(const Problem& problem, const Weights& weights) {
  Jacobian jacobian(problem.linear->source, problem.linear->jacobian, weights);
  if (problem.bounds) jacobian.keep_within(box_of(*problem.bounds));
  return jacobian;
}

Box box_of(const Bounds& bounds) { return {.lower = bounds.lower(), .upper = bounds.upper()}; }

Solver::Solver(const Method& method, Problem problem, Weights weights, Settings settings, MethodOptions options)
    : method_(method),
      problem_(std::move(problem)),
      weights_(std::move(weights)),
      settings_(std::move(settings)),
      options_(options) {
  require_sizes(problem_, weights_);
  require_settings(settings_);
  require(static_cast<bool>(problem_.f), "the problem has no f");
  if (problem_.variations) {
    require_variations(problem_);
    weigh_variations();
  }
  require(!method_.implicit() || method_.switches() || problem_.linear,
          std::string(method_.name) + " is implicit: the problem must say what its Jacobian is");
  const Method& explicit_one = method_.switches() ? members(options_).explicit_one : method_;
  if (explicit_one.equations == Equations::graph) require_series(explicit_one, problem_);
  require(takes_mass(method_, problem_),
          std::string(method_.name) + " takes a constant and regular mass matrix only; use ode15s or radau");
  require(!problem_.linear ||
              problem_.linear->krylov.has_value() == (problem_.linear->source.kind == Jacobian::Kind::products),
          "products with the Jacobian go with Krylov terms");
  const Method& implicit_one = method_.switches() ? members(options_).implicit_one : method_;
  require(!problem_.linear || !problem_.linear->krylov || implicit_one.takes("linear_solver"),
          std::string(implicit_one.name) + " needs exact solutions of its linear systems; use ode15s");
  require(!problem_.delays || (method_.delays && settings_.tf >= settings_.t0),
          std::string(method_.name) + " takes no delays, or the run goes backwards");
  require(method_.equations != Equations::second_order || (problem_.n % 2 == 0 && !problem_.bounds),
          std::string(method_.name) + " takes a state of positions and velocities, without bounds");
  options_.state = problem_.n;
  options_.projected = !problem_.invariants.empty() || problem_.bounds.has_value();
  if (problem_.linear) jacobian_.emplace(make_jacobian(problem_, weights_));
}

void Solver::cover(Settings settings) {
  require_settings(settings);
  settings_ = std::move(settings);
}

void Solver::interrupt(std::vector<Breakpoint> breakpoints, Callback callback) {
  problem_.breakpoints = std::move(breakpoints);
  problem_.callback = callback;
}

void Solver::hold(std::span<const double> value) {
  require(value.size() == problem_.value.size(), "an invariant has another number of values");
  problem_.value.assign(value.begin(), value.end());
}

void Solver::set_tolerances(std::span<const double> tolerance) {
  problem_.variations->tolerance.assign(tolerance.begin(), tolerance.end());
  weigh_variations();
}

void Solver::weigh_variations() {
  augmented_weights_ = augmented(weights_, *problem_.variations, problem_.variations->error_test);
  iteration_weights_ = augmented(weights_, *problem_.variations, true);
}

}  // namespace invariode
