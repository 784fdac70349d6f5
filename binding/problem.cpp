#include "problem.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <stdexcept>
#include <tuple>
#include <utility>

#include "arguments.hpp"
#include "arrays.hpp"
#include "mechanics.hpp"
#include "run/names.hpp"

namespace invariode::binding {
namespace {

/// The values of an array; none of None.
std::vector<double> values_of(nb::handle array) {
  return array.is_none() ? std::vector<double>() : to_vector(nb::cast<ConstVector>(array));
}

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

Metric make_metric(const Record& spec, Functions& functions) {
  const nb::object metric = spec["metric"];
  if (metric.is_none()) return {};
  const bool function =
      nb::isinstance<Native>(metric) || nb::isinstance<MotionPart>(metric) || PyCallable_Check(metric.ptr()) != 0;
  if (!function) return {.function = {}, .values = values_of(metric)};
  const std::string name = "the metric of invariant " + spec.get<std::string>("name");
  const std::size_t moves = nb::len(spec["moves"]), k = moves == 0 ? functions.state_size() : moves;
  const auto size = spec.get<std::size_t>("metric_size");
  return {.function = size == k ? functions.vector(metric, name, k) : functions.square(metric, name, k),
          .values = std::vector<double>(size)};
}

InvariantBlock make_block(const Record& spec, Functions& functions) {
  const std::string name = "invariant " + spec.get<std::string>("name");
  const nb::object fun = spec["fun"], jac = spec["jac"];
  InvariantBlock block;
  block.m = spec.get<std::size_t>("m");
  block.g = functions.vector(fun, name, block.m);
  block.held = spec.get<bool>("held");
  block.level = spec.get<int>("level");
  block.moves = spec.get<std::vector<std::size_t>>("moves");
  block.metric = make_metric(spec, functions);
  block.sense = spec.get<int>("sense");
  block.along_steps = spec.get<bool>("along_steps");
  block.users = spec.get<bool>("users");
  if (nb::isinstance<MotionPart>(jac)) {
    const auto& [mechanics, part] = nb::cast<const MotionPart&>(jac);
    if (Motion& motion = functions.motion(mechanics); motion.sparse()) {
      block.jacobian = motion.entries(part);
      block.pattern = motion.pattern(part);
      return block;
    }
  }
  if (!nb::isinstance<nb::str>(jac)) {
    block.pattern = {spec.get<std::vector<std::size_t>>("starts"), spec.get<std::vector<int>>("columns")};
    const auto& [starts, columns] = block.pattern;
    require(starts.empty() || (starts.size() == block.m + 1 && starts.front() == 0 && starts.back() == columns.size() &&
                               std::ranges::is_sorted(starts)),
            "the pattern of an invariant's Jacobian is not one of its rows");
    if (block.pattern)
      block.jacobian = functions.vector(jac, "the Jacobian of " + name, columns.size());
    else
      block.jacobian = functions.rows(jac, "the Jacobian of " + name, block.m);
    return block;
  }
  const auto substitute = nb::cast<std::string>(jac);
  block.derivative = choose(substitutes, substitute, "kind of derivative");
  if (block.derivative != Derivative::complex_step) return block;
  nb::object at_complex = fun;
  if (substitute == choose_derivative || nb::isinstance<Native>(fun))
    at_complex = nb::module_::import_("invariode._functions.increments").attr("at_complex")(fun, block.m);
  block.complex_g = functions.complex_vector(at_complex, name, block.m);
  return block;
}

EventFunction make_event(const Record& spec, Functions& functions) {
  EventFunction event;
  const auto name = spec.get<std::string>("name");
  const std::string title = name == "event" ? name : "event " + name;
  const nb::object fun = spec["fun"], action = spec["action"], series = spec["series"];
  if (!fun.is_none()) event.function = functions.event(fun, title);
  event.terminal = spec.get<std::int64_t>("terminal");
  event.direction = spec.get<int>("direction");
  if (!action.is_none()) event.action = functions.state_valued(action, "the action of " + title);
  event.rehold = spec.get<bool>("rehold");
  event.samples = spec.get<int>("samples");
  if (!series.is_none()) event.series = functions.series(nb::cast<const SeriesSpec&>(series));
  event.touching = spec.get<bool>("touching");
  event.at_jumps = spec.get<bool>("at_jumps");
  return event;
}

/// Its components are the events from `first` on, which have no function of their own.
RootVector make_vector(const Record& spec, std::size_t number, Functions& functions,
                       std::vector<EventFunction>& events) {
  const auto first = spec.get<std::size_t>("first"), size = spec.get<std::size_t>("size");
  const auto name = spec.get<std::string>("name");
  if (first + size > events.size()) throw std::invalid_argument("a vector has more events than there are");
  for (std::size_t k = 0; k < size; ++k) events[first + k].vector = number;
  return {functions.events(spec["fun"], "fun of " + name, size), first, size,
          functions.action_of_vector(spec["action"], "on_roots of " + name, size)};
}

Breakpoint make_breakpoint(const Record& spec, Functions& functions) {
  Breakpoint point{.t = spec.get<double>("t"), .action = {}, .jump = {}};
  const nb::object action = spec["action"];
  if (!action.is_none()) point.action = functions.state_valued(action, "the action at a breakpoint");
  return point;
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
  take("dlaswp", lapack.real.exchange);
  take("zlaswp", lapack.complex.exchange);
  take("dtrsm", lapack.real.solve_triangle);
  take("ztrsm", lapack.complex.solve_triangle);
  take("dgemm", lapack.real.multiply);
  take("zgemm", lapack.complex.multiply);
  return lapack;
}

LinearTerms make_linear(const Record& spec, Functions& functions) {
  using Kind = Jacobian::Kind;
  const Structure structure{choose(structure_names, spec.get<std::string>("structure"), "structure"),
                            spec.get<std::size_t>("n"), spec.get<std::size_t>("lower"), spec.get<std::size_t>("upper")};
  const Kind kind = choose(jacobian_names, spec.get<std::string>("kind"), "kind of Jacobian");
  LinearTerms linear{.source = {.kind = kind,
                                .function = {},
                                .complex_f = {},
                                .rate = {},
                                .product = {},
                                .found_pattern = spec.get<std::int64_t>("found_pattern") > 0},
                     .jacobian = Matrix::without_values(structure),
                     .mass = {},
                     .lapack = {},
                     .krylov = {}};
  nb::object known = spec["jacobian"];  // values or pattern
  const nb::object product = spec["product"], rate = spec["rate"], given_mass = spec["mass"];
  const bool is_function = kind == Kind::function || kind == Kind::derived;
  if (is_function || kind == Kind::complex_steps) {
    nb::object code = std::exchange(known, nb::none());
    if (nb::isinstance<nb::tuple>(code)) std::tie(code, known) = nb::cast<std::pair<nb::object, nb::object>>(code);
    if (is_function && code.is_none())
      linear.source.product = functions.product(product, "∂f/∂y v");
    else if (is_function)
      linear.source.function = functions.matrix(code);
    else
      linear.source.complex_f = functions.complex_vector(code, "fun(t, y)", structure.n);
  }
  if (!known.is_none()) read_matrix(known, linear.jacobian);
  if (!rate.is_none()) linear.source.rate = functions.vector(rate, "∂f/∂t", structure.n);
  if (const nb::object lapack = spec["lapack"]; !lapack.is_none() && by_lapack(structure))
    linear.lapack = read_lapack(lapack());
  if (kind == Kind::products) {
    KrylovTerms& krylov = linear.krylov.emplace();
    const nb::object preconditioner = spec["preconditioner"];
    if (!product.is_none()) krylov.product = functions.product(product, "jac_product(t, y, v)");
    if (!preconditioner.is_none()) krylov.preconditioner = functions.preconditioner(preconditioner);
    krylov.dimension = spec.get<std::size_t>("dimension");
  }
  if (given_mass.is_none()) return linear;
  Matrix mass(structure);
  MatrixFunction function;
  if (PyCallable_Check(given_mass.ptr()) != 0)
    function = functions.matrix(given_mass);
  else
    read_matrix(given_mass, mass);
  linear.mass.emplace(std::move(mass), function, read_sparse(spec["null_basis"], structure.n));
  return linear;
}

/// Into the problem, whose invariants, events and breakpoints are there.
void add_variations(const Record& spec, Functions& functions, Problem& problem) {
  const auto each = [&](const char* name, std::size_t count) {
    auto given = spec.get<std::vector<nb::object>>(name);
    if (given.size() == count || given.empty()) return given;
    throw std::invalid_argument("sensitivities have " + std::to_string(given.size()) + " functions for " +
                                std::to_string(count) + " " + name);
  };
  const auto tangents = each("invariants", problem.invariants.size()), jumps = each("events", problem.events.size()),
             doses = each("breakpoints", problem.breakpoints.size());
  Variations& variations = problem.variations.emplace();
  variations.k = spec.get<std::size_t>("k");
  const std::size_t delays = problem.delays ? problem.delays->lags.size() : 0;
  variations.slope = functions.of_sensitivities(spec["slope"], "the slope of the sensitivities", variations.k, delays);
  const auto thresholds = spec.get<ConstMatrix>("thresholds");
  variations.tolerance.assign(thresholds.data(), thresholds.data() + thresholds.size());
  variations.error_test = spec.get<bool>("error_test");
  variations.quadratures = spec.get<bool>("quadratures");
  for (std::size_t i = 0; i < tangents.size(); ++i) {
    InvariantBlock& block = problem.invariants[i];
    block.tangent = functions.tangent(tangents[i], "the tangent of an invariant", variations.k, block.m);
  }
  const auto jump = [&](const nb::object& one) {
    return one.is_none() ? Callback() : functions.jump(one, "the jump of the sensitivities", variations.k, delays);
  };
  for (std::size_t i = 0; i < jumps.size(); ++i) problem.events[i].jump = jump(jumps[i]);
  for (std::size_t i = 0; i < doses.size(); ++i) problem.breakpoints[i].jump = jump(doses[i]);
  problem.landings.jump = jump(spec["landings"]);
}

/// Of single times, and the first times and the periods of progressions.
Landings make_landings(nb::handle given) {
  using Times = std::vector<double>;
  auto [times, first, periods] = nb::cast<std::tuple<Times, Times, Times>>(given);
  require(first.size() == periods.size(), "landings have not one period for each first time");
  std::vector<Landings::Progression> progressions;
  progressions.reserve(first.size());
  for (std::size_t i = 0; i < first.size(); ++i) progressions.push_back({.first = first[i], .period = periods[i]});
  return {std::move(times), std::move(progressions)};
}

DelayTerms make_delays(const Record& spec, Functions& functions) {
  const auto lags = spec.get<std::vector<double>>("lags");
  const auto parameters = spec.get<std::vector<std::int64_t>>("parameters");
  require(parameters.size() == lags.size(), "delays have not one number of a parameter each");
  DelayTerms terms{.lags = {},
                   .constant = values_of(spec["constant"]),
                   .history = {},
                   .history_varies = spec.get<std::size_t>("varied") > 0,
                   .jumps = spec.get<std::vector<double>>("jumps"),
                   .rates = spec.get<std::vector<double>>("rates")};
  for (std::size_t j = 0; j < lags.size(); ++j) {
    const std::int64_t number = parameters[j];
    terms.lags.push_back({lags[j], number < 0 ? std::nullopt : std::optional(static_cast<std::size_t>(number))});
  }
  if (const nb::object history = spec["history"]; !history.is_none())
    terms.history = terms.history_varies ? functions.rows(history, "history(t)", 1 + spec.get<std::size_t>("varied"))
                                         : functions.state_valued(history, "history(t)");
  return terms;
}

}  // namespace

Weights to_weights(double rtol, std::vector<double> threshold, std::vector<double> scale) {
  const bool valid = rtol > 0 && std::ranges::all_of(threshold, [](double thr) { return thr >= 0; }) &&
                     std::ranges::all_of(scale, [](double one) { return one > 0; });
  require(valid, "tolerances are not positive");
  return {rtol, std::move(threshold), std::move(scale)};
}

Weights read_weights(const Record& tolerances, std::size_t n) {
  const nb::object threshold = tolerances["threshold"];
  const bool one = nb::isinstance<nb::float_>(threshold);
  return to_weights(tolerances.get<double>("rtol"),
                    one ? std::vector<double>(n, nb::cast<double>(threshold)) : values_of(threshold),
                    values_of(tolerances["scale"]));
}

BoundProblem::BoundProblem(const Record& spec)
    : functions_({spec.get<std::size_t>("n"), spec.get<bool>("complex")}, spec.get<nb::tuple>("args"),
                 values_of(spec["parameters"].attr("numbers"))) {
  problem_.n = functions_.state_size();
  problem_.complex = spec.get<bool>("complex");
  if (const nb::object delays = spec["delays"]; !delays.is_none())
    problem_.delays = make_delays(Record(delays), functions_);
  const std::size_t delays = problem_.delays ? problem_.delays->lags.size() : 0;
  const nb::object fun = spec["fun"], series = spec["series"], conditions = spec["conditions"];
  if (!fun.is_none()) problem_.f = functions_.slope(fun, delays > 0 ? "fun(t, y, z)" : "fun(t, y)", delays);
  if (!series.is_none()) problem_.series.emplace().solution = functions_.series(nb::cast<const SeriesSpec&>(series));
  if (!series.is_none() && !conditions.is_none()) {
    problem_.series->conditions = functions_.series(nb::cast<const SeriesSpec&>(conditions));
    problem_.series->count = spec.get<std::size_t>("condition_count");
  }
  if (nb::isinstance<MotionPart>(fun))
    problem_.f_error = functions_.motion(nb::cast<const MotionPart&>(fun).mechanics).relative_error();
  if (const nb::object callback = spec["callback"]; !callback.is_none())
    problem_.callback = functions_.truth(callback, "callback(t, y)");
  for (const nb::handle one : spec["invariants"]) problem_.invariants.push_back(make_block(Record(one), functions_));
  problem_.value = values_of(spec["value"]);
  if (const nb::object linear = spec["linear"]; !linear.is_none())
    problem_.linear = make_linear(Record(linear), functions_);
  for (const nb::handle one : spec["events"]) problem_.events.push_back(make_event(Record(one), functions_));
  for (const nb::handle one : spec["vectors"])
    problem_.vectors.push_back(make_vector(Record(one), problem_.vectors.size(), functions_, problem_.events));
  for (const EventFunction& event : problem_.events)
    if (event.vector == EventFunction::alone && !event.function)
      throw std::invalid_argument("an event has no function");
  if (const nb::object bounds = spec["bounds"]; !bounds.is_none())
    problem_.bounds.emplace(values_of(bounds.attr("lower")), values_of(bounds.attr("upper")));
  problem_.signed_states = spec.get<bool>("signed_states");
  problem_.autonomous = spec.get<bool>("autonomous");
  for (const nb::handle one : spec["breakpoints"])
    problem_.breakpoints.push_back(make_breakpoint(Record(one), functions_));
  problem_.landings = make_landings(spec["landings"]);
  if (const nb::object variations = spec["variations"]; !variations.is_none())
    add_variations(Record(variations), functions_, problem_);
  problem_.parameters = functions_.parameters();
}

namespace {

/// A setting of the core's structs that a method and its options determine: its name, and how it takes its value.
struct Setting {
  const char* name;
  void (*set)(RunSettings&, nb::handle);
};

template <auto member>
constexpr Setting plain(const char* name) {
  using Value = std::remove_cvref_t<decltype(std::declval<RunSettings>().*member)>;
  return {name, [](RunSettings& s, nb::handle value) { s.*member = nb::cast<Value>(value); }};
}

/// A method by its name; "": none.
template <auto member>
constexpr Setting named_method(const char* name) {
  return {name, [](RunSettings& s, nb::handle value) {
            const auto given = nb::cast<std::string>(value);
            s.*member = given.empty() ? nullptr : find_method(given);
            if (s.*member == nullptr && !given.empty()) throw std::invalid_argument("unknown method '" + given + "'");
          }};
}

constexpr Setting settings_of_methods[] = {
    plain<&RunSettings::first_step>("first_step"),
    plain<&RunSettings::refine>("refine"),
    {"interpolation",
     [](RunSettings& s, nb::handle name) {
       s.interpolation = choose(interpolation_names, nb::cast<std::string>(name), "interpolation");
     }},
    plain<&RunSettings::dense>("dense"),
    plain<&RunSettings::sections>("sections"),
    plain<&RunSettings::save_all>("save_all"),
    plain<&RunSettings::record>("record"),
    plain<&RunSettings::check>("check"),
    {"fsal", [](RunSettings& s, nb::handle name) { s.fsal = choose(fsal_names, nb::cast<std::string>(name), "fsal"); }},
    plain<&RunSettings::max_order>("max_order"),
    plain<&RunSettings::bdf>("bdf"),
    named_method<&RunSettings::prefer_explicit>("prefer_explicit"),
    named_method<&RunSettings::prefer_implicit>("prefer_implicit"),
    plain<&RunSettings::iterations>("iterations"),
    plain<&RunSettings::negligible>("negligible"),
    plain<&RunSettings::max_steps>("max_steps"),
    plain<&RunSettings::time_limit>("time_limit"),
};

/// The fields of a `Course`, in their order.
using Course = std::tuple<double, double, double, nb::object, std::int64_t, std::int64_t>;

}  // namespace

void read_course(nb::handle course, Settings& settings) {
  nb::object times;
  std::tie(settings.t0, settings.tf, settings.hmax, times, settings.max_points, settings.max_bytes) =
      nb::cast<Course>(course);
  settings.output_at_times = !times.is_none();
  settings.times = settings.output_at_times ? Times(numbers_of(times)) : Times();
}

RunSettings read_settings(nb::handle course, const Record& settings) {
  RunSettings all;
  read_course(course, all);
  for (const Setting& one : settings_of_methods) one.set(all, settings[one.name]);
  return all;
}

bool BoundProblem::raise_overflow(const Integration& ended) const {
  const Report& report = ended.report();
  const bool undefined = report.component >= 0 && (report.cause == Cause::not_finite || report.cause == Cause::newton);
  if (ended.state() != State::start_undefined && !(ended.state() == State::step_failed && undefined)) return false;
  return functions_.raise_overflow(report.t, ended.forward());
}

}  // namespace invariode::binding
