#pragma once
// Problems, tolerances and settings as Python describes them, and the core's problem made of them.

#include <nanobind/nanobind.h>

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <tuple>
#include <variant>
#include <vector>

#include "arrays.hpp"
#include "callables.hpp"
#include "integrate.hpp"
#include "methods/registry.hpp"
#include "run/problem.hpp"
#include "weights.hpp"

namespace invariode::binding {

/// An invariant: g, its Jacobian or the name of what takes its place, number and name of its values, whether they are
/// held, not demanded; its level, and the reals of y that its correction may move (none: all), and
/// the metric in which it is the least.
struct InvariantSpec {
  nb::object fun, jac;
  std::size_t m;
  std::string name;
  bool held;
  int level = 0;
  std::vector<std::size_t> moves;
  nb::object metric;            // None, or G(t, y), or a constant
  std::size_t metric_size = 0;  // how many values it has
  int sense = 0;                // −1: it never rises as t grows; 1: it never falls; 0: it is kept
  bool along_steps = false;     // its correction is made of what the step is made of
  RowPattern pattern;           // of what `jac` returns; none: it is full
  bool users = false;           // `jac` is the user's function

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, fun, jac, metric); }
};

struct EventSpec {
  nb::object fun;
  std::int64_t terminal;
  int direction;
  std::string name;
  nb::object action;
  bool rehold;
  int samples;
  std::optional<SeriesSpec> series;  // along polynomials
  bool touching = false;
  bool at_jumps = true;

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, fun, action, series); }
};

/// Events that are one function with one action; they follow in the list of events from number `first` on.
struct VectorSpec {
  nb::object fun;
  std::size_t first, count;
  std::string name;
  nb::object action;  // (t, (y, d)) -> y

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, fun, action); }
};

/// A breakpoint: its time, and its action or None.
struct BreakpointSpec {
  double t;
  nb::object action;

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, action); }
};

/// ∂f/∂y and M as far as they are known.
struct LinearSpec {
  Structure structure;
  Jacobian::Kind kind;
  nb::object jacobian;         // its values; its function, of complex steps f at complex y, of products None (each with
                               // the pattern of a sparse one); or for sparse differences the pattern
  nb::object mass;             // None, the values of a constant one, or M(t)
  nb::object null_basis;       // (starts, rows, values) of Z
  nb::object lapack;           // None, or a function that returns capsules by name
  std::int64_t found_pattern;  // evaluations of f that found the pattern; 0: it was given
  nb::object product, preconditioner;  // of the kind `products`, and of derived ones without a function; or None
  std::size_t dimension;               // of its Krylov space
  nb::object rate;                     // ∂f/∂t, or None

  int visit(visitproc visit, void* arg) const {
    return visit_all(visit, arg, jacobian, mass, null_basis, lapack, product, preconditioner, rate);
  }
};

/// Sensitivities, or quadratures: how many parameters, M S' of each, tolerances of S (k, n), and one function for each
/// invariant, event and breakpoint, or None where events and breakpoints do not act.
struct VariationsSpec {
  std::size_t k;
  nb::object slope;
  ConstMatrix thresholds;
  std::vector<nb::object> invariants, jumps, breakpoints;
  nb::object landings;  // at landings, or None
  bool error_test, quadratures;

  int visit(visitproc visit, void* arg) const {
    return visit_all(visit, arg, slope, invariants, jumps, breakpoints, landings);
  }
};

/// Delays: their values; the index of each among the parameters, or −1 for a constant; the history, which is an array
/// if it is constant, otherwise a function (t, anything) -> y; and the times before t0 at which the history jumps.
struct DelaysSpec {
  std::vector<double> lags;
  std::vector<std::int64_t> parameters;
  std::vector<double> constant;
  nb::object history;
  std::vector<double> jumps;
  std::vector<double> rates;  // ∂τ_j/∂p, (lags, k), with sensitivities

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, history); }
};

/// Single times, and the first times and the periods of progressions.
using LandingsSpec = std::tuple<std::vector<double>, std::vector<double>, std::vector<double>>;

struct ProblemSpec {
  std::size_t n;
  bool complex;
  nb::object fun;
  nb::tuple args;
  ConstVector parameters;
  std::optional<LinearSpec> linear;
  std::vector<EventSpec> events;
  std::vector<VectorSpec> vectors;
  std::vector<BreakpointSpec> breakpoints;
  LandingsSpec landings;
  nb::object callback;
  std::vector<InvariantSpec> invariants;
  std::optional<ConstVector> value;
  std::optional<ConstVector> lower, upper;  // bounds of y
  bool signed_states;                       // y may be negative
  std::optional<VariationsSpec> variations;
  std::optional<SeriesSpec> series;      // of the solution
  std::optional<SeriesSpec> conditions;  // of f, along it
  std::size_t condition_count;
  std::optional<DelaysSpec> delays;  // then fun takes (t, y, z)

  /// The number of values of all invariants.
  [[nodiscard]] std::size_t m() const { return value ? value->size() : 0; }

  int visit(visitproc visit, void* arg) const {
    return visit_all(visit, arg, fun, args, linear, events, vectors, breakpoints, callback, invariants, variations,
                     series, conditions, delays);
  }
};

/// rtol, thr of all components or of each, and the scales of a vector rtol, if it was one.
struct Tolerances {
  double rtol;
  std::variant<double, ConstVector> threshold;
  std::optional<ConstVector> scale;

  [[nodiscard]] Weights for_size(std::size_t n) const;
};

/// Throws std::invalid_argument where rtol and scales are not positive, thresholds not 0 or positive.
Weights to_weights(double rtol, std::vector<double> threshold, std::vector<double> scale);

/// All that a run can be told, for the loop and for the method.
struct RunSettings : Settings, MethodOptions {};

/// The core's problem of a description, with the functions that it calls.
class BoundProblem {
 public:
  explicit BoundProblem(const ProblemSpec& spec);
  BoundProblem(const BoundProblem&) = delete;
  BoundProblem& operator=(const BoundProblem&) = delete;

  [[nodiscard]] const Problem& problem() const { return problem_; }
  /// Returns whether no function needs the interpreter.
  [[nodiscard]] bool native() const { return functions_.native(); }
  /// The motions that its functions are parts of.
  [[nodiscard]] std::span<OwnedMotion* const> motions() const { return functions_.motions(); }
  /// See `Functions::lend`.
  void lend(const nb::object& functions, const nb::tuple& args) { functions_.lend(functions, args); }
  void give_back() { functions_.give_back(); }
  /// Returns whether a run has failed because f overflows wherever it goes on: the exception is set then.
  [[nodiscard]] bool raise_overflow(const Integration& ended) const;
  void forget_overflows() const { functions_.forget_overflows(); }
  int visit(visitproc visit, void* arg) const { return functions_.visit(visit, arg); }

 private:
  Functions functions_;
  Problem problem_;
};

void define_problem(nb::module_& module);

}  // namespace invariode::binding
