#pragma once
// Given points instead of a run: how they stand to the invariants, and moved to where they belong.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "linear/mass.hpp"
#include "linear/pattern.hpp"
#include "manifold/guard.hpp"
#include "run/problem.hpp"
#include "weights.hpp"

namespace invariode {

/// `count` points: times, and rows of states.
struct Points {
  const double* t;
  const double* y;
  std::size_t count;
};

// Each of the following takes as many values as there are invariants and weights of the size of the problem, or throws
// std::invalid_argument; and returns nothing where a user function has stopped it.

/// g − value at each point: (count, m).
std::optional<std::vector<double>> residuals(const Problem& problem, const Points& points);

/// Distances of each point from the level sets of the invariants, in units of rtol: (count, m). 0 where an invariant is
/// stationary.
std::optional<std::vector<double>> distances(const Problem& problem, const Weights& weights, const Points& points);

/// Points projected to roundoff, with what is left of the residuals. One that did not converge is where it was.
struct ImposedPoints {
  std::vector<double> y;                            ///< (count, n)
  std::vector<double> residual;                     ///< (count, m)
  std::vector<std::int64_t> converged, iterations;  ///< (count,)
};
std::optional<ImposedPoints> impose(const Problem& problem, const Weights& weights, const Points& points);

/// The state of each invariant at one point, and what speaks against its Jacobian.
struct PointExamination {
  bool finite = false;  ///< false: g, its Jacobian or f is not finite there, and the rest is not known
  std::vector<Guard::Examination> invariants;
  Finding jacobian;
};
std::optional<PointExamination> examine(const Problem& problem, const Weights& weights, double t, const double* y);

/// y0 moved until the algebraic equations of a singular mass matrix hold, and how that ended. The problem must have a
/// mass matrix.
struct ConsistentStart {
  std::vector<double> y0;
  Consistency verdict;
};
std::optional<ConsistentStart> consistent_start(const Problem& problem, const Weights& weights, double t0,
                                                const double* y0);

/// ∂f/∂y at a point, as an implicit method begins with it.
std::optional<Matrix> jacobian_at(const Problem& problem, const Weights& weights, double t, const double* y);

/// The sparsity pattern of ∂f/∂y near a point, unless the search has given up, how many evaluations of f that took, and
/// how many a Jacobian by differences takes with the pattern.
struct FoundPattern {
  std::optional<Pattern> pattern;
  std::int64_t calls = 0;
  std::size_t groups = 0;
};
std::optional<FoundPattern> sparsity(const Problem& problem, double t, const double* y, const PatternSearch& search);

}  // namespace invariode
