#pragma once
// The Jacobian of f: a constant matrix, a user function, or differences (docs/algorithms.md, 'Jacobians').

#include <cstddef>
#include <cstdint>
#include <vector>

#include "callback.hpp"
#include "linear/matrix.hpp"
#include "weights.hpp"

namespace invariode {

/// ∂f/∂y in the structure of a given matrix.
///
/// Differences are adaptive (Salane, 1986): each column's increment is remembered as a factor of the component's size,
/// raised where the change of f drowned in roundoff and lowered where it was large. Columns that share no row are
/// differenced together (Curtis, Powell and Reid, 1974).
class Jacobian {
 public:
  /// Of `products` there is no matrix (linear/matrix_free.hpp): its entries are none.
  enum class Kind { constant, function, differences, products };

  /// `matrix`: the values of a constant one, else the structure. `function` is needed for that kind only. A copy keeps
  /// increments of its own.
  Jacobian(Kind kind, Matrix matrix, MatrixFunction function, const Weights& weights);

  /// Evaluates it at (t, y). `slope` = f(t, y), wanted by differences, which call `f` for the rest. The matrix may
  /// come out not finite.
  Status evaluate(Callback& f, double t, const double* y, const double* slope);

  [[nodiscard]] const Matrix& matrix() const { return matrix_; }
  /// Its values are there from now on, zeros until it is evaluated.
  void provide() { matrix_.provide(); }
  [[nodiscard]] Kind kind() const { return kind_; }
  /// Of columns, for differences: so many evaluations of f it takes.
  [[nodiscard]] std::size_t groups() const { return groups_.size(); }
  /// Evaluations so far, each of which may be several of f.
  [[nodiscard]] std::int64_t count() const { return count_; }
  /// How much of it is roundoff of f, a norm in the weights; of c J it is |c| times that. Always 0 but for differences.
  [[nodiscard]] double noise() const { return noise_; }
  /// From the next evaluation on, increments are large enough to stand above the roundoff of f.
  void widen_increments();
  /// Counts and increments; `matrix_state`: the matrix.
  void state(Archive& archive) { archive(count_, noise_, factor_); }
  void matrix_state(Archive& archive);

 private:
  struct Column {
    double increment;
    double change;  // largest |Δf_i|
    double size;    // max(|f_i|, |f_i + Δf_i|) in that row
  };

  void group_columns();
  void measure_noise(const double* y, const double* slope);
  Status difference(Callback& f, double t, const double* y, const double* slope);
  Status difference_group(Callback& f, double t, const double* y, const double* slope,
                          const std::vector<std::size_t>& columns, bool again = false);
  [[nodiscard]] double increment(std::size_t j, const double* y, double slope, double factor, bool again) const;
  template <class Visit>
  void for_each_in_column(std::size_t j, Visit&& visit);

  Kind kind_;
  Matrix matrix_;
  MatrixFunction function_;
  const Weights& weights_;
  std::int64_t count_ = 0;
  double noise_ = 0;
  std::vector<std::vector<std::size_t>> groups_;  // of columns
  std::vector<double> factor_;                    // of the columns
  std::vector<Column> columns_;
  std::vector<std::size_t> doubtful_;  // columns of a group whose change was roundoff
  std::vector<double> point_, moved_;
};

}  // namespace invariode
