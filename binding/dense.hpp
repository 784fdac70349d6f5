#pragma once
// The continuous solution: evaluated, joined, taken apart for files and put together again.

#include <nanobind/nanobind.h>

#include <span>
#include <vector>

#include "arrays.hpp"
#include "output/output.hpp"
#include "problem.hpp"
#include "weights.hpp"

namespace invariode::binding {

/// The continuous solution, with the tolerances that its projections use.
struct Dense {
  DenseOutput output;
  Weights weights;
  bool complex;

  /// y at each t, one state after the other. Where the mode projects, onto the invariants of `problem`; without it
  /// values are corrected only.
  [[nodiscard]] std::vector<double> at(std::span<const double> t, nb::handle problem) const;
  /// The same as an array, (len(t), n).
  [[nodiscard]] Table evaluate(const ConstVector& t, nb::handle problem) const;
  /// Returns this solution followed by `next`, which starts where this ends.
  [[nodiscard]] Dense joined(const Dense& next) const;
  /// Everything, as the arguments of `from_parts`.
  [[nodiscard]] nb::dict parts() const;
};

void define_dense(nb::module_& module);

}  // namespace invariode::binding
