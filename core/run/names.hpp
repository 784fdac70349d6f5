#pragma once
// The names under which states, causes and choices are known outside of the core: one table each.

#include <cstddef>
#include <iterator>
#include <optional>
#include <string_view>

#include "linear/jacobian.hpp"
#include "linear/mass.hpp"
#include "linear/matrix.hpp"
#include "manifold/guard.hpp"
#include "manifold/invariants.hpp"
#include "methods/registry.hpp"
#include "output/interpolant.hpp"
#include "report.hpp"
#include "step.hpp"

namespace invariode {

template <class Value>
struct Named {
  const char* name;
  Value value;
};

inline constexpr Named<State> state_names[] = {{"created", State::created},
                                               {"running", State::running},
                                               {"reached_end", State::reached_end},
                                               {"terminal_event", State::terminal_event},
                                               {"stopped_by_callback", State::stopped_by_callback},
                                               {"stopped_by_request", State::stopped_by_request},
                                               {"restart_inconsistent", State::restart_inconsistent},
                                               {"limit_reached", State::limit_reached},
                                               {"interrupted", State::interrupted},
                                               {"event_undefined", State::event_undefined},
                                               {"action_undefined", State::action_undefined},
                                               {"start_undefined", State::start_undefined},
                                               {"step_failed", State::step_failed},
                                               {"invariant_refused", State::invariant_refused},
                                               {"invariant_convicted", State::invariant_convicted},
                                               {"start_out_of_bounds", State::start_out_of_bounds},
                                               {"start_contradicts", State::start_contradicts},
                                               {"action_out_of_bounds", State::action_out_of_bounds},
                                               {"events_endless", State::events_endless},
                                               {"marks_endless", State::marks_endless}};

inline constexpr Named<Cause> cause_names[] = {{"error", Cause::error},           {"newton", Cause::newton},
                                               {"projection", Cause::projection}, {"not_finite", Cause::not_finite},
                                               {"bounds", Cause::bounds},         {"spacing", Cause::spacing},
                                               {"overlap", Cause::overlap}};

inline constexpr Named<Unsolved> unsolved_names[] = {{"none", Unsolved::none},
                                                     {"slow", Unsolved::slow},
                                                     {"product", Unsolved::product},
                                                     {"difference", Unsolved::difference},
                                                     {"preconditioner", Unsolved::preconditioner},
                                                     {"preconditioner_zero", Unsolved::preconditioner_zero}};

inline constexpr Named<Limit> limit_names[] = {{"steps", Limit::steps},
                                               {"time", Limit::time},
                                               {"points", Limit::points},
                                               {"memory", Limit::memory},
                                               {"sticking", Limit::sticking}};

inline constexpr Named<Finding::Kind> finding_names[] = {{"none", Finding::Kind::none},
                                                         {"stop", Finding::Kind::stop},
                                                         {"undefined", Finding::Kind::undefined},
                                                         {"off_value", Finding::Kind::off_value},
                                                         {"jumps_off", Finding::Kind::jumps_off},
                                                         {"wrong_jacobian", Finding::Kind::wrong_jacobian},
                                                         {"not_conserved", Finding::Kind::not_conserved},
                                                         {"held", Finding::Kind::held}};

inline constexpr Named<Consistency> consistency_names[] = {{"consistent", Consistency::consistent},
                                                           {"corrected", Consistency::corrected},
                                                           {"not_found", Consistency::not_found},
                                                           {"undetermined", Consistency::undetermined},
                                                           {"index_too_high", Consistency::index_too_high},
                                                           {"undefined", Consistency::undefined},
                                                           {"stop", Consistency::stop}};

inline constexpr Named<Derivative> derivative_names[] = {{"given", Derivative::given},
                                                         {"complex step", Derivative::complex_step},
                                                         {"central differences", Derivative::central},
                                                         {"forward differences", Derivative::forward}};

inline constexpr Named<Structure::Kind> structure_names[] = {
    {"dense", Structure::Kind::dense}, {"banded", Structure::Kind::banded}, {"sparse", Structure::Kind::sparse}};

inline constexpr Named<Jacobian::Kind> jacobian_names[] = {{"constant", Jacobian::Kind::constant},
                                                           {"function", Jacobian::Kind::function},
                                                           {"derived", Jacobian::Kind::derived},
                                                           {"differences", Jacobian::Kind::differences},
                                                           {"complex-step", Jacobian::Kind::complex_steps},
                                                           {"products", Jacobian::Kind::products}};

inline constexpr Named<Fsal> fsal_names[] = {{"reuse", Fsal::reuse}, {"evaluate", Fsal::evaluate}};

inline constexpr Named<MassMatrices> mass_names[] = {
    {"none", MassMatrices::none}, {"regular", MassMatrices::constant_regular}, {"any", MassMatrices::any}};

inline constexpr Named<Equations> equation_names[] = {
    {"any", Equations::any}, {"graph", Equations::graph}, {"second-order", Equations::second_order}};

inline constexpr Named<Interpolation> interpolation_names[] = {
    {"projected", Interpolation::projected}, {"corrected", Interpolation::corrected}, {"raw", Interpolation::raw}};

template <class Value, std::size_t count>
constexpr const char* name_in(const Named<Value> (&table)[count], Value value) {
  for (const auto& [name, one] : table)
    if (one == value) return name;
  return "";
}

/// The value of that name; nothing if the table does not have it.
template <class Value, std::size_t count>
constexpr std::optional<Value> find_in(const Named<Value> (&table)[count], std::string_view name) {
  for (const auto& [key, value] : table)
    if (key == name) return value;
  return {};
}

/// A table that names every value up to its last one, in their order, can be read by index too.
template <class Value, std::size_t count>
constexpr bool in_order(const Named<Value> (&table)[count]) {
  for (std::size_t i = 0; i < count; ++i)
    if (static_cast<std::size_t>(table[i].value) != i) return false;
  return true;
}
static_assert(in_order(state_names) && in_order(cause_names) && in_order(limit_names) && in_order(finding_names) &&
              in_order(consistency_names) && in_order(derivative_names) && in_order(unsolved_names));

constexpr const char* name_of(State state) { return name_in(state_names, state); }
constexpr const char* name_of(Cause cause) { return name_in(cause_names, cause); }
constexpr const char* name_of(Unsolved why) { return name_in(unsolved_names, why); }
constexpr const char* name_of(Limit limit) { return name_in(limit_names, limit); }
constexpr const char* name_of(Finding::Kind kind) { return name_in(finding_names, kind); }
constexpr const char* name_of(Consistency verdict) { return name_in(consistency_names, verdict); }
constexpr const char* name_of(Derivative derivative) { return name_in(derivative_names, derivative); }
constexpr const char* name_of(Fsal fsal) { return name_in(fsal_names, fsal); }
constexpr const char* name_of(MassMatrices kind) { return name_in(mass_names, kind); }
constexpr const char* name_of(Equations equations) { return name_in(equation_names, equations); }
constexpr const char* name_of(Interpolation mode) { return name_in(interpolation_names, mode); }

}  // namespace invariode
