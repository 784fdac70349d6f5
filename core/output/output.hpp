#pragma once
// What a run keeps: points, the record of its steps, the continuous solution.

#include <cassert>
#include <cstddef>
#include <optional>
#include <utility>
#include <vector>

#include "archive.hpp"
#include "buffer.hpp"
#include "output/interpolant.hpp"

namespace invariode {

/// Points (t, y), one after the other.
struct Trajectory {
  Buffer<double> t;
  Buffer<double> y;

  void add(double at, const double* point, std::size_t n) {
    t.push_back(at);
    y.append(point, n);
  }
  [[nodiscard]] std::size_t bytes() const { return (t.size() + y.size()) * sizeof(double); }
  /// A copy of the points from number `first` on.
  [[nodiscard]] Trajectory from(std::size_t first, std::size_t n) const {
    assert(first <= t.size() && y.size() == t.size() * n);
    Trajectory rest;
    rest.t.append(t.data() + first, t.size() - first);
    rest.y.append(y.data() + first * n, y.size() - first * n);
    return rest;
  }
  void clear() {
    t.clear();
    y.clear();
  }
};

/// An accepted step: where it ended, its signed size, order, error and correction, both in units of rtol, and which
/// member of the method made it, where it has several.
struct AcceptedStep {
  double t, h, order, error, correction, member;
};

/// A jump of the solution: the first row of the output after it, and the values of the invariants from there on.
struct Jump {
  std::size_t row;
  double t;
  std::vector<double> value;
};

/// The solution as a continuous function: the segments of all accepted steps, and the stored values at their ends.
class DenseOutput {
 public:
  DenseOutput(const SegmentKind& kind, std::optional<Bounds> bounds)
      : kind_(kind), n_(kind.extent.size()), bounds_(std::move(bounds)) {}

  /// Starts at (t, y), or goes on there after a jump.
  void start(double t, const double* y);
  /// Adds a step whose segment ends at segment.t1, used up to (t, y).
  void add(const Segment& segment, double t, const double* y);
  /// Continues with all of `next`, which is of the same kind and starts at the last knot.
  void append(const DenseOutput& next) { append(next, 0); }
  /// The part from knot number `first` on, as a separate function.
  [[nodiscard]] DenseOutput from(std::size_t first) const;

  [[nodiscard]] const SegmentKind& kind() const { return kind_; }
  [[nodiscard]] std::size_t size() const { return n_; }  ///< doubles of a value
  [[nodiscard]] const Buffer<double>& knots() const { return knots_.t; }

  /// The segment of the step in which t lies, or the nearest one, of a function that goes forward in t. `near`: the
  /// knot from which it is looked for, and then the one before t. Nothing: no segment is a step.
  [[nodiscard]] std::optional<Segment> segment_at(double t, std::size_t& near) const;
  /// All of it, of a function of the same kind.
  void state(Archive& archive);

  [[nodiscard]] std::size_t bytes() const {
    return knots_.bytes() + data_.size() * sizeof(double) + end_.size() * (sizeof(double) + sizeof(std::size_t));
  }
  /// The most doubles that a step and a jump at its end add to that, besides the data of the segment.
  static std::size_t most_of_step(std::size_t n) {
    static_assert(sizeof(std::size_t) <= sizeof(double));
    constexpr std::size_t segments = 2;
    return segments * ((n + 1) + 2);  // a knot, the end and the offset
  }

  /// Its parts, for storing: given to `start` and `add`, they make the same function again.
  struct Parts {
    const std::optional<Bounds>& bounds;
    const Trajectory& knots;
    const std::vector<double>& end;          ///< segment s is from knot s to knot s + 1, empty at a jump; its t1
    const std::vector<std::size_t>& offset;  ///< where its data starts
    const Buffer<double>& data;
  };
  [[nodiscard]] Parts parts() const { return {bounds_, knots_, end_, offset_, data_}; }

  /// Y at `count` times into out (count, size): the stored value at a knot, else the segment's; before the first and
  /// after the last knot their segments are extrapolated. Where the mode projects, `projector` and `tangent` do it;
  /// without them the values are corrected only.
  Status evaluate(const double* t, std::size_t count, double* out, Projector* projector,
                  TangentProjector* tangent = nullptr) const;

 private:
  [[nodiscard]] std::size_t step_near(std::size_t k) const;
  void append(const DenseOutput& next, std::size_t first);

  SegmentKind kind_;
  std::size_t n_;  // doubles of Y
  std::optional<Bounds> bounds_;
  Trajectory knots_;
  std::vector<double> end_;          // t1 of each segment
  std::vector<std::size_t> offset_;  // of its data
  Buffer<double> data_;
};

/// The results of a run that grow with its steps.
struct Output {
  Trajectory points;
  std::vector<Trajectory> occurrences;  ///< of each event
  Buffer<AcceptedStep> steps;
  std::optional<DenseOutput> dense;
  std::vector<Jump> jumps;
};

}  // namespace invariode
