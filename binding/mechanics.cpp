#include "mechanics.hpp"

#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <Eigen/Core>
#include <algorithm>
#include <stdexcept>
#include <tuple>
#include <utility>

#include "linear/saddle.hpp"

namespace invariode::binding {
namespace {

// ---------------------------------------------------------------------------------------------------------------------
// Matrices

Eigen::MatrixXd to_eigen(const ConstMatrix& a) {
  using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  return Eigen::Map<const Rows>(a.data(), static_cast<Eigen::Index>(a.shape(0)), static_cast<Eigen::Index>(a.shape(1)));
}

Eigen::Map<const Eigen::VectorXd> to_eigen(const ConstVector& a) {
  return {a.data(), static_cast<Eigen::Index>(a.size())};
}

Vector to_numpy(const Eigen::VectorXd& a) {
  return to_array<Vector>(std::vector<double>(a.begin(), a.end()), static_cast<std::size_t>(a.size()));
}

nb::tuple to_columns(const SparseMatrix& A) {
  const auto copied = [](const auto* from, Eigen::Index count) { return std::vector(from, from + count); };
  auto starts = copied(A.outerIndexPtr(), A.outerSize() + 1);
  auto rows = copied(A.innerIndexPtr(), A.nonZeros());
  auto values = copied(A.valuePtr(), A.nonZeros());
  const std::size_t size = values.size();
  return nb::make_tuple(std::move(starts), std::move(rows), to_array<Vector>(std::move(values), size));
}

// ---------------------------------------------------------------------------------------------------------------------
// Functions

/// Calls of functions of t, q and, if there is a second vector, v.
struct Arguments {
  std::ptrdiff_t n_q, n_v;

  [[nodiscard]] Takes of(bool with_v, bool complex = false) const {
    return {.n = n_q, .second = with_v ? n_v : 0, .complex = complex, .complex_time = complex};
  }
};

/// `given`: None, or (function, complex form, the same without warnings, its first and second derivatives).
Differentiable make_differentiable(const nb::object& given, const std::string& name, const Arguments& arguments,
                                   bool with_v, std::size_t m, Functions& functions) {
  if (given.is_none()) return {};
  const auto [function, complex, quiet, slope, curvature] =
      nb::cast<std::tuple<nb::object, nb::object, nb::object, nb::object, nb::object>>(given);
  const auto rows = static_cast<std::ptrdiff_t>(m);
  Differentiable::Forms forms;
  forms.function = functions.of_motion(function, name, arguments.of(with_v), {.rows = rows});
  if (!complex.is_none()) {
    const Returns returns{.rows = rows, .complex = true};
    forms.complex = functions.of_motion(complex, name, arguments.of(with_v, true), returns);
    forms.quiet = functions.of_motion(quiet, name, arguments.of(with_v, true), returns);
  }
  if (!slope.is_none()) {
    forms.slope = functions.of_motion(slope, name, arguments.of(with_v), {.rows = rows});
    forms.curvature = functions.of_motion(curvature, name, arguments.of(with_v), {.rows = rows});
  }
  return {forms, static_cast<std::size_t>(with_v ? arguments.n_q + arguments.n_v : arguments.n_q), m};
}

MassTerm::Writes writes_named(const std::string& name) {
  if (name == "nothing") return MassTerm::Writes::nothing;
  if (name == "diagonal") return MassTerm::Writes::diagonal;
  if (name == "rows") return MassTerm::Writes::rows;
  if (name == "entries") return MassTerm::Writes::entries;
  throw std::invalid_argument("a mass matrix is not written as '" + name + "'");
}

MotionTerms make_terms(const Record& spec, Functions& functions) {
  const auto n_q = spec.get<std::size_t>("n_q"), n_v = spec.get<std::size_t>("n_v"),
             m_phi = spec.get<std::size_t>("m_phi"), m_psi = spec.get<std::size_t>("m_psi");
  const nb::object by_name = spec["functions"];
  const auto named = [&](const char* key) { return nb::object(by_name[key]); };
  const auto kept = spec.get<std::vector<bool>>("kept");
  const std::size_t map = named("kinematics").is_none() ? 0 : n_q;
  MotionTerms terms{
      .n_q = n_q,
      .n_v = n_v,
      .mass = {writes_named(spec.get<std::string>("mass_writes")), read_sparse(spec["mass"], n_v, n_v), {}},
      .force = {},
      .constraints = {},
      .velocity_constraints = {},
      .kinematics = {},
      .jacobian = {.function = {}, .entries = spec.get<bool>("jacobian_entries")},
      .phi_pattern = read_sparse(spec["phi"], m_phi, n_q),
      .psi_pattern = read_sparse(spec["psi"], m_psi, n_q + n_v),
      .kinematics_pattern = read_sparse(spec["kinematics"], map, n_q + n_v),
      .kept = std::vector<char>(kept.begin(), kept.end()),
      .sparse = spec.get<bool>("sparse"),
      .dependent = spec.get<double>("dependent")};
  const Arguments arguments{static_cast<std::ptrdiff_t>(n_q), static_cast<std::ptrdiff_t>(n_v)};
  if (terms.mass.writes != MassTerm::Writes::nothing) {
    Returns returns{.rows = arguments.n_v};
    if (terms.mass.writes == MassTerm::Writes::rows) returns.columns = returns.rows, returns.matrix = true;
    if (terms.mass.writes == MassTerm::Writes::entries) returns.rows = terms.mass.matrix.nonZeros();
    terms.mass.function = functions.of_motion(named("mass"), "mass(t, q)", arguments.of(false), returns);
  }
  terms.force = functions.of_motion(named("force"), "force(t, q, v)", arguments.of(true), {.rows = arguments.n_v});
  const auto derived = [&](const char* key, const char* name, bool with_v, std::size_t m) {
    return make_differentiable(named(key), name, arguments, with_v, m, functions);
  };
  terms.constraints = derived("constraints", "constraints(t, q)", false, m_phi);
  terms.velocity_constraints = derived("velocity_constraints", "velocity_constraints(t, q, v)", true, m_psi);
  terms.kinematics = derived("kinematics", "kinematics(t, q, v)", true, terms.n_q);
  if (const nb::object given = named("jacobian"); !given.is_none()) {
    Returns returns{.rows = static_cast<std::ptrdiff_t>(m_phi), .columns = arguments.n_q, .matrix = true};
    if (terms.jacobian.entries) returns = {.rows = terms.phi_pattern.nonZeros()};
    terms.jacobian.function = functions.of_motion(given, "jacobian(t, q)", arguments.of(false), returns);
  }
  return terms;
}

// ---------------------------------------------------------------------------------------------------------------------
// What Python sees

void rethrow(Status status) {
  if (status == Status::stop) throw nb::python_error();
}

/// A function of t, q and, if n_v > 0, v, with its derivatives.
class BoundDifferentiable {
 public:
  BoundDifferentiable(const nb::object& forms, const std::string& name, std::size_t n_q, std::size_t n_v, std::size_t m,
                      nb::tuple args, std::vector<double> parameters)
      : functions_({n_q + n_v, false}, std::move(args), std::move(parameters)) {
    const Arguments arguments{static_cast<std::ptrdiff_t>(n_q), static_cast<std::ptrdiff_t>(n_v)};
    function_ = make_differentiable(forms, name, arguments, n_v > 0, m, functions_);
    complex_ = nb::cast<nb::tuple>(forms)[1].is_none()
                   ? Callback()
                   : functions_.of_motion(nb::object(nb::cast<nb::tuple>(forms)[1]), name, arguments.of(n_v > 0, true),
                                          {.rows = static_cast<std::ptrdiff_t>(m), .complex = true});
  }
  BoundDifferentiable(const BoundDifferentiable&) = delete;
  BoundDifferentiable& operator=(const BoundDifferentiable&) = delete;

  [[nodiscard]] Vector value(double t, const ConstVector& x) {
    return filled([&](double* out) { return function_.value(t, point(x), out); });
  }
  /// The function at complex (t, x), passed as pairs of reals, with its value as pairs.
  [[nodiscard]] Vector complex_value(const ConstVector& z) {
    require(complex_ && z.size() == 2 * (1 + function_.n()), "no complex form, or no such z");
    std::vector<double> out(2 * function_.m());
    rethrow(complex_(z.data()[0], z.data(), out.data()));
    return to_array<Vector>(std::move(out), 2 * function_.m());
  }
  [[nodiscard]] Vector slope(double t, const ConstVector& x, double dt, const ConstVector& dx) {
    return filled([&](double* out) { return function_.slope(t, point(x), dt, point(dx), out); });
  }
  [[nodiscard]] Vector curvature(double t, const ConstVector& x, double dt, const ConstVector& dx) {
    return filled([&](double* out) { return function_.curvature(t, point(x), dt, point(dx), out); });
  }
  [[nodiscard]] nb::tuple jacobian(double t, const ConstVector& x, const nb::object& pattern) {
    SparseColumns columns(read_sparse(pattern, function_.m(), function_.n()), 0);
    std::vector<double> size(function_.n());
    fill_sizes(point(x), size.size(), size.data());
    rethrow(function_.jacobian(t, x.data(), size.data(), columns));
    return to_columns(columns.matrix);
  }

  int visit(visitproc visit, void* arg) const { return functions_.visit(visit, arg); }

 private:
  [[nodiscard]] const double* point(const ConstVector& x) const {
    require(x.size() == function_.n(), "x has not the size that the function takes");
    return x.data();
  }
  template <class Fill>
  Vector filled(Fill fill) {
    std::vector<double> out(function_.m());
    rethrow(fill(out.data()));
    return to_array<Vector>(std::move(out), function_.m());
  }

  Functions functions_;
  Differentiable function_;
  Callback complex_;
};

/// A motion by itself, for evaluations one by one.
class BoundMotion {
 public:
  BoundMotion(const nb::object& mechanics, nb::tuple args, std::vector<double> parameters)
      : functions_({size_of(mechanics), false}, std::move(args), std::move(parameters)),
        motion_(functions_.motion(mechanics)) {}
  BoundMotion(const BoundMotion&) = delete;
  BoundMotion& operator=(const BoundMotion&) = delete;

  [[nodiscard]] const Motion& motion() const { return motion_; }

  [[nodiscard]] Vector evaluate(const std::string& part, double t, const ConstVector& y);
  [[nodiscard]] nb::tuple rows(double t, const ConstVector& y) {
    rethrow(motion_.rows(t, state(y)));
    return nb::make_tuple(to_columns(motion_.A()), to_numpy(motion_.right_hand_side()));
  }
  [[nodiscard]] nb::tuple mass(double t, const ConstVector& y) {
    rethrow(motion_.mass(t, state(y)));
    return to_columns(motion_.M());
  }
  [[nodiscard]] std::tuple<Vector, Vector, bool> accelerations(double t, const ConstVector& y) {
    ConstrainedSolution found;
    rethrow(motion_.accelerations(t, state(y), found));
    return {to_numpy(found.a), to_numpy(found.lambda), found.unique};
  }

  int visit(visitproc visit, void* arg) const { return functions_.visit(visit, arg); }

 private:
  static std::size_t size_of(const nb::object& mechanics) {
    const Record spec(mechanics);
    return spec.get<std::size_t>("n_q") + spec.get<std::size_t>("n_v");
  }
  const double* state(const ConstVector& y) const {
    require(y.size() == motion_.size(), "y has not the size of (q, v)");
    return y.data();
  }

  Functions functions_;
  Motion& motion_;
};

constexpr std::pair<const char*, Motion::Part> parts[] = {
    {"slope", Motion::Part::slope},           {"mass", Motion::Part::mass},
    {"positions", Motion::Part::positions},   {"positions_jacobian", Motion::Part::positions_jacobian},
    {"rates", Motion::Part::rates},           {"rates_jacobian", Motion::Part::rates_jacobian},
    {"velocities", Motion::Part::velocities}, {"velocities_jacobian", Motion::Part::velocities_jacobian},
};

Motion::Part part_named(const std::string& name) {
  for (const auto& [known, part] : parts)
    if (name == known) return part;
  throw std::invalid_argument("a motion has no part '" + name + "'");
}

Vector BoundMotion::evaluate(const std::string& part, double t, const ConstVector& y) {
  std::size_t size = motion_.size();
  if (part == "mass") size = motion_.mass_size();
  if (part == "positions" || part == "rates") size = motion_.m_phi();
  if (part == "velocities") size = motion_.m_psi();
  if (part == "positions_jacobian" || part == "rates_jacobian") size *= motion_.m_phi();
  if (part == "velocities_jacobian") size *= motion_.m_psi();
  std::vector<double> out(size);
  rethrow(motion_.callback(part_named(part))(t, state(y), out.data()));
  return to_array<Vector>(std::move(out), size);
}

std::tuple<Vector, Vector, int, bool> solve(const ConstMatrix& mass, const ConstMatrix& rows, const ConstVector& force,
                                            const ConstVector& right, double threshold) {
  const ConstrainedSolution found =
      solve_saddle(to_eigen(mass), to_eigen(rows), to_eigen(force), to_eigen(right), threshold);
  return {to_numpy(found.a), to_numpy(found.lambda), static_cast<int>(found.rank), found.unique};
}

void define_system(nb::module_& module) {
  nb::class_<MotionPart>(module, "MotionPart", nb::type_slots(slots<MotionPart>),
                         "A function of (t, y) that a mechanical system has: its slope, one of its laws.")
      .def(
          "__init__",
          [](MotionPart* self, nb::object mechanics, const std::string& part) {
            new (self) MotionPart{std::move(mechanics), part_named(part)};
          },
          nb::arg("mechanics"), nb::arg("part"), "mechanics: a MechanicsTerms.");
}

}  // namespace

OwnedMotion::OwnedMotion(nb::object mechanics, Functions& functions)
    : mechanics_(std::move(mechanics)), motion_(std::make_unique<Motion>(make_terms(Record(mechanics_), functions))) {}

nb::dict to_dict(const MotionWork& work) {
  nb::dict counts;
  counts["mass"] = work.mass;
  counts["force"] = work.force;
  counts["constraints"] = work.constraints;
  counts["velocity_constraints"] = work.velocity_constraints;
  counts["kinematics"] = work.kinematics;
  counts["jacobian"] = work.jacobian;
  counts["sparse"] = work.sparse;
  counts["dense"] = work.dense;
  counts["nearly_singular"] = work.singular;
  return counts;
}

void define_mechanics(nb::module_& module) {
  define_system(module);
  nb::class_<BoundDifferentiable>(module, "Differentiable", nb::type_slots(slots<BoundDifferentiable>),
                                  "A function of t and x with its arguments, and its derivatives.")
      .def(nb::init<const nb::object&, const std::string&, std::size_t, std::size_t, std::size_t, nb::tuple,
                    std::vector<double>>(),
           nb::arg("forms"), nb::arg("name"), nb::arg("n_q"), nb::arg("n_v"), nb::arg("m"), nb::arg("args"),
           nb::arg("parameters"))
      .def("value", &BoundDifferentiable::value, nb::arg("t"), nb::arg("x"),
           "Return the values at (t, x), of shape (m,).")
      .def("complex_value", &BoundDifferentiable::complex_value, nb::arg("z"),
           "Return the complex form at (t, x); complex numbers are pairs of reals.")
      .def("slope", &BoundDifferentiable::slope, nb::arg("t"), nb::arg("x"), nb::arg("dt"), nb::arg("dx"),
           "d/ds at (t + s dt, x + s dx), s = 0.")
      .def("curvature", &BoundDifferentiable::curvature, nb::arg("t"), nb::arg("x"), nb::arg("dt"), nb::arg("dx"),
           "d²/ds² of the same.")
      .def("jacobian", &BoundDifferentiable::jacobian, nb::arg("t"), nb::arg("x"), nb::arg("pattern"),
           "∂/∂x, as (starts, rows, values) in the pattern of such a matrix.");
  nb::class_<BoundMotion>(module, "Motion", nb::type_slots(slots<BoundMotion>),
                          "The equations of motion of a mechanical system with its arguments.")
      .def(nb::init<const nb::object&, nb::tuple, std::vector<double>>(), nb::arg("mechanics"), nb::arg("args"),
           nb::arg("parameters"))
      .def("evaluate", &BoundMotion::evaluate, nb::arg("part"), nb::arg("t"), nb::arg("y"),
           "One of its functions of (t, y); matrices row by row.")
      .def("rows", &BoundMotion::rows, nb::arg("t"), nb::arg("y"), "A, as (starts, rows, values), and γ of A v' = γ.")
      .def("mass", &BoundMotion::mass, nb::arg("t"), nb::arg("y"), "M, as (starts, rows, values).")
      .def("accelerations", &BoundMotion::accelerations, nb::arg("t"), nb::arg("y"),
           "v', λ, and whether they are unique.")
      .def_prop_ro(
          "sparse", [](const BoundMotion& m) { return m.motion().sparse(); }, "True if sparse factors are tried first.")
      .def_prop_ro(
          "work", [](const BoundMotion& m) { return to_dict(m.motion().work()); },
          "Calls of functions and factorisations so far.");
  module.def("solve_saddle", &solve, nb::arg("mass"), nb::arg("rows"), nb::arg("force"), nb::arg("right"),
             nb::arg("threshold"),
             "a and λ of M a = Q + Aᵀ λ, A a = γ; the rank of A; whether a is unique (else it is NaN).");
}

}  // namespace invariode::binding
