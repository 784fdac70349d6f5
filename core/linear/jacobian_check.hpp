#pragma once
// Whether a matrix can be the Jacobian of f (docs/algorithms.md, 'Jacobians').

#include <cstddef>
#include <vector>

#include "callback.hpp"
#include "linear/box.hpp"
#include "linear/matrix.hpp"

namespace invariode {

/// Compares J v with the change of f along v, a direction in which every component moves, for one or two evaluations of
/// f. Entries that are missing or wrong show unless they hardly count beside the others of their row.
class JacobianCheck {
 public:
  explicit JacobianCheck(std::size_t n) : n_(n) {}

  enum class [[nodiscard]] Verdict { right, wrong, stop };
  /// The fit of J to f in a neighbourhood: good enough for Newton's iteration; none, although f is nearly linear
  /// there (`wrong`); or J is much too large, and f far from linear (`bent`), as it is beside a jump.
  enum class [[nodiscard]] Fit { good, wrong, bent, stop };

  /// J at (t, y), where f is `slope`; `reach`: by how much each component may move. `turn` chooses the direction.
  /// Where f is not finite beside y, or beside it is outside of the box, nothing speaks against J.
  Verdict examine(Callback& f, double t, const double* y, const double* slope, const Matrix& J, const double* reach,
                  std::size_t turn, const Box& box = {});
  /// Examines J in the direction in which f leads, in a neighbourhood as wide as `reach`, with the tolerance of
  /// Newton's iteration: only errors that would mislead the iteration count. `scattered`: in a direction with random
  /// signs instead.
  Fit fit(Callback& f, double t, const double* y, const double* slope, const Matrix& J, const double* reach,
          std::size_t turn, const Box& box = {}, bool scattered = false);
  /// The result of the latest `fit`: the direction v; the row in which J v is not the change of f, and both values.
  [[nodiscard]] const std::vector<double>& direction() const { return direction_; }
  [[nodiscard]] std::size_t row() const { return row_; }
  [[nodiscard]] double change() const { return change_[row_]; }
  [[nodiscard]] double predicted() const { return product_[row_]; }
  [[nodiscard]] bool understates() const { return understates(row_); }
  /// Gives memory back if it is large: the result of the latest `fit` is not needed any more.
  void rest();
  /// max_i Σ_j |J_ij| w_j / w_i
  double size(const Matrix& J, const double* w);

 private:
  template <class Sign>
  void aim(const double* y, const Matrix& J, const double* reach, std::size_t turn, const Box& box, Sign sign);
  Status move(Callback& f, double t, const double* y, const double* slope, double side, double* change);
  [[nodiscard]] bool agrees(const double* slope) const;
  [[nodiscard]] bool misleads(std::size_t i, double change, double part, const double* slope) const;
  [[nodiscard]] bool misleads(const double* slope) const;
  [[nodiscard]] bool understates(std::size_t i) const;
  [[nodiscard]] Fit judge(const double* slope);
  [[nodiscard]] double noise(std::size_t i, const double* slope) const;

  std::size_t n_;
  // With room from the first look on:
  std::vector<double> direction_, point_, change_, back_;
  std::vector<double> product_, size_, terms_;  // of each row: Σ J_ij v_j, Σ |J_ij v_j|, Σ |J_ij y_j|,
  std::vector<double> entries_;                 // and how many they are
  std::size_t row_ = 0;
};

}  // namespace invariode
