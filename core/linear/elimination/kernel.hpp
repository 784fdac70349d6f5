#pragma once
// The kernels of elimination. Whoever includes this defines INVARIODE_LANES, the name of an instruction set, and
// compiles it with the options of that set: nothing here may be linked in place of the same function elsewhere.
//
// Recursive elimination (S. Toledo, Locality of reference in LU decomposition with partial pivoting, SIAM J. Matrix
// Anal. Appl. 18 (1997) 1065-1081): the left half of the columns is eliminated, the right half is updated by it, and
// eliminated. Nearly all operations are then in `subtract_product`, which keeps a tile of the matrix in registers.
// Entry (i, j) takes its terms l_ik u_kj in the order of k, one at a time, in every variant.

#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>

#include "linear/elimination/elimination.hpp"
#include "linear/side_by_side.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::elimination::INVARIODE_LANES {

namespace registers = lanes::INVARIODE_LANES;
using Set = registers::Register<registers::native>;
using Vector = Set::Numbers;
constexpr std::size_t width = registers::native;
constexpr std::size_t panel = row_multiple;  // columns that are eliminated one by one
static_assert(row_multiple % width == 0);

/// A register of numbers that need not be aligned.
inline Vector load(const double* from) {
  Vector v;
  std::memcpy(&v, from, sizeof v);
  return v;
}
inline void store(double* to, Vector v) { std::memcpy(to, &v, sizeof v); }

/// R registers of consecutive rows, of a real matrix or of a complex one.
template <std::size_t R, bool complex>
struct Rows;
template <std::size_t R>
struct Rows<R, false> {
  Vector v[R];

  void take(const Columns& a, std::size_t at) {
    for (std::size_t r = 0; r < R; ++r) v[r] = load(a.re + at + r * width);
  }
  void put(const Columns& a, std::size_t at) const {
    for (std::size_t r = 0; r < R; ++r) store(a.re + at + r * width, v[r]);
  }
  /// Less the number at a place of the matrix times other rows.
  void subtract(const Columns& a, std::size_t factor, const Rows& other) {
    const Vector f = Set::all(a.re[factor]);
    for (std::size_t r = 0; r < R; ++r) v[r] -= f * other.v[r];
  }
};
template <std::size_t R>
struct Rows<R, true> {
  Vector re[R], im[R];

  void take(const Columns& a, std::size_t at) {
    for (std::size_t r = 0; r < R; ++r) re[r] = load(a.re + at + r * width), im[r] = load(a.im + at + r * width);
  }
  void put(const Columns& a, std::size_t at) const {
    for (std::size_t r = 0; r < R; ++r) store(a.re + at + r * width, re[r]), store(a.im + at + r * width, im[r]);
  }
  void subtract(const Columns& a, std::size_t factor, const Rows& other) {
    const Vector p = Set::all(a.re[factor]), q = Set::all(a.im[factor]);
    for (std::size_t r = 0; r < R; ++r) {
      re[r] -= p * other.re[r] - q * other.im[r];
      im[r] -= p * other.im[r] + q * other.re[r];
    }
  }
};

/// Rows and columns, from the first to before the last.
struct Range {
  std::size_t first, last;
};

/// The order in which an entry takes its terms.
enum class Order { ascending, descending };

/// A tile of R registers of rows from `row` on and C columns from `column` on, less the product of the columns k of the
/// matrix, in these rows, with its rows k in these columns.
template <std::size_t R, std::size_t C, bool complex, Order order>
void subtract_from_tile(const Columns& a, std::size_t row, std::size_t column, Range k) {
  Rows<R, complex> tile[C];
  for (std::size_t c = 0; c < C; ++c) tile[c].take(a, (column + c) * a.height + row);
  for (std::size_t step = 0; step < k.last - k.first; ++step) {
    const std::size_t p = order == Order::ascending ? k.first + step : k.last - 1 - step;
    Rows<R, complex> factor;
    factor.take(a, p * a.height + row);
    for (std::size_t c = 0; c < C; ++c) tile[c].subtract(a, (column + c) * a.height + p, factor);
  }
  for (std::size_t c = 0; c < C; ++c) tile[c].put(a, (column + c) * a.height + row);
}

/// All whole tiles in these columns. Returns the first column that is left.
template <std::size_t R, std::size_t C, bool complex>
std::size_t subtract_from_columns(const Columns& a, std::size_t row, Range columns, Range k) {
  std::size_t j = columns.first;
  for (; j + C <= columns.last; j += C) subtract_from_tile<R, C, complex, Order::ascending>(a, row, j, k);
  return j;
}

template <std::size_t R, bool complex>
void subtract_from_rows(const Columns& a, std::size_t row, Range columns, Range k) {
  constexpr std::size_t tile = width == 8 ? 8 : 4;  // as many columns as there are registers for
  columns.first = subtract_from_columns<R, tile, complex>(a, row, columns, k);
  columns.first = subtract_from_columns<R, 2, complex>(a, row, columns, k);
  subtract_from_columns<R, 1, complex>(a, row, columns, k);
}

/// A(rows, columns) −= A(rows, k) A(k, columns), for rows that begin and end at multiples of `row_multiple`.
template <bool complex>
void subtract_product(const Columns& a, Range rows, Range columns, Range k) {
  constexpr std::size_t R = complex ? 1 : 2;
  constexpr std::size_t depth = 64;  // columns of A(rows, k) that stay in the cache for all columns
  for (; k.first < k.last; k.first += depth) {
    const Range now = {k.first, k.first + depth < k.last ? k.first + depth : k.last};
    std::size_t i = rows.first;
    for (; i + R * width <= rows.last; i += R * width) subtract_from_rows<R, complex>(a, i, columns, now);
    for (; i < rows.last; i += width) subtract_from_rows<1, complex>(a, i, columns, now);
  }
}

/// C columns from `column` on, in as many registers whatever C is: A(rows, columns) −= A(rows, k) A(k, columns) in tall
/// tiles, so that a column of A is read once, and in long stretches.
template <std::size_t C, bool complex, Order order>
void subtract_in_tall_tiles(const Columns& a, Range rows, std::size_t column, Range k) {
  constexpr std::size_t R = (complex ? 4 : 8) / C;
  std::size_t i = rows.first;
  for (; i + R * width <= rows.last; i += R * width) subtract_from_tile<R, C, complex, order>(a, i, column, k);
  for (; i < rows.last; i += width) subtract_from_tile<1, C, complex, order>(a, i, column, k);
}

/// Subtracts l_ik x_k from the entries i of a column below the diagonal, up to row `last`; x_k is its entry k.
template <bool complex>
void subtract_below(const Columns& a, std::size_t k, std::size_t last, double* __restrict re, double* __restrict im) {
  const double* __restrict l = a.re + k * a.height, * __restrict m = complex ? a.im + k * a.height : nullptr;
  const double p = re[k], q = complex ? im[k] : 0;
  for (std::size_t i = k + 1; i < last; ++i) {
    if constexpr (complex) {
      re[i] -= p * l[i] - q * m[i];
      im[i] -= p * m[i] + q * l[i];
    } else {
      re[i] -= p * l[i];
    }
  }
}

/// Subtracts u_ik x_k from the entries i above the diagonal of column k = rows.last, from rows.first on.
template <bool complex>
void subtract_above(const Columns& a, Range rows, double* __restrict re, double* __restrict im) {
  const std::size_t k = rows.last;
  const double* __restrict u = a.re + k * a.height, * __restrict v = complex ? a.im + k * a.height : nullptr;
  const double p = re[k], q = complex ? im[k] : 0;
  for (std::size_t i = rows.first; i < k; ++i) {
    if constexpr (complex) {
      re[i] -= p * u[i] - q * v[i];
      im[i] -= p * v[i] + q * u[i];
    } else {
      re[i] -= p * u[i];
    }
  }
}

/// The rows of a panel in C columns, which stay in registers.
template <std::size_t C, bool complex>
void solve_lower_panel(const Columns& a, std::size_t first, std::size_t column) {
  double re[C][panel], im[C][panel];
  for (std::size_t c = 0; c < C; ++c)
    for (std::size_t i = 0; i < panel; ++i) {
      re[c][i] = a.re[(column + c) * a.height + first + i];
      if constexpr (complex) im[c][i] = a.im[(column + c) * a.height + first + i];
    }
  for (std::size_t k = 0; k + 1 < panel; ++k) {
    const double* __restrict l = a.re + (first + k) * a.height + first;
    const double* __restrict m = complex ? a.im + (first + k) * a.height + first : nullptr;
    for (std::size_t c = 0; c < C; ++c) {
      const double p = re[c][k], q = complex ? im[c][k] : 0;
      for (std::size_t i = 0; i < panel; ++i) {
        if constexpr (complex) {
          const double x = re[c][i] - (p * l[i] - q * m[i]), y = im[c][i] - (p * m[i] + q * l[i]);
          re[c][i] = i > k ? x : re[c][i];
          im[c][i] = i > k ? y : im[c][i];
        } else {
          const double x = re[c][i] - p * l[i];
          re[c][i] = i > k ? x : re[c][i];
        }
      }
    }
  }
  for (std::size_t c = 0; c < C; ++c)
    for (std::size_t i = 0; i < panel; ++i) {
      a.re[(column + c) * a.height + first + i] = re[c][i];
      if constexpr (complex) a.im[(column + c) * a.height + first + i] = im[c][i];
    }
}

template <std::size_t C, bool complex>
std::size_t solve_lower_panels(const Columns& a, std::size_t first, Range columns) {
  std::size_t j = columns.first;
  for (; j + C <= columns.last; j += C) solve_lower_panel<C, complex>(a, first, j);
  return j;
}

/// L(k, k)⁻¹ A(k, columns) in the place of A(k, columns).
template <bool complex>
void solve_lower(const Columns& a, Range k, Range columns) {
  const std::size_t size = k.last - k.first;
  if (size == panel) {
    columns.first = solve_lower_panels<4, complex>(a, k.first, columns);
    solve_lower_panels<1, complex>(a, k.first, columns);
    return;
  }
  const std::size_t middle = k.first + (size / 2 + panel - 1) / panel * panel;
  solve_lower<complex>(a, {k.first, middle}, columns);
  subtract_product<complex>(a, {middle, k.last}, columns, {k.first, middle});
  solve_lower<complex>(a, {middle, k.last}, columns);
}

inline void exchange(double& x, double& y) {
  const double before = x;
  x = y;
  y = before;
}

/// The exchanges of rows of some steps, in other columns.
template <bool complex>
void exchange_rows(const Columns& a, const std::size_t* exchanged_with, Range steps, Range columns) {
  for (std::size_t j = columns.first; j < columns.last; ++j) {
    double* x = a.re + j * a.height;
    for (std::size_t k = steps.first; k < steps.last; ++k) exchange(x[k], x[exchanged_with[k]]);
    if constexpr (complex) {
      double* y = a.im + j * a.height;
      for (std::size_t k = steps.first; k < steps.last; ++k) exchange(y[k], y[exchanged_with[k]]);
    }
  }
}

template <bool complex>
double size_of(const Columns& a, std::size_t at) {
  return complex ? std::fabs(a.re[at]) + std::fabs(a.im[at]) : std::fabs(a.re[at]);
}

/// The row of the first of the largest entries of column k on or below the diagonal.
template <bool complex>
std::size_t row_of_pivot(const Columns& a, std::size_t k) {
  std::size_t largest = k;
  double size = size_of<complex>(a, k * a.height + k);
  for (std::size_t i = k + 1; i < a.n; ++i) {
    const double other = size_of<complex>(a, k * a.height + i);
    if (other > size) size = other, largest = i;
  }
  return largest;
}

/// The column below pivot k divided by it; of a complex one, the reciprocal is stored (R. L. Smith, Algorithm 116,
/// Comm. ACM 5, 1962).
template <bool complex>
void divide_by_pivot(const Columns& a, std::size_t k) {
  double* x = a.re + k * a.height;
  if constexpr (complex) {
    double* y = a.im + k * a.height;
    const double u = x[k], v = y[k];
    if (std::fabs(u) >= std::fabs(v)) {
      const double ratio = v / u, length = u + v * ratio;
      x[k] = 1 / length, y[k] = -ratio / length;
    } else {
      const double ratio = u / v, length = u * ratio + v;
      x[k] = ratio / length, y[k] = -1 / length;
    }
    const double p = x[k], q = y[k];
    for (std::size_t i = k + 1; i < a.n; ++i) {
      const double re = x[i] * p - y[i] * q, im = x[i] * q + y[i] * p;
      x[i] = re, y[i] = im;
    }
  } else {
    const double pivot = x[k];
    for (std::size_t i = k + 1; i < a.n; ++i) x[i] /= pivot;
  }
}

/// Elimination of a few columns, one by one.
template <bool complex>
bool factor_panel(const Columns& a, Range columns, std::size_t* exchanged_with) {
  for (std::size_t k = columns.first; k < columns.last; ++k) {
    exchanged_with[k] = row_of_pivot<complex>(a, k);
    exchange_rows<complex>(a, exchanged_with, {k, k + 1}, columns);
    const double size = size_of<complex>(a, k * a.height + k);
    if (!(size > 0) || !std::isfinite(size)) return false;
    divide_by_pivot<complex>(a, k);
    for (std::size_t j = k + 1; j < columns.last; ++j)
      subtract_below<complex>(a, k, a.n, a.re + j * a.height, complex ? a.im + j * a.height : nullptr);
  }
  return true;
}

template <bool complex>
bool factor_columns(const Columns& a, Range columns, std::size_t* exchanged_with) {
  const std::size_t count = columns.last - columns.first;
  if (count <= panel) return factor_panel<complex>(a, columns, exchanged_with);
  const std::size_t middle = columns.first + (count / 2 + panel - 1) / panel * panel;
  const Range left = {columns.first, middle}, right = {middle, columns.last};
  if (!factor_columns<complex>(a, left, exchanged_with)) return false;
  exchange_rows<complex>(a, exchanged_with, left, right);
  solve_lower<complex>(a, left, right);
  subtract_product<complex>(a, {middle, a.height}, right, left);
  if (!factor_columns<complex>(a, right, exchanged_with)) return false;
  exchange_rows<complex>(a, exchanged_with, right, left);
  return true;
}

/// L⁻¹ X in the place of X, C columns of the matrix from `column` on, a panel at a time.
template <std::size_t C, bool complex>
void solve_forward(const Columns& a, std::size_t column) {
  for (std::size_t first = 0; first < a.n; first += panel) {
    const Range k = {first, first + panel < a.n ? first + panel : a.n};
    for (std::size_t p = k.first; p < k.last; ++p)
      for (std::size_t j = column; j < column + C; ++j)
        subtract_below<complex>(a, p, k.last, a.re + j * a.height, complex ? a.im + j * a.height : nullptr);
    if (k.last < a.n) subtract_in_tall_tiles<C, complex, Order::ascending>(a, {k.last, a.height}, column, k);
  }
}

/// Row p of X divided by the pivot, and subtracted from the rows above in its panel.
template <bool complex>
void substitute(const Columns& a, std::size_t first, std::size_t p, std::size_t column) {
  double *re = a.re + column * a.height, *im = complex ? a.im + column * a.height : nullptr;
  const double u = a.re[p * a.height + p];
  if constexpr (complex) {
    const double v = a.im[p * a.height + p], x = re[p], y = im[p];
    re[p] = x * u - y * v, im[p] = x * v + y * u;
  } else {
    re[p] /= u;
  }
  subtract_above<complex>(a, {first, p}, re, im);
}

/// U⁻¹ X in the place of X.
template <std::size_t C, bool complex>
void solve_backward(const Columns& a, std::size_t column) {
  for (std::size_t first = (a.n - 1) / panel * panel + panel; first > 0;) {
    first -= panel;
    const Range k = {first, first + panel < a.n ? first + panel : a.n};
    for (std::size_t p = k.last; p-- > first;)
      for (std::size_t j = column; j < column + C; ++j) substitute<complex>(a, first, p, j);
    subtract_in_tall_tiles<C, complex, Order::descending>(a, {0, first}, column, k);
  }
}

template <bool complex>
bool factor_all(const Columns& a, std::size_t* exchanged_with) {
  return factor_columns<complex>(a, {0, a.n}, exchanged_with);
}

template <bool complex>
void solve_all(const Columns& a, const std::size_t* exchanged_with, std::size_t m) {
  if (a.n == 0) return;
  exchange_rows<complex>(a, exchanged_with, {0, a.n}, {a.n, a.n + m});
  side_by_side(m, [&a]<std::size_t C>(std::size_t j, Count<C>) {
    solve_forward<C, complex>(a, a.n + j);
    solve_backward<C, complex>(a, a.n + j);
  });
}

inline bool factor(const Columns& a, std::size_t* exchanged_with) {
  return a.im == nullptr ? factor_all<false>(a, exchanged_with) : factor_all<true>(a, exchanged_with);
}

inline void solve(const Columns& a, const std::size_t* exchanged_with, std::size_t m) {
  if (a.im == nullptr)
    solve_all<false>(a, exchanged_with, m);
  else
    solve_all<true>(a, exchanged_with, m);
}

}  // namespace invariode::elimination::INVARIODE_LANES
