#pragma once
// A solver with the functions that it calls, as its runs and ensembles share it.

#include <nanobind/nanobind.h>

#include <atomic>
#include <stdexcept>
#include <string>

#include "arguments.hpp"
#include "interpreter.hpp"
#include "methods/registry.hpp"
#include "problem.hpp"
#include "run/problem.hpp"

namespace nb = nanobind;

namespace invariode::binding {

inline const Method& method_of(const std::string& name) {
  if (const Method* method = find_method(name)) return *method;
  throw std::invalid_argument("unknown method '" + name + "'");
}

/// A solver with the functions that it calls. Made with the interpreter held; where all functions are native, its runs
/// do not need it.
struct BoundSolver {
  BoundSolver(const std::string& method, nb::handle problem, nb::handle tolerances, nb::handle course,
              nb::handle settings)
      : BoundSolver(method, problem, tolerances, read_settings(course, Record(settings))) {}
  BoundSolver(const std::string& method, nb::handle problem, nb::handle tolerances, const RunSettings& settings)
      : bound(Record(problem)),
        solver(method_of(method), bound.problem(), read_weights(Record(tolerances), bound.problem().n), settings,
               settings) {}
  int visit(visitproc visit, void* arg) const {
    const int stop = visit_all(visit, arg, course);
    return stop == 0 ? bound.visit(visit, arg) : stop;
  }

  BoundProblem bound;
  Solver solver;
  nb::object course;  // that the settings of the solver are on; null: the one that it was made for
};

/// A wish to end a run, which another thread or a handler of signals makes while it goes on.
struct StopRequest {
  std::atomic<bool> made{false};
};

/// Calls Python, with the interpreter held. Returns false if that raised: the exception is set.
template <class Act>
bool without_error(Act act) {
  try {
    in_python(act);
  } catch (nb::python_error& error) {
    error.restore();
    return false;
  }
  return true;
}

}  // namespace invariode::binding
