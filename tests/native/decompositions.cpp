#include "decompositions.hpp"

#include <Eigen/LU>
#include <Eigen/QR>
#include <Eigen/SVD>

namespace invariode::test {

Eigen::MatrixXd pseudoinverse(const Eigen::MatrixXd& A) { return A.completeOrthogonalDecomposition().pseudoInverse(); }

Eigen::VectorXd smallest_solution(const Eigen::MatrixXd& A, const Eigen::VectorXd& b) {
  return A.completeOrthogonalDecomposition().solve(b);
}

Eigen::MatrixXd null_space(const Eigen::MatrixXd& A) { return A.fullPivLu().kernel(); }

Eigen::VectorXd singular_values(const Eigen::MatrixXd& A) { return A.jacobiSvd().singularValues(); }

}  // namespace invariode::test
