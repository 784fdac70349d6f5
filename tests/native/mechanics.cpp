// The equations of motion: derivatives by complex steps and differences, accelerations of known motions, sparse factors
// against dense ones.

#include <Eigen/SparseCore>
#include <cmath>
#include <complex>
#include <random>
#include <vector>

#include "check.hpp"
#include "linear/sparse_saddle.hpp"
#include "mechanics/differentiable.hpp"
#include "mechanics/motion.hpp"

namespace invariode::test::mechanics_laws {

namespace {

using Complex = std::complex<double>;

SparseMatrix full(Eigen::Index rows, Eigen::Index columns) { return Eigen::MatrixXd::Ones(rows, columns).sparseView(); }

/// sin(x₀ + t) x₁ − exp(−x₂) and x₁² x₂, real or complex.
template <class Number>
void linkage(Number t, const Number* x, Number* out) {
  out[0] = std::sin(x[0] + t) * x[1] - std::exp(-x[2]);
  out[1] = x[1] * x[1] * x[2];
}

Status real_linkage(void*, double t, const double* x, double* out) {
  linkage<double>(t, x, out);
  return Status::ok;
}

Status complex_linkage(void*, double, const double* z, double* out) {
  const Complex* x = reinterpret_cast<const Complex*>(z);
  linkage<Complex>(x[0], x + 1, reinterpret_cast<Complex*>(out));
  return Status::ok;
}

/// Its derivatives along (dt, dx), of (x, dt, dx).
Status slope_of_linkage(void*, double t, const double* z, double* out) {
  const double *x = z, *dx = z + 4;
  out[0] = std::cos(x[0] + t) * (dx[0] + z[3]) * x[1] + std::sin(x[0] + t) * dx[1] + std::exp(-x[2]) * dx[2];
  out[1] = 2 * x[1] * dx[1] * x[2] + x[1] * x[1] * dx[2];
  return Status::ok;
}

Status curvature_of_linkage(void*, double t, const double* z, double* out) {
  const double *x = z, *dx = z + 4;
  const double turn = dx[0] + z[3];
  out[0] = -std::sin(x[0] + t) * turn * turn * x[1] + 2 * std::cos(x[0] + t) * turn * dx[1] -
           std::exp(-x[2]) * dx[2] * dx[2];
  out[1] = 2 * dx[1] * dx[1] * x[2] + 4 * x[1] * dx[1] * dx[2];
  return Status::ok;
}

Differentiable made_exact() {
  const Differentiable::Forms forms{.function = {&real_linkage, nullptr},
                                    .complex = {},
                                    .quiet = {},
                                    .slope = {&slope_of_linkage, nullptr},
                                    .curvature = {&curvature_of_linkage, nullptr}};
  return {forms, 3, 2};
}

Differentiable made(bool by_complex_steps) {
  Differentiable::Forms forms{
      .function = {&real_linkage, nullptr}, .complex = {}, .quiet = {}, .slope = {}, .curvature = {}};
  if (by_complex_steps) forms.complex = forms.quiet = {&complex_linkage, nullptr};
  return {forms, 3, 2};
}

/// A chain of links of length 1 between unit masses in the plane, hung up at the origin: φ and its complex form.
template <class Number>
void lengths(std::size_t links, const Number* q, Number* out) {
  Number x = 0, y = 0;
  for (std::size_t i = 0; i < links; ++i) {
    const Number dx = q[2 * i] - x, dy = q[2 * i + 1] - y;
    out[i] = dx * dx + dy * dy - 1.0;
    x = q[2 * i], y = q[2 * i + 1];
  }
}

Status real_lengths(void* links, double, const double* q, double* out) {
  lengths(*static_cast<std::size_t*>(links), q, out);
  return Status::ok;
}

Status complex_lengths(void* links, double, const double* z, double* out) {
  lengths(*static_cast<std::size_t*>(links), reinterpret_cast<const Complex*>(z) + 1, reinterpret_cast<Complex*>(out));
  return Status::ok;
}

Status weight(void* links, double, const double*, double* out) {
  for (std::size_t i = 0; i < *static_cast<std::size_t*>(links); ++i) out[2 * i] = 0, out[2 * i + 1] = -1;
  return Status::ok;
}

SparseMatrix neighbours(std::size_t links) {
  SparseMatrix pattern(static_cast<Eigen::Index>(links), static_cast<Eigen::Index>(2 * links));
  for (int i = 0; i < pattern.rows(); ++i)
    for (int j = std::max(0, 2 * i - 2); j < 2 * i + 2; ++j) pattern.insert(i, j) = 1;
  return pattern;
}

MotionTerms chain(std::size_t& links, const SparseMatrix& pattern) {
  const auto n = static_cast<Eigen::Index>(2 * links);
  MotionTerms terms;
  terms.n_q = terms.n_v = 2 * links;
  terms.mass.matrix.resize(n, n);
  terms.mass.matrix.setIdentity();
  terms.force = {&weight, &links};
  const Callback complex(&complex_lengths, &links);
  terms.constraints = {{.function = {&real_lengths, &links}, .complex = complex, .quiet = complex}, 2 * links, links};
  terms.phi_pattern = pattern;
  terms.psi_pattern.resize(0, 2 * n);
  terms.kept.assign(links, 1);
  terms.dependent = 1e-10;
  return terms;
}

/// A consistent state of the chain: links at random angles, turning at random rates.
std::vector<double> state(std::size_t links, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> normal;
  std::vector<double> y(4 * links);
  double at[4] = {0, 0, 0, 0};
  for (std::size_t i = 0; i < links; ++i) {
    const double angle = normal(random), rate = normal(random);
    at[0] += std::cos(angle), at[1] += std::sin(angle);
    at[2] -= rate * std::sin(angle), at[3] += rate * std::cos(angle);
    for (std::size_t k = 0; k < 2; ++k) y[2 * i + k] = at[k], y[2 * (links + i) + k] = at[2 + k];
  }
  return y;
}

}  // namespace

TEST(derivatives_are_as_good_as_their_kind) {
  const double t = 0.3, x[3] = {0.7, -1.2, 0.4}, dx[3] = {0.5, 2.0, -1.0};
  const double c = std::cos(x[0] + t), s = std::sin(x[0] + t), e = std::exp(-x[2]), turn = dx[0] + 1;
  const double slope[2] = {c * turn * x[1] + s * dx[1] + e * dx[2], 2 * x[1] * dx[1] * x[2] + x[1] * x[1] * dx[2]};
  const double curvature[2] = {-s * turn * turn * x[1] + 2 * c * turn * dx[1] - e * dx[2] * dx[2],
                               2 * dx[1] * dx[1] * x[2] + 4 * x[1] * dx[1] * dx[2]};
  for (const bool complex : {true, false}) {
    const check::Case label(complex ? "complex steps" : "differences");
    Differentiable function = made(complex);
    double first[2], second[2];
    CHECK(function.slope(t, x, 1, dx, first) == Status::ok);
    CHECK(function.curvature(t, x, 1, dx, second) == Status::ok);
    for (int i = 0; i < 2; ++i) {
      CHECK_CLOSE(first[i], slope[i], complex ? 1e-15 : 1e-10);
      CHECK_CLOSE(second[i], curvature[i], complex ? 1e-10 : 1e-6);
    }
  }
  Differentiable exact = made_exact();
  double first[2], second[2];
  CHECK(exact.slope(t, x, 1, dx, first) == Status::ok);
  CHECK(exact.curvature(t, x, 1, dx, second) == Status::ok);
  for (int i = 0; i < 2; ++i) {
    CHECK_CLOSE(first[i], slope[i], 1e-15);
    CHECK_CLOSE(second[i], curvature[i], 1e-15);
  }
  CHECK(exact.relative_error() == 0);
}

TEST(columns_without_a_common_row_cost_one_evaluation) {
  std::size_t links = 50;
  SparseColumns columns(neighbours(links), 0);
  CHECK(columns.groups.size() == 4);
  Motion motion(chain(links, neighbours(links)));
  const std::vector<double> y = state(links, 1);
  CHECK(motion.rows(0, y.data()) == Status::ok);
  CHECK(motion.work().constraints <= 4 + 2 * 31);
  Motion other(chain(links, full(50, 100)));
  CHECK(other.rows(0, y.data()) == Status::ok);
  CHECK_CLOSE((Eigen::MatrixXd(motion.A()) - Eigen::MatrixXd(other.A())).norm(), 0, 1e-14);
}

TEST(sparse_and_dense_factors_give_the_same_accelerations) {
  for (unsigned seed = 0; seed < 20; ++seed) {
    const check::Case label("seed ", seed);
    std::size_t links = 40;
    Motion sparse(chain(links, neighbours(links))), dense(chain(links, full(40, 80)));
    CHECK(sparse.sparse() && !dense.sparse());
    const std::vector<double> y = state(links, seed);
    ConstrainedSolution a, b;
    CHECK(sparse.accelerations(0, y.data(), a) == Status::ok);
    CHECK(dense.accelerations(0, y.data(), b) == Status::ok);
    CHECK(sparse.work().dense == 0 && sparse.work().sparse == 1);
    CHECK_CLOSE((a.a - b.a).norm() / b.a.norm(), 0, 1e-10);
    CHECK_CLOSE((a.lambda - b.lambda).norm() / b.lambda.norm(), 0, 1e-10);
  }
}

TEST(a_pendulum_feels_the_pull_of_its_rod) {
  std::size_t links = 1;
  Motion motion(chain(links, full(1, 2)));
  const double angle = 0.4, rate = 1.3;
  const double y[4] = {std::cos(angle), std::sin(angle), -rate * std::sin(angle), rate * std::cos(angle)};
  double out[4];
  CHECK(motion.callback(Motion::Part::slope)(0, y, out) == Status::ok);
  const double turning = -std::cos(angle);  // of the angle, under gravity 1
  CHECK_CLOSE(out[2], -rate * rate * y[0] - turning * y[1], 1e-11);
  CHECK_CLOSE(out[3], -rate * rate * y[1] + turning * y[0], 1e-11);
}

TEST(the_jacobian_of_the_rates_is_their_derivative) {
  std::size_t links = 3;
  Motion motion(chain(links, full(3, 6)));
  const std::vector<double> y = state(links, 5);
  std::vector<double> J(3 * 12), plus(3), minus(3);
  CHECK(motion.callback(Motion::Part::rates_jacobian)(0, y.data(), J.data()) == Status::ok);
  constexpr double h = 1e-5;
  for (std::size_t j = 0; j < y.size(); ++j) {
    std::vector<double> up = y, down = y;
    up[j] += h, down[j] -= h;
    CHECK(motion.callback(Motion::Part::rates)(0, up.data(), plus.data()) == Status::ok);
    CHECK(motion.callback(Motion::Part::rates)(0, down.data(), minus.data()) == Status::ok);
    for (std::size_t i = 0; i < 3; ++i) CHECK_CLOSE(J[i * 12 + j], (plus[i] - minus[i]) / (2 * h), 1e-8);
  }
}

TEST(an_undefined_force_gives_undefined_accelerations) {
  std::size_t links = 1;
  MotionTerms terms = chain(links, full(1, 2));
  terms.force = {[](void*, double, const double*, double* out) {
                   out[0] = out[1] = std::nan("");
                   return Status::ok;
                 },
                 nullptr};
  Motion motion(std::move(terms));
  const double y[4] = {1, 0, 0, 0};
  double out[4];
  CHECK(motion.callback(Motion::Part::slope)(0, y, out) == Status::ok);
  CHECK(std::isnan(out[2]) && std::isnan(out[3]));
}

TEST(sparse_masses_that_are_not_diagonal_are_factored_with_the_constraints) {
  std::mt19937 random(3);
  std::normal_distribution<double> normal;
  constexpr int n = 60, k = 20;
  SparseMatrix M(n, n), A(k, n);
  for (int i = 0; i < n; ++i) {
    M.insert(i, i) = i % 7 == 0 ? 0.0 : 4.0;  // some masses only where the constraints do not leave them free
    if (i + 1 < n) M.insert(i, i + 1) = i % 7 == 0 || (i + 1) % 7 == 0 ? 0.0 : 1.0;
    if (i > 0) M.insert(i, i - 1) = i % 7 == 0 || (i - 1) % 7 == 0 ? 0.0 : 1.0;
  }
  for (int i = 0; i < k; ++i)
    for (int j = 0; j < 7; ++j)
      if (3 * i + j < n) A.insert(i, 3 * i + j) = normal(random);
  Eigen::VectorXd Q(n), gamma(k);
  for (double& q : Q) q = normal(random);
  for (double& g : gamma) g = normal(random);
  SparseSaddle saddle;
  ConstrainedSolution found;
  for (int pass = 0; pass < 2; ++pass) {  // the pattern is known in the second
    CHECK(saddle.solve(M, A, Q, gamma, found));
    CHECK_CLOSE((M * found.a - Q - A.transpose() * found.lambda).norm(), 0, 1e-10 * found.a.norm());
    CHECK_CLOSE((A * found.a - gamma).norm(), 0, 1e-10 * found.a.norm());
  }
}

TEST(rows_that_depend_on_others_are_not_for_sparse_factors) {
  constexpr int n = 30;
  SparseMatrix M(n, n), A(2, n);
  M.setIdentity();
  for (int j = 0; j < 4; ++j) A.insert(0, j) = 1 + j, A.insert(1, j) = 2 * (1 + j);
  SparseSaddle saddle;
  ConstrainedSolution found;
  CHECK(!saddle.solve(M, A, Eigen::VectorXd::Ones(n), Eigen::VectorXd::Ones(2), found));
}

}  // namespace invariode::test::mechanics_laws
