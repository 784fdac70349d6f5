#include "decompositions.hpp"

#include <Eigen/QR>

namespace invariode::test {
namespace {

Eigen::MatrixXd solved(const Eigen::MatrixXd& A, const Eigen::MatrixXd& B) {
  return A.completeOrthogonalDecomposition().solve(B);
}

}  // namespace

Eigen::MatrixXd pseudoinverse(const Eigen::MatrixXd& A) {
  return solved(A, Eigen::MatrixXd::Identity(A.rows(), A.rows()));
}

Eigen::VectorXd smallest_solution(const Eigen::MatrixXd& A, const Eigen::VectorXd& b) { return solved(A, b); }

}  // namespace invariode::test
