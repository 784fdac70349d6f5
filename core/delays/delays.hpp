#pragma once
// Constant delays: the past of the solution, and functions of it (docs/algorithms.md, 'Delays').

#include <cstddef>
#include <deque>
#include <optional>
#include <span>
#include <vector>

#include "archive.hpp"
#include "callback.hpp"
#include "delays/marks.hpp"
#include "linear/matrix.hpp"
#include "output/interpolant.hpp"
#include "output/output.hpp"
#include "sensitivity/variations.hpp"
#include "weights.hpp"

namespace invariode {

/// A constant delay: a number, or one of the parameters that functions read.
struct Lag {
  double value;
  std::optional<std::size_t> parameter;
};

/// The delays τ_j > 0 of a problem y' = f(t, y, z_1, …, z_k), z_j = y(t − τ_j), and y before t0.
struct DelayTerms {
  std::vector<Lag> lags;
  std::vector<double> constant;  ///< the history, (n,), where it is constant;
  Callback history;              ///< or else (t, anything) -> y, (n,), for t < t0;
  bool history_varies = false;   ///< or -> Y, with ∂y/∂p behind it
  std::vector<double> jumps;     ///< of the history, before t0
  std::vector<double> rates;     ///< ∂τ_j/∂p, (lags, k), of a problem with sensitivities to k parameters
};

/// The past of a run, and its delayed functions.
///
/// The past is the history φ before t0, and behind it the continuous solution over the accepted steps, corrected so
/// that it meets their ends, and within bounds. In a step that is longer than a delay, arguments lie beyond the last
/// accepted step, and are taken from a guess of the attempt. The first guess continues the polynomial of the previous
/// step, or the tangent at the start of the run; each further guess is the extension of the previous attempt (`agree`).
///
/// A method whose stages are values of the extension Q gets, for delays that are short beside h,
///
///   z_j = y + (Q(t − τ_j) − Q(t)),
///
/// which is Q(t − τ_j) where the attempt agrees with itself; but ∂z_j/∂y = I, so that Newton's matrix is made of f_y +
/// f_zj, and the repetition converges like τ_j, not like h.
///
/// Sensitivities have a past too: ∂z_j/∂p = S(t − τ_j) − y'(t − τ_j) ∂τ_j/∂p.
class Delays {
 public:
  /// `terms`, the parameters and the bounds belong to the caller and outlive this.
  Delays(const DelayTerms& terms, std::span<const double> parameters, Extent extent, const Bounds* bounds, double t0);
  Delays(const Delays&) = delete;
  Delays& operator=(const Delays&) = delete;

  /// f of (t, (y, z_1, …, z_k)) as a function of (t, y), which refers to this.
  Callback within(const Callback& f);
  /// ∂f/∂y + Σ s_j ∂f/∂z_j of (t, (y, z_1, …, z_k, s_1, …, s_k)), with s_j = ∂z_j/∂y, as a function of (t, y).
  MatrixFunction within(const MatrixFunction& derivative);
  /// The slope of sensitivities, of (t, X) with the rows (y, z_1, …) and (S_i, ∂z_1/∂p_i, …), as a function of (t, Y).
  Callback augmented_within(const Callback& slope);

  [[nodiscard]] const std::vector<double>& lags() const { return lags_; }

  /// Where lag j brings a jump of the derivative of order `level` at t, whose ∂t/∂p is `rates`, (k,), or empty: 0. The
  /// next derivative jumps there; f, where the solution has jumped.
  [[nodiscard]] Mark image(std::size_t j, double t, int level, std::span<const double> rates) const;

  /// (z_1, …, z_k) at t, which is at most the time reached.
  Status values(double t, double* z);
  /// Functions take these values instead of those of the past, until an empty one ends that.
  void hold(std::span<const double> z) { held_ = z; }

  // What the loop does with it.
  /// The run begins at (t0, y), with steps of this kind. `jumps`: y is not what the history is there.
  Status begin(DenseOutput no_steps, const double* y, bool& jumps);
  /// Returns whether `begin` was called: a run that ends before its first step may not get there.
  [[nodiscard]] bool begun() const { return steps_.has_value(); }
  /// The solution goes on at (t, y), where it has jumped.
  void jump(double t, const double* y);
  /// The method starts again: the step before is not continued.
  void restart() { continues_ = false; }
  /// A step begins at (t, y), where the slope is known. `shift`: the stages are values of the extension.
  void begin_step(double t, const double* y, const double* slope, bool shift);
  /// An attempt of that step begins, of size h. The first one is made with a guess of what is ahead.
  void begin_attempt(double h);
  /// Returns whether the attempt has used what lies beyond the point reached.
  [[nodiscard]] bool looked_ahead() const { return looked_ahead_; }
  /// Room for the extension of an attempt, which `agree` takes.
  double* room(std::size_t size);
  /// The extension of the attempt takes the place of what was ahead. Returns the size of the change, in the weights of
  /// the state.
  [[nodiscard]] double agree(std::size_t size, const double* candidate, const Weights& weights);
  /// The step was accepted, and is used up to (t, y).
  void add(const Segment& segment, double t, const double* y);

  void state(Archive& archive);

 private:
  /// The function that stands for the solution beyond the point reached.
  enum class Ahead { constant, tangent, continued, attempt };
  struct Delayed {
    Delayed(Delays& delays_, const Callback& function_) : delays(delays_), function(function_) {}
    Delays& delays;
    Callback function;
  };
  struct DelayedMatrix {
    Delays& delays;
    MatrixFunction function;
  };
  static Status matrix_entry(void* self, double t, const double* y, Matrix& out);
  static Status entry(void* self, double t, const double* y, double* out);
  static Status augmented_entry(void* self, double t, const double* Y, double* out);
  Status arguments(double t, const double* y);
  Status rows(double t, const double* Y);
  Status slope_at(double s, std::size_t& near);
  [[nodiscard]] bool shifts(std::size_t j) const;
  /// ∂τ_j/∂p, (k,); empty: 0.
  [[nodiscard]] std::span<const double> rates(std::size_t j) const {
    return terms_.rates.empty() ? std::span<const double>() : std::span(terms_.rates).subspan(j * extent_.k, extent_.k);
  }
  Status at(double s, std::size_t& near, double* Y);
  Status history(double s, double* Y);
  void ahead(double s, double* Y);
  void forget_before(double t);

  const DelayTerms& terms_;
  Extent extent_;
  const Bounds* bounds_;
  double t0_;
  std::vector<double> lags_;
  double longest_ = 0;
  std::deque<Delayed> functions_;  // which stay where they are when there are more of them
  std::deque<DelayedMatrix> matrices_;

  std::optional<DenseOutput> steps_;
  std::optional<Interpolant> interpolant_;
  std::vector<std::size_t> near_;  // the knot before the last argument of each delay, and that before t
  bool continues_ = false;         // the last segment may be continued

  double t_ = 0, h_ = 0;  // the start of the step, and the size of the attempt
  std::vector<double> y_, slope_;
  bool shift_ = false;
  Ahead ahead_ = Ahead::constant;
  bool looked_ahead_ = false;
  std::vector<double> data_, next_;  // the extension of the attempt
  std::size_t data_size_ = 0;
  std::span<const double> held_;
  std::vector<double> in_;  // y, its delayed values, and their derivatives along y
  std::vector<double> rows_, value_, here_, before_, after_, beside_, rate_;
};

}  // namespace invariode
