#include "methods/registry.hpp"

#include <algorithm>
#include <utility>

#include "methods/adams.hpp"
#include "methods/ndf.hpp"
#include "methods/radau.hpp"
#include "methods/rosenbrock.hpp"

namespace invariode {
namespace {

bool rows_of_n(std::size_t size, std::size_t n) { return size > 0 && size % n == 0; }
bool rows_and_steps(std::size_t size, std::size_t n) {
  return size > n && (size - n) % (n + 1) == 0 && (size - n) / (n + 1) <= Adams::highest_order + 1;
}
constexpr Extension runge_kutta_polynomial{"Runge-Kutta", runge_kutta::nested_polynomial, rows_of_n};
constexpr Extension adams_polynomial{"Adams", integrate_polynomial, rows_and_steps};
constexpr Extension backward_differences{"NDF", newton_backward, rows_of_n};

template <std::size_t I>
std::unique_ptr<Step> make_pair(const Method&, Callback& f, const Weights& weights, const MethodOptions& told,
                                const LinearAlgebra&) {
  using namespace runge_kutta;
  return (weights.size() <= few ? pairs_for_few : pairs_for_many)[I](f, weights, told.fsal);
}

std::unique_ptr<Step> make_adams(const Method& method, Callback& f, const Weights& weights, const MethodOptions& told,
                                 const LinearAlgebra&) {
  return std::make_unique<Adams>(f, weights, told.max_order > 0 ? told.max_order : method.order);
}

std::unique_ptr<Step> make_ndf(const Method& method, Callback& f, const Weights& weights, const MethodOptions& told,
                               const LinearAlgebra& linear) {
  const Ndf::Options options{.max_order = told.max_order > 0 ? told.max_order : method.order,
                             .bdf = told.bdf,
                             .renew_on_error = told.projected};
  return std::make_unique<Ndf>(f, weights, linear, options);
}

template <class Implicit>
std::unique_ptr<Step> make_implicit(const Method&, Callback& f, const Weights& weights, const MethodOptions&,
                                    const LinearAlgebra& linear) {
  return std::make_unique<Implicit>(f, weights, linear);
}

/// The row of the pair T, number I of the pairs.
template <const auto& T, std::size_t I>
constexpr Method row() {
  Method method{.name = T.name,
                .summary = T.summary,
                .family = "explicit Runge-Kutta pair",
                .source = T.source,
                .scipy_name = T.scipy_name,
                .min_order = T.order,
                .order = T.order,
                .extension_order = T.extension_order,
                .stages = static_cast<int>(T.stages) - 1,
                .extra = static_cast<int>(T.all_stages - T.stages),
                .iterations = T.iterations,
                .refine = T.refine,
                .extension = &runge_kutta_polynomial,
                .make = make_pair<I>};
  if (T.last_in_error()) method.options[0] = "fsal";  // else f(t₁, y₁) is evaluated in any case
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
     .extension = &adams_polynomial,
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
     .options = {"max_order", "bdf", "jac", "jac_sparsity", "lband", "uband", "mass", "calibrate"},
     .mass = MassMatrices::any,
     .extension = &backward_differences,
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
     .extension = &runge_kutta_polynomial,
     .make = make_implicit<Rosenbrock>},
    {.name = "radau",
     .summary = "Radau IIA formula of order 5, for stiff problems at tight tolerances and M y' = f",
     .family = "implicit Runge-Kutta, for stiff problems and M y' = f",
     .source = "E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 2nd ed., Springer, Berlin, 1996, "
               "section IV.8",
     .scipy_name = "Radau",
     .min_order = Radau::formula_order,
     .order = Radau::formula_order,
     .extension_order = Radau::extension_order,
     .options = {"jac", "jac_sparsity", "lband", "uband", "mass"},
     .mass = MassMatrices::any,
     .extension = &runge_kutta_polynomial,
     .make = make_implicit<Radau>},
};

template <const auto&... T>
constexpr auto all(runge_kutta::Tableaux<T...>) {
  return [&]<std::size_t... I, std::size_t... J>(std::index_sequence<I...>, std::index_sequence<J...>) {
    return std::array{row<T, I>()..., others[J]...};
  }(std::index_sequence_for<decltype(T)...>{}, std::make_index_sequence<std::size(others)>{});
}
constexpr auto table = all(runge_kutta::Pairs());

}  // namespace

bool Method::takes(std::string_view option) const {
  return std::ranges::any_of(options, [&](const char* one) { return one != nullptr && option == one; });
}

std::span<const Method> methods() { return table; }

const Method* find_method(std::string_view name) {
  const auto found = std::ranges::find(table, name, &Method::name);
  return found == table.end() ? nullptr : &*found;
}

const Extension* find_extension(std::string_view name) {
  const auto found = std::ranges::find_if(table, [&](const Method& one) { return one.extension->name == name; });
  return found == table.end() ? nullptr : found->extension;
}

const Extension* find_extension(Interpolate evaluate) {
  const auto found =
      std::ranges::find_if(table, [&](const Method& one) { return one.extension->evaluate == evaluate; });
  return found == table.end() ? nullptr : found->extension;
}

}  // namespace invariode
