// LU factors in each structure, difference Jacobians, mass matrices and algebraic equations.

#include <Eigen/Core>
#include <cmath>
#include <complex>
#include <limits>
#include <random>
#include <type_traits>

#include "check.hpp"
#include "linear/dense_lu.hpp"
#include "linear/elimination/elimination.hpp"
#include "linear/gmres.hpp"
#include "linear/index.hpp"
#include "problems.hpp"

namespace invariode::test::linear_laws {

using Kind = Structure::Kind;

namespace {

constexpr Structure structures[] = {{Kind::dense, 20}, {Kind::banded, 20, 3, 1}, {Kind::sparse, 20}};

const char* name_of(Kind kind) { return kind == Kind::dense ? "dense" : kind == Kind::banded ? "banded" : "sparse"; }

/// Random entries wherever the structure has any; of a sparse one in a third of the places and on the diagonal.
Matrix random_matrix(const Structure& structure, std::mt19937& random) {
  std::normal_distribution<double> normal;
  std::bernoulli_distribution third(0.33);
  Matrix A(structure);
  if (structure.kind == Kind::sparse)
    for (std::size_t j = 0; j < structure.n; ++j) {
      for (std::size_t i = 0; i < structure.n; ++i)
        if (i == j || third(random)) A.rows.push_back(static_cast<int>(i));
      A.starts[j + 1] = static_cast<int>(A.rows.size());
    }
  A.values.resize(std::max(A.values.size(), A.rows.size()));
  A.for_each([&](std::size_t, std::size_t, double& a) { a = normal(random); });
  return A;
}

Eigen::MatrixXd to_eigen(const Matrix& A) {
  const auto n = static_cast<Eigen::Index>(A.n());
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(n, n);
  A.for_each([&](std::size_t i, std::size_t j, double a) {
    out(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(j)) = a;
  });
  return out;
}

/// Where f' has entries, f(t, y)_i = Σ_j A_ij y_j + t.
Function linear(const Matrix& A) {
  return [&A](double t, const double* y, double* out) {
    A.multiply(y, out);
    for (std::size_t i = 0; i < A.n(); ++i) out[i] += t;
  };
}

Mass::Basis unit(int n, std::initializer_list<int> rows) {
  Mass::Basis Z(n, static_cast<int>(rows.size()));
  int column = 0;
  for (const int row : rows) Z.insert(row, column++) = 1;
  Z.makeCompressed();
  return Z;
}

Matrix diagonal(std::vector<double> d) {
  Matrix A({.n = d.size()});
  for (std::size_t i = 0; i < d.size(); ++i) A.values[i * d.size() + i] = d[i];
  return A;
}

}  // namespace

template <class Scalar>
void solve_with_factors(const Structure& structure, Scalar c, std::mt19937& random) {
  using Dense = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;
  const std::unique_ptr<Factors<Scalar>> lu = make_factors<Scalar>(structure, nullptr);
  for (int trial = 0; trial < 20; ++trial) {  // each with another pattern, if it is sparse
    const Matrix J = random_matrix(structure, random), M = random_matrix(structure, random);
    for (const Matrix* mass : {static_cast<const Matrix*>(nullptr), &M}) {
      Dense A = -c * to_eigen(J).cast<Scalar>();
      A += Dense((mass ? to_eigen(*mass) : Eigen::MatrixXd(Eigen::MatrixXd::Identity(A.rows(), A.cols())))
                     .template cast<Scalar>());
      const Eigen::VectorXd ramp = Eigen::VectorXd::LinSpaced(A.rows(), 1, 2);
      const Eigen::Matrix<Scalar, Eigen::Dynamic, 1> x = ramp.cast<Scalar>();
      Eigen::Matrix<Scalar, Eigen::Dynamic, 1> b = A * x;
      CHECK(lu->factor(mass, c, J));
      lu->solve(b.data());
      CHECK_CLOSE((A * (b - x)).norm(), 0, 1e-11);
    }
  }
}

TEST(factors_solve_what_they_factor_in_every_structure_with_and_without_mass) {
  std::mt19937 random(1);
  for (const Structure& structure : structures) {
    const check::Case label(name_of(structure.kind));
    solve_with_factors<double>(structure, 0.3, random);
    solve_with_factors<std::complex<double>>(structure, {0.3, -0.2}, random);
  }
}

/// ‖A x − b‖ ≤ 10 n ε ‖A‖ ‖x‖ in the maximum norm, whatever rows the pivots come from and however large the entries
/// are; a column of zeros, a NaN and an infinite entry are told.
template <class Scalar>
void factor_dense(std::size_t n, double unit, std::mt19937& random) {
  using Dense = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;
  std::normal_distribution<double> normal;
  const Dense A = unit * Dense::NullaryExpr(index(n), index(n), [&] {
                    if constexpr (std::is_same_v<Scalar, double>)
                      return normal(random);
                    else
                      return Scalar(normal(random), normal(random));
                  });
  const auto factors_of = [n](const Dense& of) {
    DenseLu<Scalar> lu(n);
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t j = 0; j < n; ++j) lu.add(i, j, of(index(i), index(j)));
    return lu;
  };
  DenseLu<Scalar> lu = factors_of(A);
  CHECK(lu.factor());
  const Eigen::Matrix<Scalar, Eigen::Dynamic, 1> b = unit * Eigen::VectorXd::LinSpaced(index(n), 1, 2).cast<Scalar>();
  Eigen::Matrix<Scalar, Eigen::Dynamic, 1> x = b;
  lu.solve(x.data(), 1);
  const double bound = 10 * static_cast<double>(n) * eps * A.cwiseAbs().rowwise().sum().maxCoeff();
  CHECK((A * x - b).cwiseAbs().maxCoeff() <= bound * x.cwiseAbs().maxCoeff());
  for (const double wrong : {0.0, std::nan(""), std::numeric_limits<double>::infinity()}) {
    Dense of = A;
    of.col(index(n / 2)).setConstant(wrong);
    CHECK(!factors_of(of).factor());
  }
}

TEST(small_dense_factors_are_backward_stable_at_every_scale) {
  std::mt19937 random(5);
  for (std::size_t n = 1; n < 64; n = n < 8 ? n + 1 : 2 * n - 3)
    for (const double unit : {1.0, 1e-150, 1e150}) {
      const check::Case label(n, unit);
      factor_dense<double>(n, unit, random);
      factor_dense<std::complex<double>>(n, unit, random);
    }
}

/// The solution with DenseLu's factors of A, and with those of each kernel, for right-hand sides alone and together.
template <class Scalar>
void compare_kernels(std::size_t n, bool singular, std::mt19937& random) {
  constexpr bool complex = !std::is_same_v<Scalar, double>;
  std::normal_distribution<double> normal;
  std::vector<Scalar> A(n * n);
  for (Scalar& a : A)
    if constexpr (complex)
      a = {normal(random), normal(random)};
    else
      a = normal(random);
  if (singular) std::fill_n(A.begin() + static_cast<std::ptrdiff_t>(n / 2 * n), n, Scalar(0));
  DenseLu<Scalar> lu(n);
  for (std::size_t j = 0; j < n; ++j)
    for (std::size_t i = 0; i < n; ++i) lu.add(i, j, A[j * n + i]);
  CHECK(lu.factor() == !singular);
  const std::size_t height = (n / elimination::row_multiple + 1) * elimination::row_multiple;
  for (const elimination::Kernel* kernel : elimination::kernels()) {
    std::vector<double> re(height * (n + 7)), im(re.size());
    std::vector<std::size_t> exchanged_with(n);
    const auto set = [&](std::size_t i, std::size_t j, Scalar a) {
      re[j * height + i] = std::real(a);
      im[j * height + i] = std::imag(a);
    };
    for (std::size_t j = 0; j < n; ++j)
      for (std::size_t i = 0; i < n; ++i) set(i, j, A[j * n + i]);
    const elimination::Columns columns{.n = n, .height = height, .re = re.data(), .im = complex ? im.data() : nullptr};
    CHECK(kernel->factor(columns, exchanged_with.data()) == !singular);
    for (const std::size_t m : {1, 2, 3, 7}) {
      if (singular) break;
      std::vector<Scalar> b(n * m);
      for (std::size_t at = 0; at < n * m; ++at) set(at % n, n + at / n, b[at] = Scalar(normal(random)));
      for (std::size_t j = 0; j < m; ++j) lu.solve(b.data() + j * n, 1);
      kernel->solve(columns, exchanged_with.data(), m);
      for (std::size_t at = 0; at < n * m; ++at) {
        CHECK(re[(n + at / n) * height + at % n] == std::real(b[at]));
        CHECK(im[(n + at / n) * height + at % n] == std::imag(b[at]));
      }
    }
  }
}

TEST(elimination_in_blocks_is_elimination_by_columns_bit_for_bit_in_every_instruction_set) {
  std::mt19937 random(7);
  for (const std::size_t n : {1, 2, 7, 8, 9, 15, 16, 17, 23, 24, 25, 31, 40, 63, 64, 65, 100, 131, 200})
    for (const bool singular : {false, true}) {
      const check::Case label(n, singular);
      compare_kernels<double>(n, singular, random);
      compare_kernels<std::complex<double>>(n, singular, random);
    }
}

/// Triangular, full and wide ones, and those of a single component: pivots come from anywhere in a column.
TEST(banded_factors_solve_in_bands_of_every_width) {
  std::mt19937 random(4);
  constexpr Structure bands[] = {{Kind::banded, 20, 0, 0}, {Kind::banded, 20, 0, 3},   {Kind::banded, 20, 4, 0},
                                 {Kind::banded, 9, 8, 8},  {Kind::banded, 40, 12, 13}, {Kind::banded, 1, 0, 0}};
  for (const Structure& structure : bands) {
    const check::Case label(structure.lower, ", ", structure.upper);
    solve_with_factors<double>(structure, 0.3, random);
    solve_with_factors<std::complex<double>>(structure, {0.3, -0.2}, random);
  }
}

/// Solutions for m columns have the bits of solutions for each of them, and a wrong column spoils no other.
template <class Scalar>
void solve_together(const Structure& structure, Scalar c, std::mt19937& random) {
  std::normal_distribution<double> normal;
  const std::unique_ptr<Factors<Scalar>> lu = make_factors<Scalar>(structure, nullptr);
  CHECK(lu->factor(nullptr, c, random_matrix(structure, random)));
  for (std::size_t m = 1; m <= 9; ++m) {
    const check::Case label(structure.n, m);
    std::vector<Scalar> together(structure.n * m);
    for (Scalar& b : together) b = Scalar(normal(random));
    if (m == 9) together[0] = std::numeric_limits<double>::quiet_NaN();
    std::vector<Scalar> alone = together;
    for (std::size_t j = 0; j < m; ++j) lu->solve(alone.data() + j * structure.n);
    lu->solve(together.data(), m);
    const std::size_t first = m == 9 ? structure.n : 0;
    CHECK(std::equal(together.begin() + static_cast<std::ptrdiff_t>(first), together.end(),
                     alone.begin() + static_cast<std::ptrdiff_t>(first)));
    CHECK((m == 9) == !(std::abs(together[0]) >= 0));
  }
}

TEST(right_hand_sides_together_have_the_bits_of_each_alone_in_every_structure) {
  std::mt19937 random(6);
  for (std::size_t n = 1; n <= 70; ++n)
    for (const Structure& structure :
         {Structure{Kind::dense, n}, Structure{Kind::sparse, n}, Structure{Kind::banded, n, 0, 0},
          Structure{Kind::banded, n, std::min(n - 1, n % 7), std::min(n - 1, n % 5)},
          Structure{Kind::banded, n, std::min<std::size_t>(n - 1, 14), std::min<std::size_t>(n - 1, 12)}}) {
      const check::Case label(name_of(structure.kind), structure.lower);
      solve_together<double>(structure, 0.3, random);
      solve_together<std::complex<double>>(structure, {0.3, -0.2}, random);
    }
}

/// v -> A v
template <class Scalar>
class Product final : public LinearOperator<Scalar> {
 public:
  using Dense = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;
  using Vector = Eigen::Matrix<Scalar, Eigen::Dynamic, 1>;

  explicit Product(Dense A) : A_(std::move(A)) {}
  Status multiply(const Scalar* v, Scalar* out) override {
    Eigen::Map<Vector>(out, A_.rows()) = A_ * Eigen::Map<const Vector>(v, A_.rows());
    return Status::ok;
  }
  [[nodiscard]] const Dense& A() const { return A_; }

 private:
  Dense A_;
};

/// The largest real or imaginary part of A x − b in the weights w, with what GMRES makes of x.
template <class Scalar>
void expect_a_residual_within_the_tolerance(const typename Product<Scalar>::Dense& A) {
  using Vector = typename Product<Scalar>::Vector;
  const auto n = static_cast<std::size_t>(A.rows());
  const Eigen::VectorXd w = Eigen::VectorXd::LinSpaced(A.rows(), 1, 3);
  Vector b(A.rows());
  for (Eigen::Index i = 0; i < b.size(); ++i) b[i] = std::sin(Scalar(1.0 + static_cast<double>(i)));
  Product<Scalar> product(A);
  KrylovMemory memory;
  for (const std::size_t dimension : {5, 20})
    for (const double tolerance : {1e-2, 1e-5, 1e-8}) {
      const check::Case label(dimension, ", ", tolerance);
      Gmres<Scalar> gmres(n, dimension, memory);
      Vector x = b;
      CHECK(gmres.solve(product, w.data(), tolerance, x.data()) == GmresResult::converged);
      const Vector r = A * x - b;
      CHECK((r.real().cwiseAbs().cwiseQuotient(w)).maxCoeff() < 1.001 * tolerance);
      CHECK((r.imag().cwiseAbs().cwiseQuotient(w)).maxCoeff() < 1.001 * tolerance);
    }
}

TEST(gmres_leaves_a_residual_within_the_tolerance_in_one_cycle_or_several) {
  std::mt19937 random(5);
  for (int trial = 0; trial < 5; ++trial) {
    const Eigen::MatrixXd one = Eigen::MatrixXd::Identity(20, 20);
    const Eigen::MatrixXd R = 0.05 * to_eigen(random_matrix({Kind::dense, 20}, random));
    const Eigen::MatrixXd S = 0.05 * to_eigen(random_matrix({Kind::dense, 20}, random));
    expect_a_residual_within_the_tolerance<double>(one + R);
    expect_a_residual_within_the_tolerance<Complex>(one * Complex(0.8, 0.6) + R.cast<Complex>() + Complex(0, 1) * S);
  }
}

TEST(gmres_for_complex_numbers_does_with_real_ones_what_the_real_one_does) {
  std::mt19937 random(6);
  const Eigen::MatrixXd A =
      Eigen::MatrixXd::Identity(20, 20) + 0.1 * to_eigen(random_matrix({Kind::dense, 20}, random));
  Product<double> product(A);
  Product<Complex> complex_product(A.cast<Complex>());
  const Eigen::VectorXd w = Eigen::VectorXd::Ones(20);
  KrylovMemory memory;
  Gmres<double> gmres(20, 10, memory);
  Gmres<Complex> complex_gmres(20, 10, memory);
  Eigen::VectorXd x = Eigen::VectorXd::LinSpaced(20, -1, 2);
  Eigen::VectorXcd z = x.cast<Complex>() * Complex(0, 2);
  CHECK(gmres.solve(product, w.data(), 1e-6, x.data()) == GmresResult::converged);
  CHECK(complex_gmres.solve(complex_product, w.data(), 2e-6, z.data()) == GmresResult::converged);
  CHECK(gmres.iterations() == complex_gmres.iterations());
  CHECK_CLOSE(gmres.least_singular_value(), complex_gmres.least_singular_value(), 1e-12);
  CHECK_CLOSE((z - x.cast<Complex>() * Complex(0, 2)).cwiseAbs().maxCoeff(), 0, 1e-12);
}

template <class Scalar>
void expect_gmres_tells_what_it_does_not_solve() {
  using Vector = typename Product<Scalar>::Vector;
  const std::vector<double> w(3, 1);
  KrylovMemory memory;
  Gmres<Scalar> gmres(3, 3, memory);
  const auto solve = [&](std::initializer_list<double> diagonal, std::initializer_list<double> right) {
    Vector entries(3), b(3);
    std::copy(diagonal.begin(), diagonal.end(), entries.data());
    std::copy(right.begin(), right.end(), b.data());
    Product<Scalar> product(entries.asDiagonal());
    return gmres.solve(product, w.data(), 1e-6, b.data());
  };
  CHECK(solve({1, 2, 3}, {1, 1, 1}) == GmresResult::converged);
  CHECK(solve({1, 2, 3}, {0, 0, 0}) == GmresResult::converged);
  CHECK(solve({1, 2, 0}, {1, 1, 1}) == GmresResult::failed);
  CHECK(solve({0, 0, 0}, {1, 1, 1}) == GmresResult::failed);
  CHECK(gmres.tried() == nullptr);
  CHECK(solve({1, 2, NaN}, {1, 1, 1}) == GmresResult::undefined);
  CHECK(gmres.tried() != nullptr);
  CHECK(solve({1, 2, 3}, {1, 1, NaN}) == GmresResult::undefined);
  CHECK(gmres.tried() == nullptr);
}

TEST(gmres_tells_what_it_does_not_solve) {
  expect_gmres_tells_what_it_does_not_solve<double>();
  expect_gmres_tells_what_it_does_not_solve<Complex>();
}

/// A preconditioner that solves with the LU factors of M − c J, or returns what `broken` makes of b.
struct Factored {
  const Matrix *M, *J;
  void (*broken)(double* b, std::size_t n) = nullptr;
  std::unique_ptr<Factorization> lu = make_factorization({Kind::dense, 20}, nullptr);

  Preconditioner callback() {
    return {[](void* self, double, const double*, double c, std::shared_ptr<void>&) {
              auto& me = *static_cast<Factored*>(self);
              CHECK(me.lu->factor(me.M, c, *me.J));
              return Status::ok;
            },
            [](void* self, void*, double* b) {
              auto& me = *static_cast<Factored*>(self);
              me.broken ? me.broken(b, 20) : me.lu->solve(b);
              return Status::ok;
            },
            this};
  }
};

/// What a matrix-free solve is made of: f = J y, with a mass matrix and a preconditioner, in weights of 1.
struct MatrixFreeSystem {
  explicit MatrixFreeSystem(Preconditioner preconditioner, const Matrix& J, Mass* mass)
      : f(linear(J)),
        callback(as_callback(f)),
        krylov{{}, preconditioner, 20},
        solver(callback, weights, {.jacobian = nullptr, .mass = mass, .lapack = nullptr, .krylov = &krylov}, true) {
    solver.take_scratch(scratch[0].data(), scratch[1].data());
    solver.reach(0, y.data());
    solver.product().at(0, y.data(), slope.data());
  }

  Function f;
  Callback callback;
  Weights weights{1e-3, std::vector<double>(20, 1e-3), {}};
  KrylovTerms krylov;
  std::vector<double> y = std::vector<double>(20), slope = std::vector<double>(20), w = std::vector<double>(20, 1);
  std::vector<double> scratch[2] = {std::vector<double>(20), std::vector<double>(20)};
  MatrixFree solver;
};

TEST(matrix_free_complex_systems_have_the_solutions_of_complex_factors) {
  std::mt19937 random(7);
  const Complex c(0.2, -0.15);
  for (int trial = 0; trial < 10; ++trial) {
    Matrix J = random_matrix({Kind::dense, 20}, random), M = random_matrix({Kind::dense, 20}, random);
    for (std::size_t i = 0; i < 20; ++i) M.values[21 * i] += 8;
    for (const bool preconditioned : {false, true}) {
      const check::Case label(trial, preconditioned);
      Mass mass(M, {}, Mass::Basis(20, 0));
      Factored exact{&M, &J};
      MatrixFreeSystem system(preconditioned ? exact.callback() : Preconditioner(), J, &mass);
      CHECK(system.solver.set_up(std::abs(c)) == Status::ok);
      std::vector<Complex> b(20), x;
      for (std::size_t i = 0; i < 20; ++i) b[i] = {std::sin(1.0 + i), std::cos(3.0 * i)};
      x = b;
      CHECK(system.solver.precondition(x.data()) == Outcome::ok);
      CHECK(system.solver.solve(c, &M, system.w.data(), 1e-7, x.data()) == GmresResult::converged);
      const std::unique_ptr<ComplexFactorization> lu = make_factors<Complex>({Kind::dense, 20}, nullptr);
      CHECK(lu->factor(&M, c, J));
      lu->solve(b.data());
      for (std::size_t i = 0; i < 20; ++i) CHECK_CLOSE(std::abs(x[i] - b[i]), 0, 1e-6);
      CHECK(system.solver.products() == 2 * system.solver.iterations());
    }
  }
}

TEST(a_preconditioner_that_returns_zeros_or_nan_is_told) {
  std::mt19937 random(8);
  const Matrix J = random_matrix({Kind::dense, 20}, random);
  const auto unsolved_with = [&](void (*broken)(double*, std::size_t), auto first) {
    Factored factored{nullptr, &J, broken};
    MatrixFreeSystem system(factored.callback(), J, nullptr);
    CHECK(system.solver.set_up(0.1) == Status::ok);
    std::vector<decltype(first)> b(20);
    b[0] = first;
    CHECK(system.solver.precondition(b.data()) == Outcome::not_finite);
    for (int attempt = 0; attempt < 7; ++attempt) {
      CHECK(!system.solver.hopeless());
      system.solver.begin_attempt();
      CHECK(system.solver.unsolved() == Unsolved::none);
      b[0] = first;
      CHECK(system.solver.precondition(b.data()) == Outcome::not_finite);
    }
    CHECK(system.solver.hopeless());
    return system.solver.unsolved();
  };
  const auto zeros = [](double* b, std::size_t n) { std::fill_n(b, n, 0); };
  const auto undefined = [](double* b, std::size_t) { b[7] = NaN; };
  CHECK(unsolved_with(zeros, 1.0) == Unsolved::preconditioner_zero);
  CHECK(unsolved_with(zeros, Complex(0, 1)) == Unsolved::preconditioner_zero);
  CHECK(unsolved_with(undefined, 1.0) == Unsolved::preconditioner);
  CHECK(unsolved_with(undefined, Complex(0, 1)) == Unsolved::preconditioner);
}

TEST(singular_and_undefined_matrices_are_told) {
  std::mt19937 random(2);
  for (const Structure& structure : structures) {
    const check::Case label(name_of(structure.kind));
    const std::unique_ptr<Factorization> lu = make_factorization(structure, nullptr);
    Matrix J = random_matrix(structure, random);
    Matrix zero = J;
    std::fill(zero.values.begin(), zero.values.end(), 0);
    CHECK(!lu->factor(&zero, 1, zero));
    J.values[structure.upper * structure.n + 5] = NaN;
    CHECK(!lu->factor(nullptr, 1, J));
    CHECK(lu->factor(nullptr, 1, zero));
    const std::unique_ptr<ComplexFactorization> complex_lu = make_factors<std::complex<double>>(structure, nullptr);
    CHECK(!complex_lu->factor(&zero, 1, zero));
    CHECK(!complex_lu->factor(nullptr, 1, J));
    CHECK(complex_lu->factor(nullptr, 1, zero));
  }
}

TEST(difference_jacobians_of_linear_functions_are_exact_and_cost_one_f_a_group) {
  std::mt19937 random(3);
  for (const Structure& structure : structures) {
    const check::Case label(name_of(structure.kind));
    const Matrix A = random_matrix(structure, random);
    Function f = linear(A);
    Callback callback = as_callback(f);
    const Weights weights(1e-3, std::vector<double>(20, 1e-3), {});
    Jacobian jacobian({.kind = Jacobian::Kind::differences}, A, weights);
    std::vector<double> y(20), slope(20);
    for (std::size_t i = 0; i < 20; ++i) y[i] = 1 + 0.1 * static_cast<double>(i);
    f(0.5, y.data(), slope.data());
    CHECK(jacobian.evaluate(callback, 0.5, y.data(), slope.data()) == Status::ok);
    CHECK_CLOSE((to_eigen(jacobian.matrix()) - to_eigen(A)).cwiseAbs().maxCoeff(), 0, 1e-5);
    if (structure.kind == Kind::dense) CHECK(callback.calls() == 20);
    if (structure.kind == Kind::banded) CHECK(callback.calls() == 5);
    CHECK(callback.calls() <= 20);
    CHECK(jacobian.count() == 1);
  }
}

TEST(the_check_of_a_jacobian_sees_every_entry_that_counts) {
  std::mt19937 random(5);
  for (const Structure& structure : structures) {
    const check::Case label(name_of(structure.kind));
    const Matrix A = random_matrix(structure, random);
    Matrix J = A;
    Function f = linear(A);
    Callback callback = as_callback(f);
    std::vector<double> y(20, 1.0), slope(20), reach(20, 1e-8);
    f(0.5, y.data(), slope.data());
    JacobianCheck check(20);
    const auto verdict = [&](std::size_t turn) {
      return check.examine(callback, 0.5, y.data(), slope.data(), J, reach.data(), turn);
    };
    for (std::size_t turn = 0; turn < 5; ++turn) CHECK(verdict(turn) == JacobianCheck::Verdict::right);
    CHECK(callback.calls() == 5);
    std::vector<double> row(20, 0.0);
    A.for_each([&](std::size_t i, std::size_t, double value) { row[i] += std::abs(value); });
    std::size_t missing = 0;
    J.for_each([&](std::size_t i, std::size_t, double& value) {
      if (std::abs(value) <= 0.02 * row[i]) return;  // the check lets 0.01 pass, and a component moves by half at least
      const double whole = std::exchange(value, 0);
      CHECK(verdict(++missing) == JacobianCheck::Verdict::wrong);
      value = whole;
    });
    CHECK(missing >= 20);
  }
}

TEST(curvature_does_not_make_a_jacobian_wrong) {
  Function f = [](double, const double* y, double* out) { out[0] = y[0] * y[0]; };
  Callback callback = as_callback(f);
  Matrix J({.n = 1});
  J.provide();
  const double y = 0, slope = 0, reach = 1e-3;  // f' = 0, and all that f changes by is curvature
  JacobianCheck check(1);
  CHECK(check.examine(callback, 0, &y, &slope, J, &reach, 0) == JacobianCheck::Verdict::right);
  CHECK(callback.calls() == 2);
}

TEST(differences_keep_their_accuracy_where_components_differ_by_twenty_orders) {
  Function f = [](double, const double* y, double* out) { out[0] = -1e-20 * y[1] * y[1], out[1] = 1e20 * y[0] * y[0]; };
  Callback callback = as_callback(f);
  const Weights weights(1e-3, {1e-16, 1e4}, {});
  Jacobian jacobian({.kind = Jacobian::Kind::differences}, Matrix({.n = 2}), weights);
  const double y[] = {3e-10, 2e10};
  double slope[2];
  f(0, y, slope);
  for (int pass = 0; pass < 6; ++pass) CHECK(jacobian.evaluate(callback, 0, y, slope) == Status::ok);
  const std::vector<double>& J = jacobian.matrix().values;
  CHECK_CLOSE(J[1] / (-2e-20 * y[1]), 1, 1e-5);
  CHECK_CLOSE(J[2] / (2e20 * y[0]), 1, 1e-5);
  CHECK(J[0] == 0 && J[3] == 0);
}

TEST(entries_that_are_roundoff_are_told_and_wide_increments_replace_them) {
  // y₁ starts at 0, and the first row has a term beside which its change is an ulp or none.
  Function f = [](double, const double* y, double* out) {
    out[0] = 1.389e-12 * y[0] - 2e4 * y[1];
    out[1] = 2e4 * y[1];
  };
  Callback callback = as_callback(f);
  const Weights weights(1e-4, {1e-20, 1e-20}, {});
  Jacobian jacobian({.kind = Jacobian::Kind::differences}, Matrix({.n = 2}), weights);
  const double y[] = {1, 0};
  double slope[2];
  f(0, y, slope);
  CHECK(jacobian.evaluate(callback, 0, y, slope) == Status::ok);
  const std::vector<double>& J = jacobian.matrix().values;
  CHECK(std::abs(J[1] / -2e4 - 1) > 0.01);
  CHECK(jacobian.noise() > 0);
  jacobian.widen_increments();
  CHECK(jacobian.evaluate(callback, 0, y, slope) == Status::ok);
  CHECK_CLOSE(J[1] / -2e4, 1, 1e-3);
  CHECK(jacobian.noise() == 0);
}

TEST(differences_go_to_the_other_side_where_f_is_not_defined) {
  Function f = [](double, const double* y, double* out) { out[0] = std::sqrt(1 - y[0]); };
  Callback callback = as_callback(f);
  const Weights weights(1e-3, {1e-3}, {});
  Jacobian jacobian({.kind = Jacobian::Kind::differences}, Matrix({.n = 1}), weights);
  const double y = 1 - 1e-12;
  double slope = 0;
  f(0, &y, &slope);
  CHECK(jacobian.evaluate(callback, 0, &y, &slope) == Status::ok);
  CHECK(std::isfinite(jacobian.matrix().values[0]) && jacobian.matrix().values[0] < 0);
}

TEST(the_slope_of_an_algebraic_system_keeps_its_equations) {
  // y' = −z, 0 = y − z + sin t: z' = y' + cos t.
  const Matrix M = diagonal({2, 0});
  Mass mass(M, {}, unit(2, {1}));
  Matrix J({.n = 2});
  J.values = {0, -1, 1, -1};
  MassSolver solver;
  CHECK(solver.factor(mass, J, nullptr));
  const double ft[] = {0, std::cos(0.3)};
  double f[] = {-0.8, 0};
  solver.slope(mass, ft, f);
  CHECK_CLOSE(f[0], -0.4, 4 * eps);
  CHECK_CLOSE(f[1], -0.4 + std::cos(0.3), 4 * eps);
}

TEST(an_index_above_1_is_told) {
  // y' = z, 0 = y: z is in no algebraic equation.
  Mass mass(diagonal({1, 0}), {}, unit(2, {1}));
  Matrix J({.n = 2});
  J.values = {0, 1, 1, 0};
  CHECK(!MassSolver().factor(mass, J, nullptr));
}

TEST(starts_are_made_consistent_or_refused) {
  const Weights weights(1e-6, {1e-3, 1e-3}, {});
  const auto start = [&](Function f, std::vector<double>& y) {
    Callback callback = as_callback(f);
    Jacobian jacobian = differences(weights);
    Mass mass(diagonal({1, 0}), {}, unit(2, {1}));
    return make_consistent(callback, {.jacobian = &jacobian, .mass = &mass}, weights, 0, y.data());
  };
  const Function cubic = [](double, const double* y, double* out) {
    out[0] = -y[1], out[1] = y[1] * y[1] * y[1] + y[1] - y[0];
  };
  std::vector<double> y = {2, 50};
  CHECK(start(cubic, y) == Consistency::corrected);
  CHECK(y[0] == 2);
  CHECK_CLOSE(y[1], 1, 1e-14);
  const std::vector<double> consistent = y;
  CHECK(start(cubic, y) == Consistency::consistent);
  CHECK(same_bits(y, consistent));
  y = {1, 0.5};
  CHECK(start([](double, const double* v, double* out) { out[0] = 0, out[1] = v[1] * v[1] + 1; }, y) ==
        Consistency::not_found);
  CHECK(start([](double, const double* v, double* out) { out[0] = v[1], out[1] = v[0]; }, y) ==
        Consistency::undetermined);
  CHECK(start([](double, const double*, double* out) { out[0] = out[1] = NaN; }, y) == Consistency::undefined);
}

TEST(a_singular_iteration_matrix_ends_the_run_and_is_told) {
  Problem problem = scalar("y' = y with M = 0", 1, 1, [](double, const double* y, double* out) { out[0] = y[0] * 0; });
  const Weights weights(1e-3, {1e-3}, {});
  Callback f = as_callback(problem.f);
  Mass mass(diagonal({1}), {}, Mass::Basis(1, 0));
  const Jacobian jacobian({.kind = Jacobian::Kind::constant}, diagonal({0}), weights);
  auto step = named("ode15s").step(f, weights, {}, {.jacobian = &jacobian, .mass = &mass});
  Integration integration(std::move(step), weights, {}, {.f = f}, {.tf = 1, .hmax = 0.1});
  CHECK(integration.start(problem.y0.data()) == State::running);
  CHECK(integration.advance() == State::running);
  mass = Mass(diagonal({0}), {}, Mass::Basis(1, 0));  // from here on nothing determines y'
  CHECK(integration.run() == State::step_failed);
  CHECK(integration.report().linear.singular);
  CHECK(integration.report().cause == Cause::newton);
}

}  // namespace invariode::test::linear_laws
