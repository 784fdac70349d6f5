#include "methods/registry.hpp"

#include <algorithm>
#include <stdexcept>
#include <utility>

#include "methods/adams.hpp"
#include "methods/ndf.hpp"
#include "methods/nystrom.hpp"
#include "methods/radau.hpp"
#include "methods/rosenbrock.hpp"
#include "methods/switching.hpp"
#include "methods/taylor.hpp"
#include "methods/trapezoidal.hpp"
#include "methods/trbdf2.hpp"

namespace invariode {
namespace {

/// Parts of the interval in each of which auto sees f with its explicit member, which otherwise does at the ends of
/// steps only: about as many as LSODA does at 1e-6, for as many evaluations.
constexpr double parts_seen_by_member = 64;

template <std::size_t I>
std::unique_ptr<Step> make_pair(const Method&, Callback& f, const Weights& weights, const MethodOptions& given,
                                const LinearAlgebra&, SystemSeries*) {
  using namespace runge_kutta;
  return (weights.size() <= small_system ? steps_of_small_systems : steps_of_any_system)[I](f, weights, given.fsal);
}

template <std::size_t I>
std::unique_ptr<Step> make_nystrom(const Method&, Callback& f, const Weights& weights, const MethodOptions& given,
                                   const LinearAlgebra&, SystemSeries*) {
  return nystrom::steps[I](f, weights, given.fsal, given.state > 0 ? given.state : weights.size());
}

std::unique_ptr<Step> make_adams(const Method& method, Callback& f, const Weights& weights, const MethodOptions& given,
                                 const LinearAlgebra&, SystemSeries*) {
  return std::make_unique<Adams>(f, weights, given.max_order > 0 ? given.max_order : method.order,
                                 given.member ? parts_seen_by_member : 0);
}

std::unique_ptr<Step> make_ndf(const Method& method, Callback& f, const Weights& weights, const MethodOptions& given,
                               const LinearAlgebra& linear, SystemSeries*) {
  const Ndf::Options options{.max_order = given.max_order > 0 ? given.max_order : method.order,
                             .bdf = given.bdf,
                             .renew_on_error = given.projected};
  return std::make_unique<Ndf>(f, weights, linear, options);
}

std::unique_ptr<Step> make_radau(const Method& method, Callback& f, const Weights& weights, const MethodOptions& given,
                                 const LinearAlgebra& linear, SystemSeries*) {
  const int own = linear.krylov ? Radau::lowest_order : method.order;  // memory grows with the order
  return std::make_unique<Radau>(f, weights, linear, given.max_order > 0 ? given.max_order : own);
}

template <class Implicit>
std::unique_ptr<Step> make_implicit(const Method&, Callback& f, const Weights& weights, const MethodOptions&,
                                    const LinearAlgebra& linear, SystemSeries*) {
  return std::make_unique<Implicit>(f, weights, linear);
}

/// Returns the cost of one Jacobian, in evaluations of f.
double calls_per_jacobian(const Jacobian& jacobian) {
  switch (jacobian.kind()) {
    case Jacobian::Kind::constant:
    case Jacobian::Kind::products: return 0;
    case Jacobian::Kind::function:
    case Jacobian::Kind::derived: return 1;
    case Jacobian::Kind::differences:
    case Jacobian::Kind::complex_steps: break;
  }
  return static_cast<double>(jacobian.groups());
}

/// Makes both members; with a mass matrix only the implicit one, without linear algebra only the explicit one.
std::unique_ptr<Step> make_switching(const Method&, Callback& f, const Weights& weights, const MethodOptions& given,
                                     const LinearAlgebra& linear, SystemSeries* series) {
  const auto [explicit_one, implicit_one] = members(given);
  MethodOptions own = given;
  own.max_order = 0;  // each goes up to its own
  own.member = true;
  Switching::Members two;
  if (linear.mass == nullptr) two.explicit_one = explicit_one.step(f, weights, own, linear, series);
  if (linear.jacobian != nullptr) {
    two.implicit_one = implicit_one.step(f, weights, own, linear);
    two.jacobian_cost = calls_per_jacobian(*linear.jacobian);
    two.matrix_free = linear.krylov != nullptr;
    two.differences = two.matrix_free && !linear.krylov->product;
    two.state_f = linear.blocks != nullptr ? &linear.blocks->state() : nullptr;
  }
  return std::make_unique<Switching>(f, weights, std::move(two));
}

std::unique_ptr<Step> make_taylor(const Method&, Callback& f, const Weights& weights, const MethodOptions& given,
                                  const LinearAlgebra&, SystemSeries* series) {
  return std::make_unique<Taylor>(f, weights, *series, given.projected);
}

/// Makes the row of a pair from its tableau.
template <const auto& T>
constexpr Method of_pair(const char* family, decltype(Method::make) make) {
  Method method{.name = T.name,
                .summary = T.summary,
                .family = family,
                .source = T.source,
                .min_order = T.order,
                .order = T.order,
                .extension_order = T.extension_order,
                .stages = static_cast<int>(T.stages) - 1,
                .extra = static_cast<int>(T.all_stages - T.stages),
                .iterations = T.iterations,
                .make = make};
  if (T.last_in_error()) method.options[0] = "fsal";  // else f(t₁, y₁) is evaluated in any case
  return method;
}

/// The row of the pair T, number I of the pairs.
template <const auto& T, std::size_t I>
constexpr Method row() {
  Method method = of_pair<T>("explicit Runge-Kutta pair", make_pair<I>);
  method.scipy_name = T.scipy_name;
  method.refine = T.refine;
  method.delays = true;
  return method;
}

/// Makes the row of the pair T for second-order systems.
template <const auto& T, std::size_t I>
constexpr Method nystrom_row() {
  Method method = of_pair<T>("Runge-Kutta-Nystrom pair, for y'' = f(t, y)", make_nystrom<I>);
  method.equations = Equations::second_order;
  return method;
}

constexpr Method others[] = {
    {.name = "ode113",
     .summary = "Adams PECE formulas of order 1 to 12, for tight tolerances and costly f",
     .family = "Adams PECE, variable order",
     .source = "L. F. Shampine, M. K. Gordon, Computer Solution of Ordinary Differential Equations: The Initial Value "
               "Problem, Freeman, San Francisco, 1975, chapters 5 and 10",
     .min_order = 1,
     .order = Adams::highest_order,
     .extension_order = Adams::highest_order,
     .options = {"max_order"},
     .delays = true,
     .make = make_adams},
    {.name = "ode15s",
     .summary = "NDFs of order 1 to 5, for stiff problems and M y' = f",
     .family = "NDF (or BDF), variable order, for stiff problems and M y' = f",
     .source = "L. F. Shampine, M. W. Reichelt, The MATLAB ODE Suite, SIAM J. Sci. Comput. 18 (1997) 1-22, section 2",
     .scipy_name = "BDF",
     .scipy_bdf = true,
     .min_order = 1,
     .order = Ndf::highest_order,
     .extension_order = Ndf::highest_order,
     .options = {"max_order", "bdf", "jac", "jac_sparsity", "lband", "uband", "mass", "calibrate", "linear_solver"},
     .mass = MassMatrices::any,
     .delays = true,
     .make = make_ndf},
    {.name = "ode23s",
     .summary = "modified Rosenbrock formulas (2,3), for stiff problems at crude tolerances",
     .family = "Rosenbrock, for stiff problems and M y' = f",
     .source = "L. F. Shampine, M. W. Reichelt, The MATLAB ODE Suite, SIAM J. Sci. Comput. 18 (1997) 1-22, section 3",
     .min_order = Rosenbrock::formula_order,
     .order = Rosenbrock::formula_order,
     .extension_order = Rosenbrock::formula_order,
     .options = {"jac", "jac_sparsity", "lband", "uband", "mass"},
     .mass = MassMatrices::constant_regular,
     .make = make_implicit<Rosenbrock>},
    {.name = "ode23t",
     .summary = "trapezoidal rule, for moderately stiff problems at crude tolerances, without damping, and M y' = f",
     .family = "implicit Runge-Kutta, for stiff problems and M y' = f",
     .source = "L. F. Shampine, M. W. Reichelt, J. A. Kierzenka, Solving index-1 DAEs in MATLAB and Simulink, SIAM "
               "Rev. 41 (1999) 538-552",
     .min_order = Trapezoidal::formula_order,
     .order = Trapezoidal::formula_order,
     .extension_order = Trapezoidal::formula_order,
     .options = {"jac", "jac_sparsity", "lband", "uband", "mass", "linear_solver"},
     .mass = MassMatrices::any,
     .delays = true,
     .make = make_implicit<Trapezoidal>},
    {.name = "ode23tb",
     .summary = "TR-BDF2 of order 2, for stiff problems at crude tolerances and M y' = f",
     .family = "implicit Runge-Kutta, for stiff problems and M y' = f",
     .source =
         "M. E. Hosea, L. F. Shampine, Analysis and implementation of TR-BDF2, Appl. Numer. Math. 20 (1996) 21-37",
     .min_order = TrBdf2::formula_order,
     .order = TrBdf2::formula_order,
     .extension_order = TrBdf2::formula_order,
     .options = {"jac", "jac_sparsity", "lband", "uband", "mass", "linear_solver"},
     .mass = MassMatrices::any,
     .delays = true,
     .make = make_implicit<TrBdf2>},
    {.name = "radau",
     .summary = "Radau IIA formulas of order 5, 9 and 13, for stiff problems at tight tolerances and M y' = f",
     .family = "implicit Runge-Kutta, variable order, for stiff problems and M y' = f",
     .source = "E. Hairer, G. Wanner, Stiff differential equations solved by Radau methods, J. Comput. Appl. Math. 111 "
               "(1999) 93-111",
     .scipy_name = "Radau",
     .min_order = Radau::lowest_order,
     .order = Radau::highest_order,
     .extension_order = Radau::highest_extension_order,
     .options = {"max_order", "jac", "jac_sparsity", "lband", "uband", "mass", "linear_solver"},
     .mass = MassMatrices::any,
     .delays = true,
     .make = make_radau},
    {.name = "taylor",
     .summary = "Taylor series of any order, for tight tolerances and f that is an expression graph",
     .family = "Taylor series",
     .source = "A. Jorba, M. Zou, A software package for the numerical integration of ODEs by means of high-order "
               "Taylor methods, Exp. Math. 14 (2005) 99-117",
     .min_order = Taylor::lowest_order,
     .order = Taylor::highest_order,
     .extension_order = Taylor::highest_order,
     .options = {"max_order"},
     .equations = Equations::graph,
     .make = make_taylor},
    {.name = "auto",
     .summary = "ode113 and ode15s taking turns, for problems that may or may not be stiff",
     .family = "explicit and implicit methods that take turns",
     .source = "L. R. Petzold, Automatic selection of methods for solving stiff and nonstiff systems of ordinary "
               "differential equations, SIAM J. Sci. Stat. Comput. 4 (1983) 136-148",
     .scipy_name = "LSODA",
     .min_order = 1,
     .order = Adams::highest_order,
     .extension_order = Adams::highest_order,
     .options = {"jac", "jac_sparsity", "lband", "uband", "mass", "prefer", "linear_solver"},
     .mass = MassMatrices::any,
     .delays = true,
     .make = make_switching},
};

template <const auto&... T, const auto&... N>
constexpr auto all(runge_kutta::Tableaux<T...>, runge_kutta::Tableaux<N...>) {
  return [&]<std::size_t... I, std::size_t... J, std::size_t... K>(std::index_sequence<I...>, std::index_sequence<J...>,
                                                                   std::index_sequence<K...>) {
    return std::array{row<T, I>()..., others[J]..., nystrom_row<N, K>()...};
  }(std::index_sequence_for<decltype(T)...>{}, std::make_index_sequence<std::size(others)>{},
         std::index_sequence_for<decltype(N)...>{});
}
constexpr auto table = all(runge_kutta::Pairs(), nystrom::Pairs());

/// The row of that name, which is there.
const Method& row_of(std::string_view name) { return *std::ranges::find(table, name, &Method::name); }

}  // namespace

bool Method::takes(std::string_view option) const {
  return std::ranges::any_of(options, [&](const char* one) { return one != nullptr && option == one; });
}

Members members(const MethodOptions& given) {
  return {given.prefer_explicit ? *given.prefer_explicit : row_of("ode113"),
          given.prefer_implicit ? *given.prefer_implicit : row_of("ode15s")};
}

std::span<const Method> methods() { return table; }

const Method* find_method(std::string_view name) {
  const auto found = std::ranges::find(table, name, &Method::name);
  return found == table.end() ? nullptr : &*found;
}

}  // namespace invariode
