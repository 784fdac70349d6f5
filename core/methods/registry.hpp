#pragma once
// The methods: the one list of them. The binding hands it to Python, and the tests iterate over it.

#include <array>
#include <cstddef>
#include <memory>
#include <span>
#include <string_view>

#include "linear/mass.hpp"
#include "methods/runge_kutta.hpp"
#include "series.hpp"
#include "step.hpp"

namespace invariode {

using runge_kutta::Fsal;

struct Method;

/// The options of a method; one that cannot use an entry ignores it.
struct MethodOptions {
  Fsal fsal = Fsal::reuse;
  int max_order = 0;                        ///< highest order of the formulas; 0: the method's own
  bool bdf = false;                         ///< backward differentiation formulas instead of NDFs
  bool member = false;                      ///< of a method that takes turns
  bool projected = false;                   ///< the steps are projected, which Newton's iteration does not see
  std::size_t state = 0;                    ///< doubles of a state, of which sensitivities are several; 0: there is one
  const Method* prefer_explicit = nullptr;  ///< of those that take turns; null: see `members`
  const Method* prefer_implicit = nullptr;
};

/// The mass matrices M of M y' = f(t, y) that a method takes.
enum class MassMatrices { none, constant_regular, any };

/// The functions f that a method takes: any function of (t, y); one whose expression graph is known; f of y'' = f(t,
/// y).
enum class Equations { any, graph, second_order };

/// A method as data: what it is called, what it can do, where it comes from, how a step of it is made. (`series`: for
/// those that take graphs; null for the others.)
struct Method {
  static constexpr std::size_t most_options = 12;

  const char* name;
  const char* summary;  ///< what it is and what it is for, in a few words
  const char* family;
  const char* source;
  const char* scipy_name = nullptr;  ///< of the corresponding method of `scipy.integrate.solve_ivp`
  bool scipy_bdf = false;            ///< that name implies the option `bdf`
  int min_order;
  int order;            ///< the highest
  int extension_order;  ///< of the formula of highest order
  int stages = 0;       ///< calls of f in a step of a Runge-Kutta pair; 0: not a fixed number
  int extra = 0;        ///< calls of f that output or events inside a step take
  int iterations = 1;   ///< of the projection in a step (paper, section 4)
  int refine = 1;       ///< points per step that the function of this name returns
  std::array<const char*, most_options> options{};  ///< those that not every method takes, and this one does
  MassMatrices mass = MassMatrices::none;
  Equations equations = Equations::any;
  bool delays = false;  ///< f may take values of the solution at earlier times
  std::unique_ptr<Step> (*make)(const Method& method, Callback& f, const Weights& weights, const MethodOptions& options,
                                const LinearAlgebra& linear, SystemSeries* series);

  [[nodiscard]] std::unique_ptr<Step> step(Callback& f, const Weights& weights, const MethodOptions& given = {},
                                           const LinearAlgebra& linear = {}, SystemSeries* series = nullptr) const {
    return make(*this, f, weights, given, linear, series);
  }
  [[nodiscard]] bool takes(std::string_view option) const;
  [[nodiscard]] bool implicit() const { return takes("jac"); }
  /// Made of an explicit and an implicit one.
  [[nodiscard]] bool switches() const { return takes("prefer"); }
};

/// The members of a method that switches between two.
struct Members {
  const Method& explicit_one;
  const Method& implicit_one;
};
/// Returns the preferred members, else ode113 and ode15s, which evaluate f least often (benchmarks/auto.py).
[[nodiscard]] Members members(const MethodOptions& given);

[[nodiscard]] std::span<const Method> methods();
/// Returns the method with a name, or null.
[[nodiscard]] const Method* find_method(std::string_view name);

}  // namespace invariode
