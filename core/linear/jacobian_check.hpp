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
  explicit JacobianCheck(std::size_t n)
      : direction_(n), point_(n), change_(n), back_(n), product_(n), size_(n), terms_(n), entries_(n) {}

  enum class [[nodiscard]] Verdict { right, wrong, stop };

  /// J at (t, y), where f is `slope`; `reach`: by how much each component may move. `turn` chooses the direction.
  /// Where f is not finite beside y, or beside it is outside of the box, nothing speaks against J.
  Verdict examine(Callback& f, double t, const double* y, const double* slope, const Matrix& J, const double* reach,
                  std::size_t turn, const Box& box = {});

 private:
  Status move(Callback& f, double t, const double* y, const double* slope, double side, double* change);
  [[nodiscard]] bool agrees(const double* slope) const;

  std::vector<double> direction_, point_, change_, back_;
  std::vector<double> product_, size_, terms_;  // of each row: Σ J_ij v_j, Σ |J_ij v_j|, Σ |J_ij y_j|,
  std::vector<double> entries_;                 // and how many they are
};

}  // namespace invariode
