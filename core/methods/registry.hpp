#pragma once
// The registry of methods: the one list over which the run, the binding and the tests iterate.

#include <memory>
#include <span>
#include <string_view>

#include "linear/jacobian.hpp"
#include "linear/mass.hpp"
#include "linear/matrix.hpp"
#include "methods/runge_kutta.hpp"
#include "step.hpp"

namespace invariode {

/// What a method can be told. Each takes what concerns it.
struct MethodOptions {
  Fsal fsal = Fsal::reuse;
  int max_order = 0;  ///< 0: the highest
  bool bdf = false;
  bool projected = false;  ///< invariants are imposed on its steps
};

/// What an implicit method needs beyond f. `mass` and `lapack` may be null: the identity, Eigen.
struct LinearAlgebra {
  Jacobian jacobian;
  Mass* mass = nullptr;
  const Lapack* lapack = nullptr;
};

/// A named method: data, citation, and how its step is made.
struct Method {
  const char* name;
  const char* family;
  int min_order;
  int order;
  int extension_order;
  int stages;      ///< evaluations of f per step; 0: they are not a fixed number
  int extra;       ///< evaluations of f for the first look into a step
  int iterations;  ///< of the projection in a step
  int refine;      ///< points per step of the suite's function of this name
  const char* source;
  std::span<const char* const> options;  ///< names of the options that not every method takes, and this one does
  bool implicit;                         ///< needs LinearAlgebra
  Interpolate interpolate;
  std::unique_ptr<Step> (*make)(Callback& f, const Weights& weights, const MethodOptions& options,
                                const LinearAlgebra* linear);
};

std::span<const Method> methods();
/// Null: there is none of that name.
const Method* find_method(std::string_view name);

}  // namespace invariode
