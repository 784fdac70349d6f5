#pragma once
// Derivatives of a function of t and x without symbols (docs/algorithms.md, 'The right-hand side of mechanics').

#include <Eigen/SparseCore>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "callback.hpp"
#include "linear/groups.hpp"

namespace invariode {

using SparseMatrix = Eigen::SparseMatrix<double>;

/// Some columns of a Jacobian: where they may have entries, and which of them are computed together.
struct SparseColumns {
  SparseMatrix matrix;    ///< (m, columns); its pattern stays
  std::size_t first = 0;  ///< which component of x the first column belongs to
  ColumnGroups groups;    ///< of the columns

  SparseColumns() = default;
  SparseColumns(const SparseMatrix& pattern, std::size_t first_component);
};

/// A function (t, x) -> (m) with x of n components, and its first and second derivatives: by functions for them where
/// these are known, by complex steps where there is a complex form of it, else by differences of order 4.
class Differentiable {
 public:
  /// `function` of t and x. Its complex form, if there is one, takes 1 + n complex numbers, (t, x), and gives m of
  /// them. `quiet`: the same, for points that may be outside its domain. `slope` and `curvature`: d/ds and d²/ds² of
  /// function(t + s dt, x + s dx) at s = 0, functions of t and (x, dt, dx).
  struct Forms {
    Callback function, complex, quiet, slope, curvature;
  };

  Differentiable() = default;
  Differentiable(const Forms& forms, std::size_t n, std::size_t m);

  [[nodiscard]] std::size_t n() const { return n_; }
  [[nodiscard]] std::size_t m() const { return m_; }
  [[nodiscard]] bool by_complex_steps() const { return static_cast<bool>(forms_.complex); }
  /// Calls of the user's function, real and complex, and of its derivatives.
  [[nodiscard]] std::int64_t calls() const {
    return forms_.function.calls() + forms_.complex.calls() + forms_.quiet.calls() + forms_.slope.calls() +
           forms_.curvature.calls();
  }

  Status value(double t, const double* x, double* out) { return forms_.function(t, x, out); }
  /// d/ds of function(t + s dt, x + s dx) at s = 0.
  Status slope(double t, const double* x, double dt, const double* dx, double* out);
  /// d²/ds² of the same. `sizes` (m): of the terms that d/ds sums, which may cancel; null: not known.
  Status curvature(double t, const double* x, double dt, const double* dx, double* out, const double* sizes = nullptr);
  /// Relative error of the derivatives, in units of their terms; 0: roundoff.
  [[nodiscard]] double relative_error() const;
  /// ∂/∂x_j for the requested columns, one evaluation of the complex form for each group of them, or four of the
  /// function. `size`: of the components, for increments.
  Status jacobian(double t, const double* x, const double* size, SparseColumns& columns);

 private:
  [[nodiscard]] bool exact() const { return static_cast<bool>(forms_.slope); }
  Status derived(Callback& form, double t, const double* x, double dt, const double* dx, double* out);
  Status complex_at(Callback& form, double t, const double* x, double dt, const double* dx, double re, double im);
  Status odd_difference(double t, const double* x, double dt, const double* dx, double* out);
  Status rotated(double t, const double* x, double dt, const double* dx, double h, const double* sizes, double* out);
  double extrapolate(std::size_t columns);
  Status second_difference(double t, const double* x, double dt, const double* dx, double* out);
  Status even_difference(double t, const double* x, double dt, const double* dx, double* out);
  void move(const double* x, const double* dx, double s);

  Forms forms_;
  std::size_t n_ = 0, m_ = 0;
  std::vector<double> point_, direction_, column_;                // (n), (n), (m)
  std::vector<double> plus_, minus_, near_, far_, terms_, here_;  // (m)
  std::vector<std::vector<double>> table_;                        // of the extrapolation, the latest row; (m) each
  std::vector<double> z_, w_;                                     // 1 + n, and m complex numbers
};

/// Sizes of the components, for increments: those small compared with the largest give no scale of their own.
void fill_sizes(const double* x, std::size_t n, double* size);

/// The s with which x + s dx, or where x rests t + s dt, changes by the size of x or of t.
double reach(double t, const double* x, std::size_t n, double dt, const double* dx);

}  // namespace invariode
