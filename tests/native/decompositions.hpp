#pragma once
// Eigen's decompositions for the references of several tests. They take long to compile, so they are compiled once.

#include <Eigen/Core>

namespace invariode::test {

/// A⁺
Eigen::MatrixXd pseudoinverse(const Eigen::MatrixXd& A);
/// A⁺ b: the least squares solution of A x = b that has the smallest norm.
Eigen::VectorXd smallest_solution(const Eigen::MatrixXd& A, const Eigen::VectorXd& b);
/// A basis of the null space of A, in columns.
Eigen::MatrixXd null_space(const Eigen::MatrixXd& A);
/// In descending order.
Eigen::VectorXd singular_values(const Eigen::MatrixXd& A);

}  // namespace invariode::test
