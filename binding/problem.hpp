#pragma once
// Problems, tolerances and settings, read from the records of Python, and the core's problem made of them.

#include <nanobind/nanobind.h>

#include <cstddef>
#include <span>
#include <vector>

#include "callables.hpp"
#include "integrate.hpp"
#include "methods/registry.hpp"
#include "run/problem.hpp"
#include "weights.hpp"

namespace invariode::binding {

/// The weights of a state of n reals, from rtol, thr of all reals or of each, and the scales of a vector rtol or None.
Weights read_weights(const Record& tolerances, std::size_t n);

/// Throws std::invalid_argument where rtol and scales are not positive, thresholds not 0 or positive.
Weights to_weights(double rtol, std::vector<double> threshold, std::vector<double> scale);

/// All that a run can be told, for the loop and for the method.
struct RunSettings : Settings, MethodOptions {};

/// Reads a `Course`, a tuple: the settings that depend on the problem.
void read_course(nb::handle course, Settings& settings);
/// Reads a `Course` and `Settings`.
RunSettings read_settings(nb::handle course, const Record& settings);

/// The core's problem of a `CoreProblem`, with the functions that it calls.
class BoundProblem {
 public:
  explicit BoundProblem(const Record& spec);
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

}  // namespace invariode::binding
