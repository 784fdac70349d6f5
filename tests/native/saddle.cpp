// The linear system of constrained mechanics: accelerations and multipliers, with redundant rows and singular masses.

#include "linear/saddle.hpp"

#include <Eigen/Core>
#include <random>

#include "check.hpp"
#include "decompositions.hpp"

namespace invariode::test::saddle_laws {

namespace {

using Matrix = Eigen::MatrixXd;
using Vector = Eigen::VectorXd;

constexpr double threshold = 1e-10;
constexpr double conditioned = 1e-10;  // condition numbers of the samples are below 1e5

struct Sample {
  Sample(int n, int k, unsigned seed) : random(seed), A(draw(k, n)), Q(draw(n, 1)), gamma(draw(k, 1)) {
    const Matrix B = draw(n, n);
    M = B * B.transpose() + 0.1 * Matrix::Identity(n, n);
  }
  Matrix draw(int rows, int columns) {
    std::normal_distribution<double> normal;
    return Matrix::NullaryExpr(rows, columns, [&] { return normal(random); });
  }
  [[nodiscard]] ConstrainedSolution solve() const { return solve_saddle(M, A, Q, gamma, threshold); }
  /// The equations hold.
  void check(const ConstrainedSolution& found) const {
    CHECK(found.unique);
    CHECK_CLOSE((M * found.a - Q - A.transpose() * found.lambda).norm(), 0, conditioned * (1 + Q.norm()));
    CHECK_CLOSE((A * found.a - gamma).norm(), 0, conditioned * (1 + gamma.norm()));
  }

  std::mt19937 random;
  Matrix A, M;
  Vector Q, gamma;
};

template <class Check>
void for_samples(Check check_sample) {
  for (unsigned seed = 0; seed < 40; ++seed) {
    const check::Case label("seed ", seed);
    check_sample(Sample(6, 4, seed));
  }
}

}  // namespace

TEST(both_equations_hold) {
  for_samples([](const Sample& s) {
    const ConstrainedSolution found = s.solve();
    CHECK(found.rank == 4);
    s.check(found);
  });
}

TEST(units_of_the_constraints_scale_the_multipliers_and_nothing_else) {
  for_samples([](const Sample& s) {
    Sample other = s;
    const Vector units = (Vector(4) << 1e8, 1, 1, 1e-8).finished();
    other.A = units.asDiagonal() * s.A;
    other.gamma = units.cwiseProduct(s.gamma);
    const ConstrainedSolution found = s.solve(), scaled = other.solve();
    CHECK(scaled.rank == 4);
    CHECK_CLOSE((found.a - scaled.a).norm(), 0, conditioned * found.a.norm());
    CHECK_CLOSE((found.lambda - units.cwiseProduct(scaled.lambda)).norm(), 0, conditioned * (1 + found.lambda.norm()));
  });
}

TEST(of_redundant_constraints_the_multipliers_have_least_norm) {
  for_samples([](const Sample& s) {
    Sample twice = s;
    twice.A.row(3) = s.A.row(0) + s.A.row(1);
    twice.gamma[3] = s.gamma[0] + s.gamma[1];
    const ConstrainedSolution found = twice.solve();
    CHECK(found.rank == 3);
    twice.check(found);
    const Vector null = (Vector(4) << 1, 1, 0, -1).finished();  // Aᵀ null = 0
    CHECK_CLOSE(found.lambda.dot(null), 0, conditioned * (1 + found.lambda.norm()));
  });
}

TEST(a_mass_need_be_definite_only_where_the_constraints_allow_motion) {
  for_samples([](const Sample& s) {
    Sample massless = s;  // no mass in the directions of the first two rows
    const Matrix rows = s.A.topRows(2);
    const Matrix P = Matrix::Identity(6, 6) - test::pseudoinverse(rows) * rows;
    massless.M = P * s.M * P;
    massless.check(massless.solve());
  });
}

TEST(a_motion_without_mass_is_not_determined) {
  for_samples([](const Sample& s) {
    Sample massless = s;
    const Matrix free = (Matrix::Identity(6, 6) - test::pseudoinverse(s.A) * s.A).col(0).normalized();
    const Matrix P = Matrix::Identity(6, 6) - free * free.transpose();
    massless.M = P * s.M * P;
    const ConstrainedSolution found = massless.solve();
    CHECK(!found.unique);
    CHECK(found.a.array().isNaN().all());
    massless.A = Matrix(0, 6);
    massless.gamma = Vector(0);
    CHECK(!massless.solve().unique);
  });
}

TEST(without_constraints_it_is_newtons_law) {
  for_samples([](const Sample& s) {
    Sample free = s;
    free.A = Matrix(0, 6);
    free.gamma = Vector(0);
    free.check(free.solve());
  });
}

TEST(a_system_without_any_freedom_follows_its_constraints) {
  Sample tied(4, 4, 1);
  tied.check(tied.solve());
  tied.M.setZero();
  tied.check(tied.solve());
}

}  // namespace invariode::test::saddle_laws
