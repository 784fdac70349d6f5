#include "dense.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/variant.h>

#include <cmath>
#include <optional>
#include <string>
#include <string_view>
#include <utility>

#include "interpreter.hpp"
#include "manifold/projection.hpp"
#include "methods/extensions.hpp"
#include "run/names.hpp"

namespace invariode::binding {
namespace {

Vector copied(const std::vector<double>& values) {
  return to_array<Vector>(std::vector<double>(values), values.size());
}

/// Adds the segments one by one. They may be of a file that anyone wrote: each is checked to be one that can be
/// evaluated.
void add_segments(Dense& dense, const ConstVector& t, const ConstMatrix& y, const ConstVector& end,
                  const ConstOffsets& offset, const ConstVector& data, std::size_t overhead,
                  const NamedExtension& raw) {
  const std::size_t n = y.shape(1), segments = end.size();
  const double forward = t.data()[segments] >= t.data()[0] ? 1 : -1;
  require(std::isfinite(t.data()[0]), "times are not finite");
  dense.output.start(t.data()[0], y.data());
  for (std::size_t s = 0; s < segments; ++s) {
    const auto begin = static_cast<std::size_t>(offset.data()[s]);
    const std::size_t stop = s + 1 < segments ? static_cast<std::size_t>(offset.data()[s + 1]) : data.size();
    require((s > 0 || begin == 0) && begin <= stop && stop <= data.size(), "segments do not match");
    const double t0 = t.data()[s], t1 = end.data()[s], reached = t.data()[s + 1];
    const double* next = y.data() + (s + 1) * n;
    if (t1 == t0) {  // a jump
      require(begin == stop && reached == t0, "jumps do not match");
      dense.output.start(t0, next);
      continue;
    }
    require(std::isfinite(t1) && forward * t0 < forward * reached && forward * reached <= forward * t1,
            "times do not follow one another");
    const std::size_t size = stop - begin;
    require(size >= overhead && raw.fits(data.data() + begin, size - overhead, n), "segments do not match");
    dense.output.add({t0, t1, data.data() + begin, size}, reached, next);
  }
}

Dense from_parts(const ConstVector& t, const ConstMatrix& y, const ConstVector& end, const ConstOffsets& offset,
                 const ConstVector& data, std::size_t m, const std::string& interpolation, const std::string& extension,
                 double rtol, const std::variant<double, ConstVector>& threshold,
                 const std::optional<ConstVector>& scale, bool complex, const std::optional<ConstVector>& lower,
                 const std::optional<ConstVector>& upper, std::size_t parameters) {
  const std::size_t n = y.shape(1), segments = end.size();
  const std::optional<Interpolation> mode = find_in(interpolation_names, interpolation);
  const NamedExtension* raw = find_extension(std::string_view(extension));
  require(raw != nullptr, "unknown extension");
  require(mode.has_value(), "unknown interpolation");
  require(n > 0 || segments == 0, "there is nothing to interpolate");
  require(t.size() == segments + 1 && y.shape(0) == t.size() && offset.size() == segments, "lengths do not match");
  const auto* each = std::get_if<ConstVector>(&threshold);
  const std::size_t states = 1 + parameters;
  require(states > 0 && n % states == 0, "a point is not a state with its sensitivities");
  const SegmentKind kind{Extent(n / states, parameters), m, *mode, raw->evaluate};
  const auto& extent = kind.extent;
  require((!each || each->size() == extent.n) && (!scale || scale->size() == extent.n), "weights do not match");
  require(lower.has_value() == upper.has_value() && (!lower || lower->size() == extent.n), "bounds do not match");
  Dense dense{DenseOutput(kind, lower ? std::optional<Bounds>(std::in_place, to_vector(*lower), to_vector(*upper))
                                      : std::nullopt),
              to_weights(rtol, each ? to_vector(*each) : std::vector<double>(extent.n, std::get<double>(threshold)),
                         scale ? to_vector(*scale) : std::vector<double>{}),
              complex};
  add_segments(dense, t, y, end, offset, data, kind.overhead(), *raw);
  return dense;
}

}  // namespace

std::vector<double> Dense::at(std::span<const double> t, nb::handle problem) const {
  std::optional<BoundProblem> bound;
  std::optional<Invariants> invariants;
  std::optional<Projector> projector;
  std::optional<TangentProjector> tangent;
  const SegmentKind& kind = output.kind();
  const Extent& extent = kind.extent;
  if (kind.projects() && !problem.is_none()) bound.emplace(Record(problem));
  if (bound && !bound->problem().invariants.empty()) {
    require(bound->problem().value.size() == kind.m, "not the number of invariants of the run");
    require_sizes(bound->problem(), weights);
    require(bound->problem().extent() == extent, "not the sensitivities of the run");
    invariants.emplace(extent.n, bound->problem().invariants, bound->problem().value, weights);
    projector.emplace(*invariants, weights, 1);
    if (extent.k > 0) tangent.emplace(*invariants, weights, output.size(), nullptr);
  }
  std::vector<double> y(t.size() * output.size());
  Status status = Status::ok;
  {
    const Unlocked unlocked(!bound || bound->native());
    status =
        output.evaluate(t.data(), t.size(), y.data(), projector ? &*projector : nullptr, tangent ? &*tangent : nullptr);
  }
  if (status == Status::stop) throw nb::python_error();
  return y;
}

Table Dense::evaluate(const ConstVector& t, nb::handle problem) const {
  return to_array<Table>(at({t.data(), t.size()}, problem), t.size(), output.size());
}

Dense Dense::joined(const Dense& next) const {
  const DenseOutput::Parts a = output.parts(), b = next.output.parts();
  require(output.size() == 0 || a.knots.t.back() == b.knots.t.front(),
          "continuous solutions that do not follow one another");
  require(output.kind() == next.output.kind() && complex == next.complex, "continuous solutions of different kinds");
  Dense both{DenseOutput(output.kind(), a.bounds), weights, complex};
  both.output.append(output);
  both.output.append(next.output);
  return both;
}

nb::dict Dense::parts() const {
  const DenseOutput::Parts all = output.parts();
  const std::vector<std::int64_t> offset(all.offset.begin(), all.offset.end());
  nb::dict d;
  d["t"] = copied(all.knots.t.copy());
  d["y"] = to_array<Table>(all.knots.y.copy(), all.knots.t.size(), output.size());
  d["end"] = copied(all.end);
  d["offset"] = to_array<Integers>(std::vector<std::int64_t>(offset), offset.size());
  d["data"] = copied(all.data.copy());
  d["m"] = output.kind().m;
  d["parameters"] = output.kind().extent.k;
  d["interpolation"] = name_of(output.kind().mode);
  d["extension"] = find_extension(output.kind().raw).name;
  d["rtol"] = weights.rtol();
  d["threshold"] = copied(weights.threshold());
  d["scale"] = weights.scale().empty() ? nb::object(nb::none()) : nb::cast(copied(weights.scale()));
  d["complex"] = complex;
  const std::optional<Bounds>& bounds = all.bounds;
  d["lower"] = bounds ? nb::object(nb::cast(copied(bounds->lower()))) : nb::none();
  d["upper"] = bounds ? nb::object(nb::cast(copied(bounds->upper()))) : nb::none();
  return d;
}

void define_dense(nb::module_& module) {
  nb::class_<Dense>(module, "Dense", "The continuous solution of a run.")
      .def_static("from_parts", &from_parts, nb::kw_only(), nb::arg("t"), nb::arg("y"), nb::arg("end"),
                  nb::arg("offset"), nb::arg("data"), nb::arg("m"), nb::arg("interpolation"), nb::arg("extension"),
                  nb::arg("rtol"), nb::arg("threshold"), nb::arg("scale").none(), nb::arg("complex"),
                  nb::arg("lower") = nb::none(), nb::arg("upper") = nb::none(), nb::arg("parameters") = 0,
                  "Rebuild the continuous solution from the result of `parts`.")
      .def("parts", &Dense::parts, "Return the contents as arrays, numbers and names.")
      .def("evaluate", &Dense::evaluate, nb::arg("t"), nb::arg("problem").none(),
           "y at each t: (len(t), n); projected, where it projects, onto the invariants of `problem`. With "
           "sensitivities Y, (len(t), (1 + k) n).")
      .def("joined", &Dense::joined, nb::arg("next"), "This and then `next`, which starts where this ends.")
      .def_prop_ro(
          "n", [](const Dense& d) { return d.output.kind().extent.n; }, "Reals in a state.")
      .def_prop_ro(
          "parameters", [](const Dense& d) { return d.output.kind().extent.k; },
          "Number of parameters with sensitivities.")
      .def_ro("complex", &Dense::complex)
      .def("knots", [](const Dense& d) { return copied(d.output.knots().copy()); });
}

}  // namespace invariode::binding
