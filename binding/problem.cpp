#include "problem.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/variant.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <stdexcept>
#include <tuple>
#include <utility>

#include "mechanics.hpp"
#include "run/names.hpp"

namespace invariode::binding {
namespace {

using Objects = std::vector<nb::object>;
using OptionalVector = std::optional<ConstVector>;

std::vector<double> to_vector(const OptionalVector& a) { return a ? binding::to_vector(*a) : std::vector<double>{}; }

template <class Value, std::size_t count>
Value choose(const Named<Value> (&table)[count], const std::string& name, const char* what) {
  if (const std::optional<Value> found = find_in(table, name)) return *found;
  throw std::invalid_argument(std::string("unknown ") + what + " '" + name + "'");
}

/// The name of: complex steps, until g does not take one, then central differences.
constexpr const char* choose_derivative = "complex-step or 3-point";
/// The names that may stand in place of a Jacobian of g.
constexpr Named<Derivative> substitutes[] = {{choose_derivative, Derivative::complex_step},
                                             {"complex-step", Derivative::complex_step},
                                             {"3-point", Derivative::central},
                                             {"2-point", Derivative::forward}};

Metric make_metric(const InvariantSpec& spec, Functions& functions) {
  if (spec.metric.is_none()) return {};
  const bool function = nb::isinstance<Native>(spec.metric) || nb::isinstance<MotionPart>(spec.metric) ||
                        PyCallable_Check(spec.metric.ptr()) != 0;
  if (!function) return {.function = {}, .values = to_vector(nb::cast<ConstVector>(spec.metric))};
  const std::string name = "the metric of invariant " + spec.name;
  const std::size_t k = spec.moves.empty() ? functions.state_size() : spec.moves.size();
  const bool diagonal = spec.metric_size == k;
  return {.function = diagonal ? functions.vector(spec.metric, name, k) : functions.square(spec.metric, name, k),
          .values = std::vector<double>(spec.metric_size)};
}

InvariantBlock make_block(const InvariantSpec& spec, Functions& functions) {
  const std::string name = "invariant " + spec.name;
  InvariantBlock block;
  block.g = functions.vector(spec.fun, name, spec.m);
  block.m = spec.m;
  block.held = spec.held;
  block.level = spec.level;
  block.moves = spec.moves;
  block.metric = make_metric(spec, functions);
  block.sense = spec.sense;
  block.along_steps = spec.along_steps;
  block.users = spec.users;
  if (nb::isinstance<MotionPart>(spec.jac)) {
    const auto& [mechanics, part] = nb::cast<const MotionPart&>(spec.jac);
    if (Motion& motion = functions.motion(mechanics); motion.sparse()) {
      block.jacobian = motion.entries(part);
      block.pattern = motion.pattern(part);
      return block;
    }
  }
  if (!nb::isinstance<nb::str>(spec.jac)) {
    const auto& [starts, columns] = spec.pattern;
    require(starts.empty() || (starts.size() == spec.m + 1 && starts.front() == 0 && starts.back() == columns.size() &&
                               std::ranges::is_sorted(starts)),
            "the pattern of an invariant's Jacobian is not one of its rows");
    if (spec.pattern)
      block.jacobian = functions.vector(spec.jac, "the Jacobian of " + name, spec.pattern.columns.size());
    else
      block.jacobian = functions.rows(spec.jac, "the Jacobian of " + name, spec.m);
    block.pattern = spec.pattern;
    return block;
  }
  const auto substitute = nb::cast<std::string>(spec.jac);
  block.derivative = choose(substitutes, substitute, "kind of derivative");
  if (block.derivative != Derivative::complex_step) return block;
  nb::object at_complex = spec.fun;
  if (substitute == choose_derivative || nb::isinstance<Native>(spec.fun))
    at_complex = nb::module_::import_("invariode._functions.increments").attr("at_complex")(spec.fun, spec.m);
  block.complex_g = functions.complex_vector(at_complex, name, spec.m);
  return block;
}

EventFunction make_event(const EventSpec& spec, Functions& functions) {
  EventFunction event;
  const std::string title = spec.name == "event" ? spec.name : "event " + spec.name;
  if (!spec.fun.is_none()) event.function = functions.event(spec.fun, title);
  event.terminal = spec.terminal;
  event.direction = spec.direction;
  if (!spec.action.is_none()) event.action = functions.state_valued(spec.action, "the action of " + title);
  event.rehold = spec.rehold;
  event.samples = spec.samples;
  if (spec.series) event.series = functions.series(*spec.series);
  event.touching = spec.touching;
  event.at_jumps = spec.at_jumps;
  return event;
}

/// Its components are the events from `first` on, which have no function of their own.
RootVector make_vector(const VectorSpec& spec, std::size_t number, Functions& functions,
                       std::vector<EventFunction>& events) {
  if (spec.first + spec.count > events.size()) throw std::invalid_argument("a vector has more events than there are");
  for (std::size_t k = 0; k < spec.count; ++k) events[spec.first + k].vector = number;
  return {functions.events(spec.fun, "fun of " + spec.name, spec.count), spec.first, spec.count,
          functions.action_of_vector(spec.action, "on_roots of " + spec.name, spec.count)};
}

Breakpoint make_breakpoint(const BreakpointSpec& spec, Functions& functions) {
  if (spec.action.is_none()) return {.t = spec.t, .action = {}, .jump = {}};
  return {.t = spec.t, .action = functions.state_valued(spec.action, "the action at a breakpoint"), .jump = {}};
}

Lapack read_lapack(const nb::object& capsules) {
  Lapack lapack;
  const auto take = [&](const char* name, auto*& routine) {
    const nb::object capsule(capsules[name]);
    void* pointer = PyCapsule_GetPointer(capsule.ptr(), PyCapsule_GetName(capsule.ptr()));
    if (pointer == nullptr) throw nb::python_error();
    routine = reinterpret_cast<std::remove_reference_t<decltype(routine)>>(pointer);
  };
  take("dgetrf", lapack.real.factor);
  take("dgetrs", lapack.real.solve);
  take("dgbtrf", lapack.real.factor_band);
  take("dgbtrs", lapack.real.solve_band);
  take("zgetrf", lapack.complex.factor);
  take("zgetrs", lapack.complex.solve);
  take("zgbtrf", lapack.complex.factor_band);
  take("zgbtrs", lapack.complex.solve_band);
  return lapack;
}

LinearTerms make_linear(const LinearSpec& spec, Functions& functions) {
  LinearTerms linear{.source = {.kind = spec.kind,
                                .function = {},
                                .complex_f = {},
                                .rate = {},
                                .product = {},
                                .found_pattern = spec.found_pattern > 0},
                     .jacobian = Matrix::without_values(spec.structure),
                     .mass = {},
                     .lapack = {},
                     .krylov = {}};
  nb::object known = spec.jacobian;  // values or pattern
  const bool is_function = spec.kind == Jacobian::Kind::function || spec.kind == Jacobian::Kind::derived;
  if (is_function || spec.kind == Jacobian::Kind::complex_steps) {
    nb::object code = std::exchange(known, nb::none());
    if (nb::isinstance<nb::tuple>(code)) std::tie(code, known) = nb::cast<std::pair<nb::object, nb::object>>(code);
    if (is_function && code.is_none())
      linear.source.product = functions.product(spec.product, "∂f/∂y v");
    else if (is_function)
      linear.source.function = functions.matrix(code);
    else
      linear.source.complex_f = functions.complex_vector(code, "fun(t, y)", spec.structure.n);
  }
  if (!known.is_none()) read_matrix(known, linear.jacobian);
  if (!spec.rate.is_none()) linear.source.rate = functions.vector(spec.rate, "∂f/∂t", spec.structure.n);
  if (!spec.lapack.is_none() && by_lapack(spec.structure)) linear.lapack = read_lapack(spec.lapack());
  if (spec.kind == Jacobian::Kind::products) {
    KrylovTerms& krylov = linear.krylov.emplace();
    if (!spec.product.is_none()) krylov.product = functions.product(spec.product, "jac_product(t, y, v)");
    if (!spec.preconditioner.is_none()) krylov.preconditioner = functions.preconditioner(spec.preconditioner);
    krylov.dimension = spec.dimension;
  }
  if (spec.mass.is_none()) return linear;
  Matrix mass(spec.structure);
  MatrixFunction function;
  if (PyCallable_Check(spec.mass.ptr()) != 0)
    function = functions.matrix(spec.mass);
  else
    read_matrix(spec.mass, mass);
  linear.mass.emplace(std::move(mass), function, read_sparse(spec.null_basis, spec.structure.n));
  return linear;
}

/// Into the problem, whose invariants, events and breakpoints are there.
void add_variations(const VariationsSpec& spec, Functions& functions, Problem& problem) {
  const auto require_one_each = [](std::size_t given, std::size_t count, const char* what) {
    if (given == count || given == 0) return;
    throw std::invalid_argument("sensitivities have " + std::to_string(given) + " functions for " +
                                std::to_string(count) + " " + what);
  };
  require_one_each(spec.invariants.size(), problem.invariants.size(), "invariants");
  require_one_each(spec.jumps.size(), problem.events.size(), "events");
  require_one_each(spec.breakpoints.size(), problem.breakpoints.size(), "breakpoints");
  Variations& variations = problem.variations.emplace();
  variations.k = spec.k;
  variations.slope = functions.of_sensitivities(spec.slope, "the slope of the sensitivities", spec.k,
                                                problem.delays ? problem.delays->lags.size() : 0);
  variations.tolerance.assign(spec.thresholds.data(), spec.thresholds.data() + spec.thresholds.size());
  variations.error_test = spec.error_test;
  variations.quadratures = spec.quadratures;
  for (std::size_t i = 0; i < spec.invariants.size(); ++i) {
    InvariantBlock& block = problem.invariants[i];
    block.tangent = functions.tangent(spec.invariants[i], "the tangent of an invariant", spec.k, block.m);
  }
  const auto jump = [&](const nb::object& one) {
    return one.is_none() ? Callback() : functions.jump(one, "the jump of the sensitivities", spec.k);
  };
  for (std::size_t i = 0; i < spec.jumps.size(); ++i) problem.events[i].jump = jump(spec.jumps[i]);
  for (std::size_t i = 0; i < spec.breakpoints.size(); ++i) problem.breakpoints[i].jump = jump(spec.breakpoints[i]);
  problem.landings.jump = jump(spec.landings);
}

Landings make_landings(const LandingsSpec& spec) {
  const auto& [times, first, periods] = spec;
  require(first.size() == periods.size(), "landings have not one period for each first time");
  std::vector<Landings::Progression> progressions;
  progressions.reserve(first.size());
  for (std::size_t i = 0; i < first.size(); ++i) progressions.push_back({.first = first[i], .period = periods[i]});
  return {times, std::move(progressions)};
}

DelayTerms make_delays(const DelaysSpec& spec, Functions& functions) {
  require(spec.parameters.size() == spec.lags.size(), "delays have not one number of a parameter each");
  DelayTerms terms{.lags = {}, .constant = spec.constant, .history = {}, .jumps = spec.jumps, .rates = spec.rates};
  for (std::size_t j = 0; j < spec.lags.size(); ++j) {
    const std::int64_t number = spec.parameters[j];
    terms.lags.push_back({spec.lags[j], number < 0 ? std::nullopt : std::optional(static_cast<std::size_t>(number))});
  }
  if (!spec.history.is_none()) terms.history = functions.state_valued(spec.history, "history(t)");
  return terms;
}

}  // namespace

Weights to_weights(double rtol, std::vector<double> threshold, std::vector<double> scale) {
  const bool valid = rtol > 0 && std::ranges::all_of(threshold, [](double thr) { return thr >= 0; }) &&
                     std::ranges::all_of(scale, [](double one) { return one > 0; });
  require(valid, "tolerances are not positive");
  return {rtol, std::move(threshold), std::move(scale)};
}

Weights Tolerances::for_size(std::size_t n) const {
  const auto* each = std::get_if<ConstVector>(&threshold);
  return to_weights(rtol, each ? binding::to_vector(*each) : std::vector<double>(n, std::get<double>(threshold)),
                    to_vector(scale));
}

BoundProblem::BoundProblem(const ProblemSpec& spec)
    : functions_({spec.n, spec.complex}, spec.args, binding::to_vector(spec.parameters)) {
  problem_.n = spec.n;
  problem_.complex = spec.complex;
  const std::size_t delays = spec.delays ? spec.delays->lags.size() : 0;
  if (!spec.fun.is_none()) problem_.f = functions_.slope(spec.fun, delays > 0 ? "fun(t, y, z)" : "fun(t, y)", delays);
  if (spec.delays) problem_.delays = make_delays(*spec.delays, functions_);
  if (spec.series) problem_.series.emplace().solution = functions_.series(*spec.series);
  if (spec.series && spec.conditions) {
    problem_.series->conditions = functions_.series(*spec.conditions);
    problem_.series->count = spec.condition_count;
  }
  if (nb::isinstance<MotionPart>(spec.fun))
    problem_.f_error = functions_.motion(nb::cast<const MotionPart&>(spec.fun).mechanics).relative_error();
  if (!spec.callback.is_none()) problem_.callback = functions_.truth(spec.callback, "callback(t, y)");
  for (const InvariantSpec& one : spec.invariants) problem_.invariants.push_back(make_block(one, functions_));
  problem_.value = to_vector(spec.value);
  if (spec.linear) problem_.linear = make_linear(*spec.linear, functions_);
  for (const EventSpec& one : spec.events) problem_.events.push_back(make_event(one, functions_));
  for (const VectorSpec& one : spec.vectors)
    problem_.vectors.push_back(make_vector(one, problem_.vectors.size(), functions_, problem_.events));
  for (const EventFunction& event : problem_.events)
    if (event.vector == EventFunction::alone && !event.function)
      throw std::invalid_argument("an event has no function");
  if (spec.lower || spec.upper) problem_.bounds.emplace(to_vector(spec.lower), to_vector(spec.upper));
  problem_.signed_states = spec.signed_states;
  for (const BreakpointSpec& one : spec.breakpoints) problem_.breakpoints.push_back(make_breakpoint(one, functions_));
  problem_.landings = make_landings(spec.landings);
  if (spec.variations) add_variations(*spec.variations, functions_, problem_);
  problem_.parameters = functions_.parameters();
}

// ---------------------------------------------------------------------------------------------------------------------
// What Python sees

namespace {

void define_functions(nb::module_& module) {
  nb::class_<InvariantSpec>(module, "Invariant", nb::type_slots(slots<InvariantSpec>), "An invariant, for the core.")
      .def(nb::init<nb::object, nb::object, std::size_t, std::string, bool, int, std::vector<std::size_t>, nb::object,
                    std::size_t, int, bool, std::vector<std::size_t>, std::vector<int>, bool>(),
           nb::arg("fun"), nb::arg("jac"), nb::arg("m"), nb::arg("name"), nb::arg("held"), nb::arg("level") = 0,
           nb::arg("moves") = std::vector<std::size_t>{}, nb::arg("metric") = nb::none(), nb::arg("metric_size") = 0,
           nb::arg("sense") = 0, nb::arg("along_steps") = false, nb::arg("starts") = std::vector<std::size_t>{},
           nb::arg("columns") = std::vector<int>{}, nb::arg("users") = false,
           "starts, columns: the places of the entries that a sparse jac returns, row by row.");
  nb::class_<BreakpointSpec>(module, "Breakpoint", nb::type_slots(slots<BreakpointSpec>), "A breakpoint, for the core.")
      .def(nb::init<double, nb::object>(), nb::arg("t"), nb::arg("action").none());
  nb::class_<EventSpec>(module, "Event", nb::type_slots(slots<EventSpec>), "An event, for the core.")
      .def(nb::init<nb::object, std::int64_t, int, std::string, nb::object, bool, int, std::optional<SeriesSpec>, bool,
                    bool>(),
           nb::arg("fun").none(), nb::arg("terminal"), nb::arg("direction"), nb::arg("name"), nb::arg("action").none(),
           nb::arg("rehold"), nb::arg("samples") = 0, nb::arg("series") = nb::none(), nb::arg("touching") = false,
           nb::arg("at_jumps") = true,
           "fun: None for a component of a vector. samples: points inside a step; 0: the usual ones, -1: adaptive. "
           "series: along polynomials, for methods "
           "whose steps are such. touching: zeros without a change of sign are reported too. at_jumps: it occurs where "
           "jumps change its sign.");
  nb::class_<VectorSpec>(module, "RootVector", nb::type_slots(slots<VectorSpec>),
                         "Events that are one function with one action, for the core.")
      .def(nb::init<nb::object, std::size_t, std::size_t, std::string, nb::object>(), nb::arg("fun"), nb::arg("first"),
           nb::arg("count"), nb::arg("name"), nb::arg("action"));
}

void define_linear(nb::module_& module) {
  nb::class_<LinearSpec>(module, "Linear", nb::type_slots(slots<LinearSpec>),
                         "Known properties of the Jacobian of f and of the mass matrix.")
      .def(
          "__init__",
          [](LinearSpec* self, const std::string& structure, std::size_t n, std::size_t lower, std::size_t upper,
             const std::string& kind, nb::object jacobian, nb::object mass, nb::object null_basis, nb::object lapack,
             std::int64_t found_pattern, nb::object product, nb::object preconditioner, std::size_t dimension,
             nb::object rate) {
            new (self) LinearSpec{{choose(structure_names, structure, "structure"), n, lower, upper},
                                  choose(jacobian_names, kind, "kind of Jacobian"),
                                  std::move(jacobian),
                                  std::move(mass),
                                  std::move(null_basis),
                                  std::move(lapack),
                                  found_pattern,
                                  std::move(product),
                                  std::move(preconditioner),
                                  dimension,
                                  std::move(rate)};
          },
          nb::kw_only(), nb::arg("structure"), nb::arg("n"), nb::arg("lower"), nb::arg("upper"), nb::arg("kind"),
          nb::arg("jacobian").none(), nb::arg("mass").none(), nb::arg("null_basis").none(), nb::arg("lapack").none(),
          nb::arg("found_pattern") = 0, nb::arg("product").none() = nb::none(),
          nb::arg("preconditioner").none() = nb::none(), nb::arg("dimension") = 0, nb::arg("rate").none() = nb::none())
      .def_prop_ro(
          "kind", [](const LinearSpec& l) { return name_in(jacobian_names, l.kind); },
          "Kind of Jacobian, as it was given.")
      .def_prop_ro(
          "structure", [](const LinearSpec& l) { return name_in(structure_names, l.structure.kind); },
          "Structure of the Jacobian, as it was given.")
      .def_ro("found_pattern", &LinearSpec::found_pattern, "Evaluations of f that found the pattern; 0: it was given.")
      .def_prop_ro(
          "algebraic", [](const LinearSpec& l) { return nb::len(nb::object(l.null_basis[0])) - 1; },
          "Number of algebraic equations: the dimension of the left null space of M.");
}

void define_variations(nb::module_& module) {
  nb::class_<VariationsSpec>(module, "Variations", nb::type_slots(slots<VariationsSpec>),
                             "Sensitivities to k parameters. A run of a problem that has them integrates Y of shape (1 "
                             "+ k, n): y, then dy/dp_j.")
      .def(nb::init<std::size_t, nb::object, ConstMatrix, Objects, Objects, Objects, nb::object, bool, bool>(),
           nb::arg("k"), nb::arg("slope"), nb::arg("thresholds"), nb::arg("invariants") = Objects{},
           nb::arg("jumps") = Objects{}, nb::arg("breakpoints") = Objects{}, nb::arg("landings") = nb::none(),
           nb::arg("error_test") = true, nb::arg("quadratures") = false,
           "slope(t, Y) -> (k, n): J S_j + f_pj. thresholds: (k, n), absolute tolerances of S. For each invariant "
           "(t, Y) -> (k, m): G S_j + g_pj; for each event and breakpoint (t, Y before, y after) -> S after, (k, n), "
           "or None if it does not act. An empty list: none has any. landings: such a function for all landings, or "
           "None. error_test=False: S has no part in the error test. quadratures=True: the slope is a function of "
           "(t, y) alone, and M the identity for S.")
      .def_ro("k", &VariationsSpec::k)
      .def_ro("error_test", &VariationsSpec::error_test);
}

void define_delays(nb::module_& module) {
  nb::class_<DelaysSpec>(module, "Delays", nb::type_slots(slots<DelaysSpec>), "Constant delays, for the core.")
      .def(nb::init<std::vector<double>, std::vector<std::int64_t>, std::vector<double>, nb::object,
                    std::vector<double>, std::vector<double>>(),
           nb::arg("lags"), nb::arg("parameters"), nb::arg("constant"), nb::arg("history").none(), nb::arg("jumps"),
           nb::arg("rates"),
           "lags: their values. parameters: of each its number among the parameters, or -1. constant: the history, if "
           "it "
           "is constant; history: or else a function (t, y, *args) -> y. jumps: times before t0 at which it jumps. "
           "rates: derivatives of the delays for the parameters of sensitivities, one row for each delay.");
}

void define_description(nb::module_& module) {
  nb::class_<ProblemSpec>(module, "Problem", nb::type_slots(slots<ProblemSpec>),
                          "Problem to be solved, except its initial value. n: reals in a state.")
      .def(nb::init<std::size_t, bool, nb::object, nb::tuple, ConstVector, std::optional<LinearSpec>,
                    std::vector<EventSpec>, std::vector<VectorSpec>, std::vector<BreakpointSpec>, LandingsSpec,
                    nb::object, std::vector<InvariantSpec>, OptionalVector, OptionalVector, OptionalVector, bool,
                    std::optional<VariationsSpec>, std::optional<SeriesSpec>, std::optional<SeriesSpec>, std::size_t,
                    std::optional<DelaysSpec>>(),
           nb::kw_only(), nb::arg("n"), nb::arg("complex"), nb::arg("fun").none(), nb::arg("args"),
           nb::arg("parameters"), nb::arg("linear") = nb::none(), nb::arg("events") = nb::list(),
           nb::arg("vectors") = nb::list(), nb::arg("breakpoints") = nb::list(), nb::arg("landings") = LandingsSpec(),
           nb::arg("callback") = nb::none(), nb::arg("invariants") = nb::list(), nb::arg("value") = nb::none(),
           nb::arg("lower") = nb::none(), nb::arg("upper") = nb::none(), nb::arg("signed_states") = false,
           nb::arg("variations") = nb::none(), nb::arg("series") = nb::none(), nb::arg("conditions") = nb::none(),
           nb::arg("condition_count") = 0, nb::arg("delays") = nb::none(),
           "signed_states: y may be negative, and none that falls below 0 is reported. landings: single times in "
           "increasing order, and the first times and periods of progressions. conditions: "
           "condition_count values along a polynomial, of which one changes its sign where f changes its "
           "branch.");
  nb::class_<Tolerances>(module, "Tolerances", "rtol, thr = atol / rtol of all or of each, scales of a vector rtol.")
      .def(nb::init<double, std::variant<double, ConstVector>, OptionalVector>(), nb::arg("rtol"), nb::arg("threshold"),
           nb::arg("scale").none());
}

/// A setting of the core's structs: its name, and how its value gets there and back.
struct Setting {
  const char* name;
  void (*set)(RunSettings&, nb::handle);
  nb::object (*get)(const RunSettings&);
};

template <auto member>
constexpr Setting plain(const char* name) {
  using Value = std::remove_cvref_t<decltype(std::declval<RunSettings>().*member)>;
  return {name, [](RunSettings& s, nb::handle value) { s.*member = nb::cast<Value>(value); },
          [](const RunSettings& s) { return nb::cast(s.*member); }};
}

void set_times(RunSettings& s, nb::handle times) {
  s.output_at_times = !times.is_none();
  s.times = {};
  if (!s.output_at_times) return;
  const auto array = nb::cast<ConstVector>(times);
  s.times = Times({array.data(), array.size()});
}
nb::object get_times(const RunSettings& s) {
  if (!s.output_at_times) return nb::none();
  const std::span<const double> all = s.times.from(0);
  return nb::cast(to_array<Vector>(std::vector<double>(all.begin(), all.end()), all.size()), nb::rv_policy::move);
}

/// A method by its name; "": none.
template <auto member>
constexpr Setting named_method(const char* name) {
  return {name,
          [](RunSettings& s, nb::handle value) {
            const auto given = nb::cast<std::string>(value);
            s.*member = given.empty() ? nullptr : find_method(given);
            if (s.*member == nullptr && !given.empty()) throw std::invalid_argument("unknown method '" + given + "'");
          },
          [](const RunSettings& s) { return nb::cast(s.*member ? (s.*member)->name : ""); }};
}

/// The settings in the order of `Settings` in plan.py, which tests/test_binding.py compares.
constexpr Setting settings[] = {
    plain<&RunSettings::t0>("t0"),
    plain<&RunSettings::tf>("tf"),
    plain<&RunSettings::hmax>("max_step"),
    {"times", set_times, get_times},
    plain<&RunSettings::max_points>("max_points"),
    plain<&RunSettings::max_bytes>("max_bytes"),
    plain<&RunSettings::first_step>("first_step"),
    plain<&RunSettings::refine>("refine"),
    {"interpolation",
     [](RunSettings& s, nb::handle name) {
       s.interpolation = choose(interpolation_names, nb::cast<std::string>(name), "interpolation");
     },
     [](const RunSettings& s) { return nb::cast(name_of(s.interpolation)); }},
    plain<&RunSettings::dense>("dense"),
    plain<&RunSettings::sections>("sections"),
    plain<&RunSettings::save_all>("save_all"),
    plain<&RunSettings::record>("record"),
    plain<&RunSettings::check>("check"),
    {"fsal", [](RunSettings& s, nb::handle name) { s.fsal = choose(fsal_names, nb::cast<std::string>(name), "fsal"); },
     [](const RunSettings& s) { return nb::cast(name_of(s.fsal)); }},
    plain<&RunSettings::max_order>("max_order"),
    plain<&RunSettings::bdf>("bdf"),
    named_method<&RunSettings::prefer_explicit>("prefer_explicit"),
    named_method<&RunSettings::prefer_implicit>("prefer_implicit"),
    plain<&RunSettings::iterations>("iterations"),
    plain<&RunSettings::negligible>("negligible"),
    plain<&RunSettings::max_steps>("max_steps"),
    plain<&RunSettings::time_limit>("time_limit"),
};

void define_settings(nb::module_& module) {
  nb::class_<RunSettings> defined(module, "Settings", "The options of a run, in the form the core takes.");
  defined.def(nb::init<>());
  defined.def(
      "__init__",
      [](RunSettings* self, const nb::tuple& values) {
        if (values.size() != std::size(settings)) throw nb::value_error("not one value for each of Settings.FIELDS");
        RunSettings given;
        for (std::size_t i = 0; i < std::size(settings); ++i) settings[i].set(given, values[i]);
        new (self) RunSettings(std::move(given));
      },
      nb::arg("values"), "All of them, in the order of FIELDS.");
  std::vector<const char*> names;
  for (const Setting& one : settings) {
    names.push_back(one.name);
    defined.def_prop_rw(
        one.name, [get = one.get](const RunSettings& s) { return get(s); },
        [set = one.set](RunSettings& s, const nb::object& value) { set(s, value); });
  }
  defined.attr("FIELDS") = nb::tuple(nb::cast(names));
}

}  // namespace

bool BoundProblem::raise_overflow(const Integration& ended) const {
  const Report& report = ended.report();
  const bool undefined = report.component >= 0 && (report.cause == Cause::not_finite || report.cause == Cause::newton);
  if (ended.state() != State::start_undefined && !(ended.state() == State::step_failed && undefined)) return false;
  return functions_.raise_overflow(report.t, ended.forward());
}

void define_problem(nb::module_& module) {
  define_functions(module);
  define_linear(module);
  define_variations(module);
  define_delays(module);
  define_description(module);
  define_settings(module);
}

}  // namespace invariode::binding
