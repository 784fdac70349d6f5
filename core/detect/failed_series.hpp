#pragma once
// Attempts that fail one after the other: where f may jump (docs/algorithms.md, 'Jumps of f').

#include <cmath>
#include <cstddef>

namespace invariode {

/// The state of a series of failed attempts, apart from the points.
struct SeriesState {
  int count;               // failed attempts
  bool failed;             // the latest attempt
  bool stepped;            // a step was accepted since the first one failed
  double longest, latest;  // |h| of the attempts
  double beyond;           // where the latest one led to
  double latest_t;         // where the latest step began
  double from_t;           // where to look from
};

/// Attempts that fail, with short steps between them, until a step gets past where the latest of them led. `Build`
/// tells translation units apart that are compiled with different flags: they must not share these functions.
template <class Build>
class FailedSeries {
 public:
  /// The number of vectors that the points take.
  static constexpr std::size_t points = 2;

  /// An attempt failed that led to t1 by a step of size h.
  void add(double t1, double h) {
    if (state_.count++ == 0) state_.longest = 0;
    state_.failed = true;
    state_.latest = std::abs(h);
    if (state_.longest < state_.latest) state_.longest = state_.latest;
    state_.beyond = t1;
  }
  [[nodiscard]] bool any() const { return state_.count > 0; }

  /// Returns whether f may jump where a step of size h would pass.
  [[nodiscard]] bool suspicious(double h) const {
    return several <= state_.count && much_longer * std::abs(h) <= state_.longest;
  }

  /// The step from (t0, y0) to t1 was accepted. True: it ends a series so long that f may jump between `from_t`, `from`
  /// and its end. y0 (n,) has that stride; `from` and `latest`, (n,) each, keep what they hold between calls.
  ///
  /// A step may pass over a jump, and what comes after it fails: the way to look at begins with the step before the
  /// attempt that failed last.
  bool accept(double t0, const double* y0, std::size_t stride, std::size_t n, double t1, double* from, double* latest) {
    SeriesState& m = state_;
    const bool past = (t1 - m.beyond) * (t1 - t0) >= 0,
               suspicious = several <= m.count && much_longer * m.latest <= m.longest;
    if (past && !suspicious) return forget();
    if (m.failed) {
      m.from_t = m.stepped ? m.latest_t : t0;
      for (std::size_t i = 0; i < n; ++i) from[i] = m.stepped ? latest[i] : y0[i * stride];
    }
    m.failed = false;
    m.stepped = true;
    m.latest_t = t0;
    for (std::size_t i = 0; i < n; ++i) latest[i] = y0[i * stride];
    if (past) forget();
    return past;
  }
  [[nodiscard]] double from_t() const { return state_.from_t; }
  /// |h| of the attempt that failed last, and of the longest one.
  [[nodiscard]] double latest() const { return state_.latest; }
  [[nodiscard]] double longest() const { return state_.longest; }

  bool forget() {
    state_.count = 0;
    state_.failed = state_.stepped = false;
    return false;
  }
  [[nodiscard]] const SeriesState& state() const { return state_; }
  void go_on(const SeriesState& state) { state_ = state; }

 private:
  // So many attempts, which cut the step so much. Of 770 thousand attempts at smooth problems, by all methods, one in
  // 750 ended such a series; of the jumps at which four attempts or more failed, 99 % did.
  static constexpr int several = 3;
  static constexpr double much_longer = 4;

  SeriesState state_{};
};

}  // namespace invariode
