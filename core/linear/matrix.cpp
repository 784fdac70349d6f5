#include "linear/matrix.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <complex>
#include <numeric>
#include <optional>
#include <type_traits>
#include <utility>

#include "linear/dense_lu.hpp"
#include "linear/elimination/elimination.hpp"
#include "linear/narrow_band.hpp"
#include "linear/sparse_lu.hpp"
#include "weights.hpp"

namespace invariode {
namespace {

// Measured in benchmarks/jacobians.py: elimination in blocks is faster than by columns from the first n on, and no
// slower than LAPACK on one thread up to the last. LAPACK's threads gain nothing there, and wait for each other by
// spinning: with another process on the processor a factorisation took 20 times as long.
constexpr std::size_t dense_in_blocks = 24, dense_by_lapack = 513;
constexpr std::size_t narrow_band = 24;  // lower + upper, up to which LAPACK's banded LU is slower than ours

bool finite(const std::vector<double>& v) { return all_finite(v.data(), v.size()); }
bool finite(const std::vector<std::complex<double>>& v) {
  return all_finite(reinterpret_cast<const double*>(v.data()), 2 * v.size());  // pairs, as the standard says
}

/// A = M − c J, in a matrix of zeros; add(i, j, value) adds to its entry.
template <class Scalar, class Add>
void assemble(const Matrix* mass, Scalar c, const Matrix& jacobian, Add add) {
  if (mass)
    mass->for_each([&](std::size_t i, std::size_t j, double m) { add(i, j, m); });
  else
    for (std::size_t i = 0; i < jacobian.n(); ++i) add(i, i, 1);
  jacobian.for_each([&](std::size_t i, std::size_t j, double value) { add(i, j, -(c * value)); });
}

/// A = M − c J of a dense J by columns of a given height, a tile at a time: J is stored by rows. set(place, value)
/// writes an entry.
template <class Scalar, class Set>
void assemble_columns(const Matrix* mass, Scalar c, const Matrix& jacobian, std::size_t height, Set set) {
  constexpr std::size_t tile = 16;
  const std::size_t n = jacobian.n();
  const bool dense_mass = mass && mass->structure.kind == Structure::Kind::dense;
  for (std::size_t first_j = 0; first_j < n; first_j += tile)
    for (std::size_t first_i = 0; first_i < n; first_i += tile)
      for (std::size_t j = first_j; j < std::min(first_j + tile, n); ++j)
        for (std::size_t i = first_i; i < std::min(first_i + tile, n); ++i) {
          const double m = dense_mass ? mass->values[i * n + j] : !mass && i == j ? 1 : 0;
          set(j * height + i, m - c * jacobian.values[i * n + j]);
        }
  if (mass && !dense_mass)
    mass->for_each(
        [&](std::size_t i, std::size_t j, double m) { set(j * height + i, m - c * jacobian.values[i * n + j]); });
}

/// y = A x for rows of n numbers, several at a time: the terms of each sum are added in order, so that a single sum
/// would wait for each addition.
void multiply_rows(const double* a, std::size_t n, const double* x, double* y) {
  constexpr std::size_t side = 8;
  std::size_t i = 0;
  for (; i + side <= n; i += side, a += side * n) {
    std::array<double, side> sum{};
    for (std::size_t j = 0; j < n; ++j)
      for (std::size_t k = 0; k < side; ++k) sum[k] += a[k * n + j] * x[j];
    std::copy(sum.begin(), sum.end(), y + i);
  }
  for (; i < n; ++i, a += n) {
    double sum = 0;
    for (std::size_t j = 0; j < n; ++j) sum += a[j] * x[j];
    y[i] = sum;
  }
}

/// LU of small matrices, which cost no call.
template <class Scalar>
class DenseByColumns final : public Factors<Scalar> {
 public:
  explicit DenseByColumns(std::size_t n) : lu_(n) {}

  bool factor(const Matrix* mass, Scalar c, const Matrix& jacobian) override {
    lu_.clear();
    assemble(mass, c, jacobian, [this](std::size_t i, std::size_t j, Scalar value) { lu_.add(i, j, value); });
    return lu_.factor();
  }

  void solve(Scalar* b, std::size_t m) override { lu_.solve(b, m); }

 private:
  DenseLu<Scalar> lu_;
};

/// LU by our own kernels, on this thread alone.
template <class Scalar>
class DenseInBlocks final : public Factors<Scalar> {
  static constexpr bool complex = !std::is_same_v<Scalar, double>;

 public:
  explicit DenseInBlocks(std::size_t n) : n_(n), height_(height_for(n)), exchanged_with_(n) {}

  bool factor(const Matrix* mass, Scalar c, const Matrix& jacobian) override {
    assert(jacobian.n() == n_);
    re_.resize(height_ * (n_ + most_side_by_side));
    if constexpr (complex) im_.resize(re_.size());
    assemble_columns(mass, c, jacobian, height_, [this](std::size_t at, Scalar value) { set(at, value); });
    return kernel_.factor(columns(), exchanged_with_.data()) && all_finite(re_.data(), height_ * n_) &&
           all_finite(im_.data(), complex ? height_ * n_ : 0);
  }

  void solve(Scalar* b, std::size_t m) override {
    for (; m > most_side_by_side; m -= most_side_by_side, b += most_side_by_side * n_) solve_few(b, most_side_by_side);
    solve_few(b, m);
  }

 private:
  /// The height of the columns: no multiple of 64, which would put all entries of a row into the same few places of the
  /// cache.
  static std::size_t height_for(std::size_t n) {
    const std::size_t height =
        (n + elimination::row_multiple - 1) / elimination::row_multiple * elimination::row_multiple;
    return height % 64 == 0 ? height + elimination::row_multiple : height;
  }
  void solve_few(Scalar* b, std::size_t m) {
    for (std::size_t j = 0; j < m; ++j)
      for (std::size_t i = 0; i < n_; ++i) set((n_ + j) * height_ + i, b[j * n_ + i]);
    kernel_.solve(columns(), exchanged_with_.data(), m);
    for (std::size_t j = 0; j < m; ++j)
      for (std::size_t i = 0; i < n_; ++i) {
        const std::size_t at = (n_ + j) * height_ + i;
        if constexpr (complex)
          b[j * n_ + i] = {re_[at], im_[at]};
        else
          b[j * n_ + i] = re_[at];
      }
  }
  [[nodiscard]] elimination::Columns columns() {
    return {.n = n_, .height = height_, .re = re_.data(), .im = complex ? im_.data() : nullptr};
  }
  void set(std::size_t at, Scalar value) {
    if constexpr (complex) {
      re_[at] = value.real();
      im_[at] = value.imag();
    } else {
      re_[at] = value;
    }
  }

  const elimination::Kernel& kernel_ = *elimination::kernels().front();
  std::size_t n_, height_;
  std::vector<double> re_, im_;  // of a method that may never need them: made when it does
  std::vector<std::size_t> exchanged_with_;
};

/// LU by LAPACK for some columns at a time, so that a long factorisation can be given up (`Lapack::poll`): the
/// recursion of elimination/kernel.hpp, whose updates of the right half go by blocks of columns.
template <class Scalar>
class DenseByLapack final : public Factors<Scalar> {
 public:
  DenseByLapack(std::size_t n, const Lapack& lapack)
      : lapack_(lapack.of(Scalar())), poll_(lapack.poll), n_(static_cast<int>(n)), pivots_(n) {}

  bool factor(const Matrix* mass, Scalar c, const Matrix& jacobian) override {
    const auto n = static_cast<std::size_t>(n_);
    assert(jacobian.n() == n);
    lu_.resize(n * n);
    assemble_columns(mass, c, jacobian, n, [this](std::size_t at, Scalar value) { lu_[at] = value; });
    return finite(lu_) && factor_columns(0, n_);
  }

  /// One column at a time: for several, a BLAS may sum in another order.
  void solve(Scalar* b, std::size_t m) override {
    char as_it_is = 'N';
    int one = 1, info = 0;
    for (std::size_t j = 0; j < m; ++j, b += n_)
      lapack_.solve(&as_it_is, &n_, &one, lu_.data(), &n_, pivots_.data(), b, &n_, &info);
  }

 private:
  // Columns that LAPACK eliminates at a time, and products in one update: about 0.1 s on one thread. Narrower ones cost
  // more than 2 % at n = 2000.
  static constexpr int panel = 384, narrowest_update = panel / 4;
  static constexpr double longest_update = std::is_same_v<Scalar, double> ? 2e9 : 5e8;

  Scalar* place(int i, int j) {
    return lu_.data() + static_cast<std::size_t>(j) * static_cast<std::size_t>(n_) + static_cast<std::size_t>(i);
  }

  /// Eliminates the columns from `first` to before `last`, on and below row `first`. Returns false if a pivot is 0.
  bool factor_columns(int first, int last) {
    if (poll_) poll_();
    int rows = n_ - first, columns = last - first, info = 0;
    if (columns <= panel) {
      lapack_.factor(&rows, &columns, place(first, first), &n_, &pivots_[static_cast<std::size_t>(first)], &info);
      for (int k = first; k < last; ++k) pivots_[static_cast<std::size_t>(k)] += first;  // rows of the whole, from 1 on
      return info == 0;
    }
    const int middle = first + (columns / 2 + panel - 1) / panel * panel;
    if (!factor_columns(first, middle)) return false;
    const double per_column = static_cast<double>(middle - first) * (n_ - middle);
    const int width =
        static_cast<int>(std::max<double>(narrowest_update, std::min<double>(n_, longest_update / per_column)));
    for (int j = middle; j < last; j += width) update(first, middle, j, std::min(j + width, last));
    if (!factor_columns(middle, last)) return false;
    exchange(middle, last, first, middle);
    return true;
  }

  /// Makes the rows of U that belong to eliminated columns k, from `first` to before `middle`, and subtracts their
  /// product with L below, in the columns from `from` to before `end`.
  void update(int first, int middle, int from, int end) {
    if (poll_) poll_();
    exchange(first, middle, from, end);
    char left = 'L', as_it_is = 'N', unit = 'U';
    Scalar one = 1, minus_one = -1;
    int columns = end - from, size = middle - first, below = n_ - middle;
    lapack_.solve_triangle(&left, &left, &as_it_is, &unit, &size, &columns, &one, place(first, first), &n_,
                           place(first, from), &n_);
    lapack_.multiply(&as_it_is, &as_it_is, &below, &columns, &size, &minus_one, place(middle, first), &n_,
                     place(first, from), &n_, &one, place(middle, from), &n_);
  }

  /// Exchanges rows as the elimination of the columns from `first` to before `last` has, in other columns.
  void exchange(int first, int last, int from, int end) {
    int columns = end - from, begin = first + 1, step = 1;  // rows count from 1 on
    lapack_.exchange(&columns, place(0, from), &n_, &begin, &last, pivots_.data(), &step);
  }

  LapackOf<Scalar> lapack_;
  std::function<void()> poll_;
  int n_;
  std::vector<Scalar> lu_;  // of a method that may never need it: made when it is
  std::vector<int> pivots_;
};

template <class Scalar>
class BandedByRows final : public Factors<Scalar> {
 public:
  explicit BandedByRows(const Structure& s) : structure_(s) {}

  bool factor(const Matrix* mass, Scalar c, const Matrix& jacobian) override {
    if (A_)
      A_->clear();
    else
      A_.emplace(structure_.n, structure_.lower, structure_.upper);
    assemble(mass, c, jacobian, [this](std::size_t i, std::size_t j, Scalar value) { A_->at(i, j) += value; });
    return finite(A_->entries()) && A_->factor();
  }

  void solve(Scalar* b, std::size_t m) override {
    assert(A_);
    A_->solve(b, m);
  }

 private:
  Structure structure_;
  std::optional<NarrowBand<Scalar>> A_;  // made when it is needed, which may be never
};

template <class Scalar>
class BandedByLapack final : public Factors<Scalar> {
 public:
  BandedByLapack(const Structure& s, const LapackOf<Scalar>& lapack)
      : lapack_(lapack),
        n_(static_cast<int>(s.n)),
        lower_(static_cast<int>(s.lower)),
        upper_(static_cast<int>(s.upper)),
        rows_(2 * lower_ + upper_ + 1),
        lu_(static_cast<std::size_t>(rows_) * s.n),
        pivots_(s.n) {}

  bool factor(const Matrix* mass, Scalar c, const Matrix& jacobian) override {
    assert(jacobian.n() == pivots_.size());
    const auto rows = static_cast<std::size_t>(rows_), top = rows - static_cast<std::size_t>(lower_) - 1;
    const auto add = [&](std::size_t i, std::size_t j, Scalar value) { lu_[j * rows + top + i - j] += value; };
    std::fill(lu_.begin(), lu_.end(), 0);
    assemble(mass, c, jacobian, add);
    if (!finite(lu_)) return false;
    int info = 0;
    lapack_.factor_band(&n_, &n_, &lower_, &upper_, lu_.data(), &rows_, pivots_.data(), &info);
    return info == 0;
  }

  void solve(Scalar* b, std::size_t m) override {  // see DenseByLapack
    char as_it_is = 'N';
    int one = 1, info = 0;
    for (std::size_t j = 0; j < m; ++j, b += n_)
      lapack_.solve_band(&as_it_is, &n_, &lower_, &upper_, &one, lu_.data(), &rows_, pivots_.data(), b, &n_, &info);
  }

 private:
  LapackOf<Scalar> lapack_;
  int n_, lower_, upper_;
  int rows_;  // of the band with room for the fill-in
  std::vector<Scalar> lu_;
  std::vector<int> pivots_;
};

/// LU on the union of the patterns of M and J, analysed again only when that changes. These matrices have a full
/// diagonal and are nearly symmetric in pattern: the minimum degree order of A + Aᵀ has half the fill-in of a column
/// ordering.
template <class Scalar>
class SparseByFronts final : public Factors<Scalar> {
 public:
  bool factor(const Matrix* mass, Scalar c, const Matrix& jacobian) override {
    if (!analysed_ || with_mass_ != (mass != nullptr) || !jacobian.same_pattern(jacobian_) ||
        (mass && !mass->same_pattern(mass_)))
      analyse(mass, jacobian);
    std::fill(A_.begin(), A_.end(), Scalar(0));
    std::size_t p = 0;
    if (mass)
      mass->for_each([&](std::size_t, std::size_t, double m) { A_[of_mass_[p++]] += m; });
    else
      for (; p < of_mass_.size(); ++p) A_[of_mass_[p]] += 1;
    p = 0;
    jacobian.for_each([&](std::size_t, std::size_t, double v) { A_[of_jacobian_[p++]] -= c * v; });
    assert(p == of_jacobian_.size());
    return finite(A_) && lu_.factor(A_);
  }

  void solve(Scalar* b, std::size_t m) override { lu_.solve(b, m); }

 private:
  void analyse(const Matrix* mass, const Matrix& jacobian) {
    analysed_ = false;
    const std::size_t n = jacobian.n();
    std::vector<std::pair<std::size_t, std::size_t>> entries;  // (column, row)
    const auto add = [&](std::size_t i, std::size_t j, double) { entries.emplace_back(j, i); };
    const auto visit_mass = [&](auto&& visit) {
      if (mass)
        mass->for_each(visit);
      else
        for (std::size_t i = 0; i < n; ++i) visit(i, i, 1.0);
    };
    jacobian.for_each(add);
    visit_mass(add);
    std::ranges::sort(entries);
    const auto repeated = std::ranges::unique(entries);
    entries.erase(repeated.begin(), repeated.end());
    Pattern pattern{std::vector<int>(n + 1, 0), {}};
    pattern.rows.reserve(entries.size());
    for (const auto& [j, i] : entries) {
      ++pattern.starts[j + 1];
      pattern.rows.push_back(static_cast<int>(i));
    }
    std::partial_sum(pattern.starts.begin(), pattern.starts.end(), pattern.starts.begin());
    const auto find = [&](std::size_t i, std::size_t j) {
      const auto first = pattern.rows.begin() + pattern.starts[j], last = pattern.rows.begin() + pattern.starts[j + 1];
      return static_cast<std::size_t>(std::lower_bound(first, last, static_cast<int>(i)) - pattern.rows.begin());
    };
    of_jacobian_.clear();
    of_mass_.clear();
    jacobian.for_each([&](std::size_t i, std::size_t j, double) { of_jacobian_.push_back(find(i, j)); });
    visit_mass([&](std::size_t i, std::size_t j, double) { of_mass_.push_back(find(i, j)); });
    A_.resize(entries.size());
    jacobian_.starts = jacobian.starts, jacobian_.rows = jacobian.rows;
    if (mass) mass_.starts = mass->starts, mass_.rows = mass->rows;
    lu_.analyse(pattern);
    with_mass_ = mass != nullptr;
    analysed_ = true;
  }

  std::vector<Scalar> A_;  // its entries
  SparseLu<Scalar> lu_;
  std::vector<std::size_t> of_jacobian_, of_mass_;  // where their entries go among those of A
  Matrix jacobian_, mass_;                          // the patterns that were analysed
  bool analysed_ = false, with_mass_ = false;
};

}  // namespace

Matrix::Matrix(const Structure& of) : Matrix(without_values(of)) { provide(); }

Matrix Matrix::without_values(const Structure& of) {
  Matrix matrix;
  matrix.structure = of;
  if (of.kind == Structure::Kind::sparse) matrix.starts.resize(of.n + 1);
  return matrix;
}

std::size_t Matrix::size() const {
  const auto& [kind, n, lower, upper] = structure;
  switch (kind) {
    case Structure::Kind::dense: return n * n;
    case Structure::Kind::banded: return (lower + upper + 1) * n;
    default: return rows.size();
  }
}

void Matrix::provide() {
  if (values.empty()) values.resize(size());
}

void Matrix::multiply(const double* x, double* y) const {
  assert(x != y || n() == 0);
  if (structure.kind == Structure::Kind::dense) return multiply_rows(values.data(), n(), x, y);
  std::fill(y, y + n(), 0);
  for_each([&](std::size_t i, std::size_t j, double a) { y[i] += a * x[j]; });
}

bool by_lapack(const Structure& structure) {
  return structure.kind == Structure::Kind::dense    ? structure.n >= dense_by_lapack
         : structure.kind == Structure::Kind::banded ? structure.lower + structure.upper > narrow_band
                                                     : false;
}

template <class Scalar>
std::unique_ptr<Factors<Scalar>> make_factors(const Structure& structure, const Lapack* lapack) {
  const bool routines = lapack && by_lapack(structure);
  if (structure.kind == Structure::Kind::dense) {
    if (routines) return std::make_unique<DenseByLapack<Scalar>>(structure.n, *lapack);
    if (structure.n >= dense_in_blocks) return std::make_unique<DenseInBlocks<Scalar>>(structure.n);
    return std::make_unique<DenseByColumns<Scalar>>(structure.n);
  }
  const bool narrow = structure.lower + structure.upper <= narrow_band;
  if (structure.kind == Structure::Kind::banded && narrow) return std::make_unique<BandedByRows<Scalar>>(structure);
  if (structure.kind == Structure::Kind::banded && routines)
    return std::make_unique<BandedByLapack<Scalar>>(structure, lapack->of(Scalar()));
  return std::make_unique<SparseByFronts<Scalar>>();
}

template std::unique_ptr<Factors<double>> make_factors(const Structure&, const Lapack*);
template std::unique_ptr<Factors<std::complex<double>>> make_factors(const Structure&, const Lapack*);

}  // namespace invariode
