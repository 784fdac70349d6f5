#include "methods/registry.hpp"

#include <algorithm>

#include "methods/adams.hpp"
#include "methods/ndf.hpp"

namespace invariode {
namespace {

using Options = const MethodOptions&;
using Linear = const LinearAlgebra*;
using Made = std::unique_ptr<Step>;

constexpr const char* pair_family = "explicit Runge-Kutta pair";
constexpr const char* of_fsal_pairs[] = {"fsal"};
constexpr const char* of_adams[] = {"max_order"};
constexpr const char* of_ndf[] = {"max_order", "bdf", "jac", "jac_sparsity", "lband", "uband", "mass"};

int highest(Options options, int order) { return options.max_order > 0 ? options.max_order : order; }

constexpr Method rows[] = {
    {"ode23", pair_family, 3, 3, 3, 3, 0, 1, 1, "Bogacki and Shampine (1989)", of_fsal_pairs, false, nested,
     [](Callback& f, const Weights& w, Options o, Linear) -> Made { return ode23_step(f, w, o.fsal); }},
    {"ode45", pair_family, 5, 5, 4, 6, 0, 2, 4, "Dormand and Prince (1980)", of_fsal_pairs, false, nested,
     [](Callback& f, const Weights& w, Options o, Linear) -> Made { return ode45_step(f, w, o.fsal); }},
    {"dop853",
     pair_family,
     8,
     8,
     7,
     12,
     3,
     2,
     1,
     "Hairer, Norsett and Wanner (1993)",
     {},
     false,
     nested,
     [](Callback& f, const Weights& w, Options, Linear) -> Made { return dop853_step(f, w); }},
    {"ode78",
     pair_family,
     8,
     8,
     7,
     13,
     3,
     2,
     8,
     "Verner (2010)",
     {},
     false,
     nested,
     [](Callback& f, const Weights& w, Options, Linear) -> Made { return ode78_step(f, w); }},
    {"ode113", "Adams PECE, variable order", 1, 12, 12, 0, 0, 1, 1, "Shampine and Gordon (1975)", of_adams, false,
     integrate_polynomial,
     [](Callback& f, const Weights& w, Options o, Linear) -> Made {
       return std::make_unique<Adams>(f, w, highest(o, Adams::highest_order));
     }},
    {"ode15s", "NDF (or BDF), variable order", 1, 5, 5, 0, 0, 1, 1, "Shampine and Reichelt (1997)", of_ndf, true,
     newton_backward,
     [](Callback& f, const Weights& w, Options o, Linear linear) -> Made {
       const Ndf::Options options{.max_order = highest(o, Ndf::highest_order),
                                  .bdf = o.bdf,
                                  .renew_on_error = o.projected,
                                  .lapack = linear->lapack};
       return std::make_unique<Ndf>(f, w, linear->jacobian, linear->mass, options);
     }},
};

}  // namespace

std::span<const Method> methods() { return rows; }

const Method* find_method(std::string_view name) {
  const auto found = std::ranges::find(methods(), name, &Method::name);
  return found == methods().end() ? nullptr : &*found;
}

}  // namespace invariode
