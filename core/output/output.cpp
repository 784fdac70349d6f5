#include "output/output.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>

#include "methods/extensions.hpp"

namespace invariode {

void DenseOutput::start(double t, const double* y) {
  if (!knots_.t.empty()) {  // an empty segment from the one value at t to the other keeps segments beside their knots
    end_.push_back(t);
    offset_.push_back(data_.size());
  }
  knots_.add(t, y, n_);
}

void DenseOutput::add(const Segment& segment, double t, const double* y) {
  assert(knots_.t.size() == end_.size() + 1);  // a segment is from knot to knot
  end_.push_back(segment.t1);
  offset_.push_back(data_.size());
  data_.append(segment.data, segment.size);
  knots_.add(t, y, n_);
}

DenseOutput DenseOutput::from(std::size_t first) const {
  DenseOutput rest(kind_, bounds_);
  rest.append(*this, first);
  return rest;
}

void DenseOutput::append(const DenseOutput& next, std::size_t first) {
  assert(next.n_ == n_ && first < next.knots_.t.size());
  const Buffer<double>& t = next.knots_.t;
  const double* y = next.knots_.y.data();
  const double* start_y = y + first * n_;
  // At a landing without a jump of the state, the equations may have moved its sensitivities by roundoff.
  if (knots_.t.empty() || t[first] != knots_.t.back() ||
      !std::equal(start_y, start_y + kind_.extent.n, knots_.y.end() - n_))
    start(t[first], start_y);
  for (std::size_t s = first; s < next.end_.size(); ++s) {
    const double* reached = y + (s + 1) * n_;
    if (next.end_[s] == t[s]) {  // a jump
      start(t[s], reached);
      continue;
    }
    const std::size_t stop = s + 1 < next.offset_.size() ? next.offset_[s + 1] : next.data_.size();
    add({t[s], next.end_[s], next.data_.data() + next.offset_[s], stop - next.offset_[s]}, t[s + 1], reached);
  }
}

/// The segment that begins at knot k; if that is a jump or the end, the last step before it, or else the first one
/// after it. The number of segments, if none is a step.
std::size_t DenseOutput::step_near(std::size_t k) const {
  const auto is_step = [this](std::size_t s) { return end_[s] != knots_.t[s]; };
  for (std::size_t s = std::min(k + 1, end_.size()); s-- > 0;)
    if (is_step(s)) return s;
  for (std::size_t s = k + 1; s < end_.size(); ++s)
    if (is_step(s)) return s;
  return end_.size();
}

std::optional<Segment> DenseOutput::segment_at(double t, std::size_t& near) const {
  const Buffer<double>& knots = knots_.t;
  near = std::min(near, knots.size() - 1);
  while (near + 1 < knots.size() && knots[near + 1] <= t) ++near;
  while (near > 0 && knots[near] > t) --near;
  const std::size_t s = step_near(near);
  if (s == end_.size()) return {};
  const std::size_t stop = s + 1 < offset_.size() ? offset_[s + 1] : data_.size();
  return Segment{knots[s], end_[s], data_.data() + offset_[s], stop - offset_[s]};
}

void DenseOutput::state(Archive& archive) {
  std::vector<double> t = knots_.t.copy(), y = knots_.y.copy(), data = data_.copy();
  for (std::vector<double>* one : {&t, &y, &end_, &data}) archive.resizable(*one);
  archive.resizable(offset_);
  if (!archive.reading()) return;
  const std::size_t segments = end_.size(), overhead = kind_.overhead();
  archive.require(t.size() == segments + 1 && y.size() == t.size() * n_ && offset_.size() == segments);
  const NamedExtension& extension = find_extension(kind_.raw);
  for (std::size_t s = 0; s < segments; ++s) {
    const std::size_t stop = s + 1 < segments ? offset_[s + 1] : data.size();
    archive.require(std::isfinite(t[s]) && t[s] <= t[s + 1] && t[s] <= end_[s] && offset_[s] <= stop &&
                    stop <= data.size());
    if (end_[s] == t[s]) continue;  // a jump
    archive.require(stop - offset_[s] >= overhead &&
                    extension.fits(data.data() + offset_[s], stop - offset_[s] - overhead, n_));
  }
  archive.require(std::isfinite(t.back()));
  knots_.clear();
  data_.clear();
  knots_.t.append(t.data(), t.size());
  knots_.y.append(y.data(), y.size());
  data_.append(data.data(), data.size());
}

Status DenseOutput::evaluate(const double* t, std::size_t count, double* out, Projector* projector,
                             TangentProjector* tangent) const {
  if (n_ == 0) return Status::ok;
  Interpolant interpolant(kind_, projector, tangent, bounds_ ? &*bounds_ : nullptr);
  const Buffer<double>& knots = knots_.t;
  const double forward = knots.back() >= knots.front() ? 1 : -1;
  for (std::size_t p = 0; p < count; ++p, out += n_) {
    const double* y = knots_.y.data();
    // The last knot at or before t; of two at the same t (a jump) the later.
    const auto after = std::upper_bound(knots.begin(), knots.end(), t[p],
                                        [forward](double a, double b) { return forward * a < forward * b; });
    const std::size_t k = after == knots.begin() ? 0 : static_cast<std::size_t>(after - knots.begin()) - 1;
    const std::size_t s = step_near(k);
    if (knots[k] == t[p] || s == end_.size()) {
      std::copy(y + k * n_, y + (k + 1) * n_, out);
      continue;
    }
    const std::size_t stop = s + 1 < offset_.size() ? offset_[s + 1] : data_.size();
    const Segment segment{knots[s], end_[s], data_.data() + offset_[s], stop - offset_[s]};
    if (interpolant.value(segment, t[p], out) == Status::stop) return Status::stop;
  }
  return Status::ok;
}

}  // namespace invariode
