#pragma once
// LU factors of small dense matrices by elimination with partial pivoting, a column at a time: no blocks and no calls,
// so that LAPACK is faster only from n ≈ 64 on, and the same operations in the same order on every processor.

#include <algorithm>
#include <cassert>
#include <cmath>
#include <complex>
#include <cstddef>
#include <numeric>
#include <type_traits>
#include <utility>
#include <vector>

#include "linear/side_by_side.hpp"
#include "weights.hpp"

namespace invariode {

/// Numbers at places 0, 1, … of an array: what elimination does with stretches of them.
template <class Scalar>
class Stretches;

template <>
class Stretches<double> {
 public:
  explicit Stretches(std::size_t size) : values_(size) {}

  void clear() { values_.assign(values_.size(), 0); }
  void add(std::size_t at, double value) { values_[at] += value; }
  void set(std::size_t at, double value) { values_[at] = value; }
  [[nodiscard]] double operator[](std::size_t at) const { return values_[at]; }
  [[nodiscard]] double size_of(std::size_t at) const { return std::abs(values_[at]); }
  void swap(std::size_t a, std::size_t b) { std::swap(values_[a], values_[b]); }
  [[nodiscard]] bool finite() const { return all_finite(values_.data(), values_.size()); }

  /// `stored` is the form in which a pivot is stored, `divided` a number divided by a stored pivot.
  static double stored(double pivot) { return pivot; }
  static double divided(double a, double pivot) { return a / pivot; }
  void divide(std::size_t from, std::size_t count, double pivot) {
    double* x = values_.data() + from;
    for (std::size_t i = 0; i < count; ++i) x[i] /= pivot;
  }
  void subtract(std::size_t from, double factor, const Stretches& other, std::size_t there) {
    values_[from] -= factor * other.values_[there];
  }
  /// Subtracts, from the stretch, `factor` times a stretch of `other`, which lies elsewhere.
  void subtract(std::size_t from, std::size_t count, double factor, const Stretches& other, std::size_t there) {
    double* __restrict x = values_.data() + from;
    const double* __restrict y = other.values_.data() + there;
    for (std::size_t i = 0; i < count; ++i) x[i] -= factor * y[i];
  }
  /// Subtracts one multiple of a stretch, then another: what two calls do, in one pass.
  void subtract(std::size_t from, std::size_t count, double first, std::size_t there, double second,
                std::size_t there_second, const Stretches& other) {
    double* __restrict x = values_.data() + from;
    const double* __restrict y = other.values_.data() + there;
    const double* __restrict z = other.values_.data() + there_second;
    for (std::size_t i = 0; i < count; ++i) x[i] = (x[i] - first * y[i]) - second * z[i];
  }

 private:
  std::vector<double> values_;
};

/// Real and imaginary parts in two arrays, whose loops become vector instructions.
template <>
class Stretches<std::complex<double>> {
 public:
  using Complex = std::complex<double>;

  explicit Stretches(std::size_t size) : re_(size), im_(size) {}

  void clear() {
    re_.assign(re_.size(), 0);
    im_.assign(im_.size(), 0);
  }
  void add(std::size_t at, Complex value) { set(at, (*this)[at] + value); }
  void set(std::size_t at, Complex value) {
    re_[at] = value.real();
    im_[at] = value.imag();
  }
  [[nodiscard]] Complex operator[](std::size_t at) const { return {re_[at], im_[at]}; }
  /// Within a factor √2, as in LAPACK.
  [[nodiscard]] double size_of(std::size_t at) const { return std::abs(re_[at]) + std::abs(im_[at]); }
  void swap(std::size_t a, std::size_t b) {
    std::swap(re_[a], re_[b]);
    std::swap(im_[a], im_[b]);
  }
  [[nodiscard]] bool finite() const { return all_finite(re_.data(), re_.size()) && all_finite(im_.data(), im_.size()); }

  /// The reciprocal, without overflow on the way (R. L. Smith, Algorithm 116, Comm. ACM 5, 1962).
  static Complex stored(Complex pivot) {
    const double a = pivot.real(), b = pivot.imag();
    if (std::abs(a) >= std::abs(b)) {
      const double ratio = b / a, length = a + b * ratio;
      return {1 / length, -ratio / length};
    }
    const double ratio = a / b, length = a * ratio + b;
    return {ratio / length, -1 / length};
  }
  static Complex divided(Complex a, Complex pivot) {
    return {a.real() * pivot.real() - a.imag() * pivot.imag(), a.real() * pivot.imag() + a.imag() * pivot.real()};
  }
  void divide(std::size_t from, std::size_t count, Complex pivot) {
    for (std::size_t i = from; i < from + count; ++i) set(i, divided((*this)[i], pivot));
  }
  void subtract(std::size_t from, Complex factor, const Stretches& other, std::size_t there) {
    const Complex x = (*this)[from], u = other[there];
    const double a = factor.real(), b = factor.imag();
    set(from, {x.real() - (a * u.real() - b * u.imag()), x.imag() - (a * u.imag() + b * u.real())});
  }
  void subtract(std::size_t from, std::size_t count, Complex factor, const Stretches& other, std::size_t there) {
    const double a = factor.real(), b = factor.imag();
    double* __restrict x = re_.data() + from, * __restrict y = im_.data() + from;
    const double* __restrict u = other.re_.data() + there, * __restrict v = other.im_.data() + there;
    for (std::size_t i = 0; i < count; ++i) {
      x[i] -= a * u[i] - b * v[i];
      y[i] -= a * v[i] + b * u[i];
    }
  }
  void subtract(std::size_t from, std::size_t count, Complex first, std::size_t there, Complex second,
                std::size_t there_second, const Stretches& other) {
    subtract(from, count, first, other, there);
    subtract(from, count, second, other, there_second);
  }

 private:
  std::vector<double> re_, im_;
};

/// A row of C columns side by side, in registers: real parts, then imaginary parts if there are any.
template <class Scalar, std::size_t C>
struct SideBySide {
  static constexpr bool complex = !std::is_same_v<Scalar, double>;
  static constexpr std::size_t doubles = complex ? 2 * C : C;
  double x[doubles];

  void set(std::size_t c, Scalar value) {
    x[c] = std::real(value);
    if constexpr (complex) x[C + c] = std::imag(value);
  }
  [[nodiscard]] Scalar operator[](std::size_t c) const {
    if constexpr (complex)
      return {x[c], x[C + c]};
    else
      return x[c];
  }
  void take(const double* from) {
    for (std::size_t i = 0; i < doubles; ++i) x[i] = from[i];
  }
  void put(double* to) const {
    for (std::size_t i = 0; i < doubles; ++i) to[i] = x[i];
  }
  /// Subtracts a times another row.
  void subtract(Scalar a, const SideBySide& other) {
    const double u = std::real(a), v = std::imag(a);
    for (std::size_t c = 0; c < C; ++c) {
      if constexpr (complex) {
        x[c] -= other.x[c] * u - other.x[C + c] * v;
        x[C + c] -= other.x[c] * v + other.x[C + c] * u;
      } else {
        x[c] -= other.x[c] * u;
      }
    }
  }
};

/// P A = L U, in the place of A.
template <class Scalar>
class DenseLu {
 public:
  explicit DenseLu(std::size_t n) : n_(n), a_(n * n), from_(n), x_(n), rows_(2 * most_side_by_side * n) {}

  void clear() { a_.clear(); }
  void add(std::size_t i, std::size_t j, Scalar value) { a_.add(place(i, j), value); }

  /// Replaces A by its factors, two columns at a time. Returns false if it is singular, or not finite.
  [[nodiscard]] bool factor() {
    std::iota(from_.begin(), from_.end(), std::size_t{0});
    for (std::size_t k = 0; k < n_; k += 2) {
      if (!make_column(k)) return false;
      if (k + 1 == n_) break;
      a_.subtract(place(k + 1, k + 1), n_ - k - 1, a_[place(k, k + 1)], a_, place(k + 1, k));
      if (!make_column(k + 1)) return false;
      for (std::size_t j = k + 2; j < n_; ++j) eliminate_two(k, a_, j * n_);
    }
    return a_.finite();
  }

  /// B becomes A⁻¹ B, m columns of n numbers one behind the other.
  void solve(Scalar* b, std::size_t m) {
    side_by_side(m,
                 [&]<std::size_t C>(std::size_t j, Count<C>) { solve_few(b + j * n_, Count<(C == 3 ? 4 : C)>(), C); });
  }

 private:
  using Numbers = Stretches<Scalar>;

  [[nodiscard]] std::size_t place(std::size_t i, std::size_t j) const {
    assert(i < n_ && j < n_);
    return j * n_ + i;
  }
  /// Column k of L, with its pivot on the diagonal. Returns false if that is 0, or not finite.
  bool make_column(std::size_t k) {
    if (!bring_up_pivot(k)) return false;
    const Scalar pivot = Numbers::stored(a_[place(k, k)]);
    a_.set(place(k, k), pivot);
    a_.divide(place(k, k) + 1, n_ - k - 1, pivot);
    return true;
  }
  /// One column, along which the instructions work.
  void solve_few(Scalar* b, Count<1> /*room*/, std::size_t /*columns*/) {
    for (std::size_t k = 0; k < n_; ++k) x_.set(k, b[from_[k]]);
    std::size_t k = 0;
    for (; k + 2 <= n_; k += 2) eliminate_two(k, x_, 0);
    for (k = n_; k >= 2; k -= 2) {
      const Scalar last = substituted(k - 1, b);
      x_.subtract(k - 2, last, a_, place(k - 2, k - 1));
      const Scalar before = substituted(k - 2, b);
      x_.subtract(0, k - 2, last, place(0, k - 1), before, place(0, k - 2), a_);
    }
    if (k == 1) substituted(0, b);
  }
  /// Several columns, across which they work: an entry takes its terms in the order of elimination. Three have the room
  /// of four, the first of them twice.
  template <std::size_t C>
  void solve_few(Scalar* __restrict b, Count<C> /*room*/, std::size_t columns) {
    constexpr std::size_t height = SideBySide<Scalar, C>::doubles;
    const std::size_t n = n_;
    double* const rows = rows_.data();
    SideBySide<Scalar, C> x, other;
    for (std::size_t i = 0; i < n; ++i) {
      for (std::size_t c = 0; c < C; ++c) x.set(c, b[(c < columns ? c : 0) * n + from_[i]]);
      for (std::size_t k = 0; k < i; ++k) {
        other.take(rows + k * height);
        x.subtract(a_[place(i, k)], other);
      }
      x.put(rows + i * height);
    }
    for (std::size_t i = n; i-- > 0;) {
      x.take(rows + i * height);
      for (std::size_t k = n; --k > i;) {
        other.take(rows + k * height);
        x.subtract(a_[place(i, k)], other);
      }
      for (std::size_t c = 0; c < C; ++c) x.set(c, Stretches<Scalar>::divided(x[c], a_[place(i, i)]));
      x.put(rows + i * height);
      for (std::size_t c = 0; c < C; ++c)
        if (c < columns) b[c * n + i] = x[c];
    }
  }
  /// Subtracts x_k times column k of L from the x below, then x_{k+1} times the next one. x begins at that place.
  void eliminate_two(std::size_t k, Numbers& x, std::size_t at) {
    const Scalar first = x[at + k];
    x.subtract(at + k + 1, first, a_, place(k + 1, k));
    const Scalar second = x[at + k + 1];
    if (k + 2 < n_) x.subtract(at + k + 2, n_ - k - 2, first, place(k + 2, k), second, place(k + 2, k + 1), a_);
  }
  /// x_k of the solution, when the later ones have been subtracted; it is kept in b.
  Scalar substituted(std::size_t k, Scalar* b) {
    x_.set(k, Numbers::divided(x_[k], a_[place(k, k)]));
    return b[k] = x_[k];
  }
  /// The largest entry of column k on or below the diagonal, by exchange of rows. False: it is 0, or not finite.
  bool bring_up_pivot(std::size_t k) {
    std::size_t largest = k;
    for (std::size_t i = k + 1; i < n_; ++i)
      if (a_.size_of(place(i, k)) > a_.size_of(place(largest, k))) largest = i;
    std::swap(from_[k], from_[largest]);
    if (largest != k)
      for (std::size_t j = 0; j < n_; ++j) a_.swap(place(k, j), place(largest, j));
    const double size = a_.size_of(place(k, k));
    return size > 0 && std::isfinite(size);
  }

  std::size_t n_;
  Numbers a_;
  std::vector<std::size_t> from_;  // the rows of A in the order of their pivots
  Numbers x_;
  std::vector<double> rows_;  // of columns side by side
};

}  // namespace invariode
