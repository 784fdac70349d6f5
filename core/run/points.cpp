#include "run/points.hpp"

#include <stdexcept>

#include "functions/confined.hpp"
#include "linear/groups.hpp"
#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "manifold/slope.hpp"
#include "require.hpp"

namespace invariode {
namespace {

Invariants bound(const Problem& problem, const Weights& weights) {
  require_sizes(problem, weights);
  return {problem.n, problem.invariants, problem.value, weights};
}

}  // namespace

std::optional<std::vector<double>> residuals(const Problem& problem, const Points& points) {
  const Weights weights(1, std::vector<double>(problem.n), {});  // of no consequence for values
  Invariants g = bound(problem, weights);
  std::vector<double> r(points.count * g.m());
  for (std::size_t p = 0; p < points.count; ++p)
    if (g.residual(points.t[p], points.y + p * problem.n, r.data() + p * g.m()) == Status::stop) return {};
  return r;
}

std::optional<std::vector<double>> distances(const Problem& problem, const Weights& weights, const Points& points) {
  Invariants g = bound(problem, weights);
  Projector projector(g, weights, 1);
  const std::size_t m = g.m();
  std::vector<double> d(points.count * m);
  for (std::size_t p = 0; p < points.count; ++p) {
    if (projector.linearize_at(points.t[p], points.y + p * problem.n) == Outcome::stop) return {};
    for (std::size_t i = 0; i < m; ++i) d[p * m + i] = projector.linearization().distance(i) / weights.rtol();
  }
  return d;
}

std::optional<ImposedPoints> impose(const Problem& problem, const Weights& weights, const Points& points) {
  Invariants g = bound(problem, weights);
  Projector projector(g, weights, 1);
  const std::size_t n = problem.n, m = g.m();
  ImposedPoints all{.y = std::vector<double>(points.y, points.y + points.count * n),
                    .residual = std::vector<double>(points.count * m),
                    .converged = std::vector<std::int64_t>(points.count),
                    .iterations = std::vector<std::int64_t>(points.count)};
  for (std::size_t p = 0; p < points.count; ++p) {
    double* y = all.y.data() + p * n;
    const Imposed imposed = projector.impose(points.t[p], y);
    if (imposed.outcome == Outcome::stop) return {};
    if (g.residual(points.t[p], y, all.residual.data() + p * m) == Status::stop) return {};
    all.converged[p] = imposed.converged;
    all.iterations[p] = imposed.iterations;
  }
  return all;
}

std::optional<PointExamination> examine(const Problem& problem, const Weights& weights, double t, const double* y) {
  require(static_cast<bool>(problem.f), "only an f conserves invariants: the problem has none");
  Invariants g = bound(problem, weights);
  ExplicitSlope slope(problem.f, problem.f_error);
  const Projector projector(g, weights, 1);
  Guard guard(projector, weights, slope, 0);
  PointExamination all;
  const Outcome outcome = guard.examine(t, y, all.invariants);
  if (outcome == Outcome::stop) return {};
  all.finite = outcome == Outcome::ok;
  if (!all.finite) return all;
  std::vector<double> point(y, y + problem.n);
  all.jacobian = guard.start_value(t, point.data());
  if (all.jacobian.kind == Finding::Kind::stop) return {};
  all.jacobian = guard.start_jacobian(t, point.data());
  if (all.jacobian.kind == Finding::Kind::stop) return {};
  return all;
}

std::optional<ConsistentStart> consistent_start(const Problem& problem, const Weights& weights, double t0,
                                                const double* y0) {
  require_sizes(problem, weights);
  if (!problem.f || !problem.linear || !problem.linear->mass)
    throw std::invalid_argument("algebraic equations come from f and a mass matrix: the problem lacks one of them");
  Problem bounded = problem;
  std::optional<Confined> confined;
  if (problem.bounds) {
    confined.emplace(*problem.bounds, weights);
    bounded.f = confined->within(problem.f);
    bounded.linear->source = confined->within(problem.linear->source);
  }
  const LinearTerms& linear = *bounded.linear;
  Callback f = bounded.f;
  const Jacobian jacobian = make_jacobian(bounded, weights);
  Mass mass = *linear.mass;
  ConsistentStart start{.y0 = std::vector<double>(y0, y0 + problem.n), .verdict = {}};
  const LinearAlgebra algebra{
      .jacobian = &jacobian, .mass = &mass, .lapack = linear.lapack ? &*linear.lapack : nullptr};
  start.verdict = make_consistent(f, algebra, weights, t0, start.y0.data());
  if (start.verdict == Consistency::stop) return {};
  return start;
}

std::optional<Matrix> jacobian_at(const Problem& problem, const Weights& weights, double t, const double* y) {
  require_sizes(problem, weights);
  require(problem.f && problem.linear, "the problem does not say what its Jacobian is");
  Callback f = problem.f;
  Jacobian jacobian = make_jacobian(problem, weights);
  std::vector<double> slope(problem.n);
  if (f(t, y, slope.data()) == Status::stop) return {};
  if (jacobian.evaluate(f, t, y, slope.data()) == Status::stop) return {};
  return jacobian.matrix();
}

std::optional<FoundPattern> sparsity(const Problem& problem, double t, const double* y, const PatternSearch& search) {
  require(static_cast<bool>(problem.f), "a pattern is found from f: the problem has none");
  Callback f = problem.f;
  FoundPattern found;
  bool stopped = false;
  const Box box = problem.bounds ? box_of(*problem.bounds) : Box{};
  found.pattern = find_pattern_near(f, t, {y, y + problem.n}, box, search, stopped);
  if (stopped) return {};
  found.calls = f.calls();
  if (found.pattern)
    found.groups = group_columns(problem.n, problem.n, found.pattern->starts.data(), found.pattern->rows.data()).size();
  return found;
}

}  // namespace invariode
