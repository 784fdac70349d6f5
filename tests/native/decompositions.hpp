#pragma once
// Eigen's decomposition for the references of several tests. It takes long to compile, so that is done once.

#include <Eigen/Core>

namespace invariode::test {

/// A⁺
Eigen::MatrixXd pseudoinverse(const Eigen::MatrixXd& A);
/// A⁺ b: the least squares solution of A x = b that has the smallest norm.
Eigen::VectorXd smallest_solution(const Eigen::MatrixXd& A, const Eigen::VectorXd& b);

}  // namespace invariode::test
