#pragma once
// The solution between the ends of accepted steps in all lanes at once: the raw extension of the pair, corrected at the
// ends (output/interpolant.hpp), in the order of their operations. (INVARIODE_LANES: see pack.hpp.)

#include <cstddef>
#include <utility>

#include "run/lanes/lanes.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

/// The step that lanes have made: from (t0, y0) to (t1, y1), with parameters p.
template <int W>
struct LaneStep {
  Pack<W> t0, t1;
  const Pack<W>*y0, *y1, *p;
};

/// What the extension of a pair is made of: its weights B (stages, degree).
struct Extension {
  std::size_t stages, degree;
  const double* weights;
};

template <int W>
class Between {
  using P = Pack<W>;

 public:
  static std::size_t memory(const Job& job, const Extension& extension) {
    return job.looks_inside() ? (extension.degree + 1) * job.n : 0;
  }
  Between(const Job& job, const Extension& extension, P* memory)
      : job_(job),
        extension_(extension),
        coefficients_(memory),
        lack_(memory + extension.degree * (job.looks_inside() ? job.n : 0)) {}

  /// Takes the steps of signed size h with the slopes k. (They are those of `LaneStep` until the next attempt.)
  template <class Slopes>
  void take(const LaneStep<W>& step, const P& h, const Slopes& k) {
    const std::size_t n = job_.n;
    y0_ = step.y0;
    for (std::size_t d = 0; d < extension_.degree; ++d)
      for (std::size_t i = 0; i < n; ++i) {
        P sum(0);
        for (std::size_t j = 0; j < extension_.stages; ++j)
          if (const double w = extension_.weights[j * extension_.degree + d]; w != 0) sum += w * k[j][i];
        coefficients_[d * n + i] = h * sum;
      }
    if (!job_.corrects) return;
    raw(P(1), lack_);
    for (std::size_t i = 0; i < n; ++i) lack_[i] = step.y1[i] - lack_[i];
  }

  /// The value at θ, not projected. (At the start the extension has the value of the step: nothing is to be corrected.)
  void corrected(const P& theta, P* out) const {
    raw(theta, out);
    if (!job_.corrects) return;
    const P at1 = theta * theta * (P(3) - 2 * theta);
    for (std::size_t i = 0; i < job_.n; ++i) out[i] += lack_[i] * at1;
  }

 private:
  /// c₀ + θ (c₁ + (1−θ) (c₂ + θ (c₃ + …))), c₀ the value at the start
  void raw(const P& theta, P* out) const {
    const std::size_t n = job_.n;
    const P* c = coefficients_ + (extension_.degree - 1) * n;
    for (std::size_t i = 0; i < n; ++i) out[i] = c[i];
    for (std::size_t j = extension_.degree; j-- > 0;) {
      const P factor = j % 2 == 1 ? P(1) - theta : theta;
      c = j > 0 ? coefficients_ + (j - 1) * n : y0_;
      for (std::size_t i = 0; i < n; ++i) out[i] = c[i] + factor * out[i];
    }
  }

  const Job& job_;
  const Extension& extension_;
  P *coefficients_, *lack_;
  const P* y0_ = nullptr;
};

}  // namespace invariode::lanes::INVARIODE_LANES
