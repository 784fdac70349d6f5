#pragma once
// Square matrices as implicit methods meet them: Jacobian, mass matrix, and the LU factors of M − c J.

#include <cassert>
#include <complex>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <functional>
#include <memory>
#include <vector>

#include "callback.hpp"

namespace invariode {

/// The structure in which a matrix is stored.
struct Structure {
  enum class Kind { dense, banded, sparse } kind = Kind::dense;
  std::size_t n = 0;
  std::size_t lower = 0, upper = 0;  ///< bandwidths of a banded one
};

/// An n × n matrix. Dense: (n, n), row-major. Banded: (lower + upper + 1, n), row-major, with A(i, j) at
/// [upper + i − j, j], LAPACK's layout. Sparse: compressed columns, row indices ascending.
struct Matrix {
  Structure structure;
  std::vector<double> values;
  std::vector<int> starts, rows;  ///< of a sparse one: where column j starts, row indices

  Matrix() = default;
  explicit Matrix(const Structure& of);
  /// One whose values wait for `provide`: a large one that may never be needed takes no memory.
  static Matrix without_values(const Structure& of);
  /// The number of its values, once they are there.
  [[nodiscard]] std::size_t size() const;
  /// Makes the values, zeros, unless they are there.
  void provide();

  [[nodiscard]] std::size_t n() const { return structure.n; }
  [[nodiscard]] bool same_pattern(const Matrix& other) const { return starts == other.starts && rows == other.rows; }

  /// Calls visit(i, j, value&) for each stored entry.
  template <class Visit>
  void for_each(Visit&& visit) {
    for_each_of(*this, visit);
  }
  template <class Visit>
  void for_each(Visit&& visit) const {
    for_each_of(*this, visit);
  }
  /// y = A x
  void multiply(const double* x, double* y) const;

 private:
  template <class Self, class Visit>
  static void for_each_of(Self& self, Visit&& visit) {
    const auto& [kind, n, lower, upper] = self.structure;
    assert(self.values.size() == self.size());
    if (kind == Structure::Kind::dense) {
      for (std::size_t i = 0; i < n; ++i)
        for (std::size_t j = 0; j < n; ++j) visit(i, j, self.values[i * n + j]);
    } else if (kind == Structure::Kind::banded) {
      for (std::size_t d = 0; d <= lower + upper; ++d)  // diagonal i − j = d − upper
        for (std::size_t j = d < upper ? upper - d : 0; j < n && j + d < n + upper; ++j)
          visit(j + d - upper, j, self.values[d * n + j]);
    } else {
      for (std::size_t j = 0; j < n; ++j)
        for (int p = self.starts[j]; p < self.starts[j + 1]; ++p) {
          const auto q = static_cast<std::size_t>(p);
          visit(static_cast<std::size_t>(self.rows[q]), j, self.values[q]);
        }
    }
  }
};

/// A user function that fills a matrix: the values of its structure; of a sparse one it may replace the pattern too.
class MatrixFunction {
 public:
  using Function = Status(void* context, double t, const double* y, Matrix& out);

  MatrixFunction() = default;
  MatrixFunction(Function* function, void* context) : function_(function), context_(context) {}

  Status operator()(double t, const double* y, Matrix& out) { return function_(context_, t, y, out); }
  explicit operator bool() const noexcept { return function_ != nullptr; }

 private:
  Function* function_ = nullptr;
  void* context_ = nullptr;
};

/// Thrown within long linear algebra where the run is to end at once (`Lapack::poll`): what was being computed is lost.
class Interruption : public std::exception {};

/// LAPACK's routines for LU factors of real or complex matrices, with the BLAS of elimination in blocks.
template <class Scalar>
struct LapackOf {
  using Factor = void(int* m, int* n, Scalar* a, int* lda, int* pivots, int* info);
  using Solve = void(char* trans, int* n, int* nrhs, Scalar* a, int* lda, int* pivots, Scalar* b, int* ldb, int* info);
  using FactorBand = void(int* m, int* n, int* kl, int* ku, Scalar* ab, int* ldab, int* pivots, int* info);
  using SolveBand = void(char* trans, int* n, int* kl, int* ku, int* nrhs, Scalar* ab, int* ldab, int* pivots,
                         Scalar* b, int* ldb, int* info);
  using Exchange = void(int* n, Scalar* a, int* lda, int* first, int* last, int* pivots, int* step);
  using SolveTriangle = void(char* side, char* part, char* trans, char* diagonal, int* m, int* n, Scalar* alpha,
                             Scalar* a, int* lda, Scalar* b, int* ldb);
  using Multiply = void(char* trans_a, char* trans_b, int* m, int* n, int* k, Scalar* alpha, Scalar* a, int* lda,
                        Scalar* b, int* ldb, Scalar* beta, Scalar* c, int* ldc);
  Factor* factor = nullptr;                 ///< dgetrf, zgetrf
  Solve* solve = nullptr;                   ///< dgetrs, zgetrs
  FactorBand* factor_band = nullptr;        ///< dgbtrf, zgbtrf
  SolveBand* solve_band = nullptr;          ///< dgbtrs, zgbtrs
  Exchange* exchange = nullptr;             ///< dlaswp, zlaswp
  SolveTriangle* solve_triangle = nullptr;  ///< dtrsm, ztrsm
  Multiply* multiply = nullptr;             ///< dgemm, zgemm
};

/// Both, which the binding takes from the copy that SciPy ships.
struct Lapack {
  LapackOf<double> real;
  LapackOf<std::complex<double>> complex;
  /// Called several times in each long factorisation: throws `Interruption` if the run is to end. Empty: it never is.
  std::function<void()> poll;

  [[nodiscard]] const LapackOf<double>& of(double) const { return real; }
  [[nodiscard]] const LapackOf<std::complex<double>>& of(std::complex<double>) const { return complex; }
};

/// LU factors of A = M − c J, where c is real or complex, and solutions of A X = B with them.
template <class Scalar>
class Factors {
 public:
  Factors() = default;
  Factors(const Factors&) = delete;
  Factors& operator=(const Factors&) = delete;
  virtual ~Factors() = default;

  /// `mass` null: the identity. False: A is singular, or not finite.
  [[nodiscard]] virtual bool factor(const Matrix* mass, Scalar c, const Matrix& jacobian) = 0;
  /// B becomes A⁻¹ B: m columns of n numbers, one behind the other, each with the bits that it has alone.
  virtual void solve(Scalar* b, std::size_t m = 1) = 0;
};

using Factorization = Factors<double>;
using ComplexFactorization = Factors<std::complex<double>>;

/// Returns whether `make_factors` uses LAPACK for matrices of a structure, if it is given.
[[nodiscard]] bool by_lapack(const Structure& structure);

/// Makes factors for matrices of that structure. `lapack` may be null: dense ones are then eliminated by our own code,
/// however large, and banded ones that are not narrow are treated as sparse.
template <class Scalar>
std::unique_ptr<Factors<Scalar>> make_factors(const Structure& structure, const Lapack* lapack);

inline std::unique_ptr<Factorization> make_factorization(const Structure& structure, const Lapack* lapack) {
  return make_factors<double>(structure, lapack);
}

}  // namespace invariode
