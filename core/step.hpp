#pragma once
// The step contract: five operations that every method obeys, so that the loop, the projection, the events and the
// output exist once. What else a method can say stands in step_report, implicit_interface and composite_interface.

#include <cassert>
#include <cmath>
#include <cstddef>
#include <limits>
#include <span>
#include <vector>

#include "archive.hpp"
#include "callback.hpp"
#include "step_report.hpp"
#include "weights.hpp"

namespace invariode {

class CompositeInterface;

/// Why an attempt was rejected.
/// `bounds`: the candidate is outside of them. `spacing`: none was made; f changes within less than the spacing of t.
/// `overlap`: it does not agree with its own delayed values.
enum class Cause { error, newton, projection, not_finite, bounds, spacing, overlap };

/// Evaluates the raw continuous extension that `Step::extension` wrote to `data`, at some θ ∈ [0, 1], into out
/// (count of θ, n). A plain function of the data alone, so that a step can be interpolated long after the method has
/// moved on. What it gives at one θ does not depend on the others.
using Interpolate = void (*)(const double* data, std::size_t size, std::size_t n, std::span<const double> theta,
                             double* out);

/// One that evaluates at one θ after the other.
template <void (*at)(const double* data, std::size_t size, std::size_t n, double theta, double* out)>
void in_turn(const double* data, std::size_t size, std::size_t n, std::span<const double> theta, double* out) {
  for (const double one : theta) {
    at(data, size, n, one, out);
    out += n;
  }
}

/// One attempted or accepted step of a method, and the method's memory.
///
/// Between calls, (t, y) is the point reached: `attempt` proposes from it, `accept` alone moves it. A rejected attempt
/// leaves no trace in (t, y) and the stored data; only the controller learns from it. An accepted step stays
/// interpolable until the next attempt. Steps know nothing of invariants: `accept` receives the value to commit.
class Step : public StepReport, public Archived {
 public:
  /// The limits of the first step.
  struct Span {
    double tf;
    double hmax;
    double hmin;
  };

  /// A proposal: the candidate y* at t1 and its error in the norm of the error test (NaN or infinite if f was), unless
  /// the iteration for an implicit formula did not converge.
  struct Attempt {
    Outcome outcome;
    double error;
    const double* y;
    bool converged = true;
  };

  Step(Callback& f, const Weights& weights) : f_(f), weights_(weights), y_(weights.size()) {}
  Step(const Step&) = delete;
  Step& operator=(const Step&) = delete;
  virtual ~Step() = default;

  /// Builds the memory at (t, y), also after a jump: evaluates f there and chooses the first |h|.
  virtual Outcome start(double t, const double* y, const Span& span) = 0;

  /// Proposes a step of signed size h that ends at t1: fl(t + h), or the end of the interval, assigned exactly. Where f
  /// has changed it may be called again with the same h and t1, before anything else but `extension_of_attempt`.
  virtual Attempt attempt(double h, double t1) = 0;

  /// The attempt, which has passed the error test, with the larger one of its error and of that of its continuous
  /// extension, by which the controller goes from then on. Where the extension is as accurate as the step, the attempt.
  virtual Attempt inspect_extension(const Attempt& attempt) { return attempt; }

  /// The number of parts of the interval of a run in each of which the method sees f at least once; 0: as its steps
  /// happen to be. A step that is longer than such a part is inspected inside.
  [[nodiscard]] virtual double parts_seen() const { return 0; }

  /// The attempt, which has passed the error test, with the larger one of its error and of that which f shows inside
  /// the step, evaluated there so that no two neighbouring times at which the attempt has seen f are farther apart than
  /// `gap`.
  virtual Attempt inspect_inside(const Attempt& attempt, double /*gap*/) { return attempt; }

  /// The trust in the error estimate of an attempt that has passed the test, where f may jump: always; not
  /// where attempts have failed at the place before; not at all, since the slopes do not look like those of a smooth f.
  enum class Trust { always, unless_suspicious, never };
  [[nodiscard]] virtual Trust trust() const { return Trust::always; }

  /// Chooses the |h| (order, repairs) of the retry. False: at |h| <= hmin there is nothing left to try.
  virtual bool reject(Cause cause, double hmin) = 0;

  /// Evaluates what is left to evaluate at y1 (the candidate, projected where invariants are imposed), then commits
  /// (t1, y1) and chooses the next |h| and order. If the outcome is not `ok`, nothing was committed.
  virtual Outcome accept(const double* y1) = 0;
  /// There will be no further attempt: memory that only attempts need may be given back. The point reached, the slope
  /// there and `state` remain.
  virtual void end_attempts() {}
  /// The size of the first step is what a run that ended at the start has found: this is no start at rest, beside
  /// which methods look at f.
  virtual void trust_first_step() {}

  /// The method as one that consists of several; null: it is one.
  [[nodiscard]] virtual CompositeInterface* composite() { return nullptr; }

  /// Raw continuous extension of the step just accepted: its evaluator, the doubles that it reads, and how many they
  /// are, in this step and at most. `extension` may evaluate f, and is called once per step, if at all.
  [[nodiscard]] virtual Interpolate interpolate() const = 0;
  virtual Status extension(double* data) = 0;
  [[nodiscard]] virtual std::size_t extension_size() const = 0;
  [[nodiscard]] virtual std::size_t max_extension_size() const { return extension_size(); }
  /// The extension of the attempt just made, whose candidate is not committed, and its number of doubles. It may
  /// evaluate f. Methods that take neither bounds nor delays have none.
  virtual Status extension_of_attempt(double* /*data*/, std::size_t& size) {
    size = 0;
    return Status::ok;
  }
  /// Returns whether these doubles are the coefficients of θ^0 … θ^degree, (degree + 1, n).
  [[nodiscard]] virtual bool extends_by_powers() const { return false; }
  /// Its degree, in this step and at most: the most roots that a linear event function has inside a step.
  [[nodiscard]] virtual int degree() const = 0;
  [[nodiscard]] virtual int max_degree() const { return degree(); }

  /// The memory between two steps: all that the next `attempt` and those after it read. Methods archive this part and
  /// then their own.
  void state(Archive& archive) override {
    archive(t_, y_, h_, moved_onto_bounds_);
    archive.require(std::isfinite(t_) && h_ >= 0);
  }

  [[nodiscard]] std::size_t n() const { return y_.size(); }
  [[nodiscard]] double t() const { return t_; }
  [[nodiscard]] const double* y() const { return y_.data(); }
  /// |h| proposed for the next attempt.
  [[nodiscard]] double h() const { return h_; }
  void set_h(double h) {
    assert(h > 0);
    h_ = h;
  }
  /// The candidate about to be accepted was moved onto bounds: what rounding has dropped from it is not carried on.
  void moved_onto_bounds(bool moved) { moved_onto_bounds_ = moved; }

 protected:
  Callback& f_;
  const Weights& weights_;
  double t_ = 0;
  std::vector<double> y_;
  double h_ = 0;
  bool moved_onto_bounds_ = false;
};

}  // namespace invariode
