#pragma once
// The norm in which the correction of a level is smallest (docs/algorithms.md, 'Corrections in levels').

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <cstddef>
#include <memory>
#include <vector>

#include "callback.hpp"

namespace invariode {

/// G in the square δᵀ G δ of a correction: its diagonal, or all of it row-major, of the components that may move.
struct Metric {
  Callback function;           ///< G(t, y), where it is not constant
  std::vector<double> values;  ///< a constant G; otherwise only their number counts

  explicit operator bool() const noexcept { return !values.empty(); }
};

/// G = L Lᵀ at a point. With x = Lᵀδ the square is xᵀx, and the row aᵀ of an equation aᵀδ = r becomes (L⁻¹a)ᵀ.
class MetricFactor {
 public:
  /// `components`: those of the state that G belongs to, in its order.
  MetricFactor(Metric metric, std::vector<std::size_t> components);

  /// Takes G at (t, y).
  Status update(double t, const double* y);
  /// The components of the state marked in `fixed` do not move: their rows and columns of G count as those of the
  /// identity, and their entries of vectors as 0. Null: none.
  void keep(const char* fixed);
  /// Returns whether G is positive definite there.
  [[nodiscard]] bool regular() const { return regular_; }
  [[nodiscard]] bool diagonal() const { return diagonal_.size() > 0; }
  /// x = L⁻¹ a in the components of G; the other entries are left alone.
  void divide(const double* a, double* x);
  /// x ← L⁻ᵀ x in these components.
  void divide_transposed(double* x);

 private:
  void factorize();
  void gather(const double* a);

  Metric metric_;
  std::vector<std::size_t> components_;
  std::vector<char> fixed_;  // of each component
  bool regular_ = false, known_ = false;
  Eigen::VectorXd diagonal_, part_;                      // √G_ii of a diagonal G; entries of a vector
  std::unique_ptr<Eigen::LLT<Eigen::MatrixXd>> factor_;  // of a full G; Eigen's own cannot be moved before it is used
};

}  // namespace invariode
