#include "methods/radau_formula.hpp"

#include <algorithm>

namespace invariode {
namespace {

using Complex = RadauFormula::Complex;

template <std::size_t s>
using Row = std::array<double, s>;
template <std::size_t s>
using Square = std::array<Row<s>, s>;

constexpr double absolute(double x) { return x < 0 ? -x : x; }

template <std::size_t s>
constexpr Square<s> product(const Square<s>& a, const Square<s>& b) {
  Square<s> c{};
  for (std::size_t i = 0; i < s; ++i)
    for (std::size_t j = 0; j < s; ++j)
      for (std::size_t k = 0; k < s; ++k) c[i][j] += a[i][k] * b[k][j];
  return c;
}

/// Gauss-Jordan elimination with row pivots.
template <std::size_t s>
constexpr Square<s> inverse(Square<s> a) {
  Square<s> b{};
  for (std::size_t i = 0; i < s; ++i) b[i][i] = 1;
  for (std::size_t k = 0; k < s; ++k) {
    std::size_t pivot = k;
    for (std::size_t i = k + 1; i < s; ++i)
      if (absolute(a[i][k]) > absolute(a[pivot][k])) pivot = i;
    std::swap(a[k], a[pivot]);
    std::swap(b[k], b[pivot]);
    const double scale = a[k][k];
    for (std::size_t j = 0; j < s; ++j) a[k][j] /= scale, b[k][j] /= scale;
    for (std::size_t i = 0; i < s; ++i) {
      if (i == k) continue;
      const double factor = a[i][k];
      for (std::size_t j = 0; j < s; ++j) a[i][j] -= factor * a[k][j], b[i][j] -= factor * b[k][j];
    }
  }
  return b;
}

/// The numbers that define a formula: c, the zeros of d^{s−1}/dx^{s−1} x^{s−1} (x − 1)^s, and the eigenvalues of A⁻¹,
/// to more digits than a double has.
template <std::size_t s>
struct Numbers {
  Row<s> c;
  double mu;
  std::array<Complex, s / 2> pairs;
};

constexpr Numbers<3> three{.c = {0.15505102572168219018, 0.64494897427831780982, 1},
                           .mu = 3.63783425274449573221,
                           .pairs = {{{2.6810828736277521339, 3.05043019924741056943}}}};
constexpr Numbers<5> five{
    .c = {0.0571041961145176821931, 0.27684301363812382768, 0.583590432368916820057, 0.860240135656219447848, 1},
    .mu = 6.28670475172927664517,
    .pairs = {{{5.70095329867178941917, 3.21026560030854988843}, {3.65569432546357225824, 6.54373689936007729402}}}};
constexpr Numbers<7> seven{.c = {0.0293164271597848919721, 0.14807859966848429185, 0.336984690281154299097,
                                 0.558671518771550132081, 0.769233862030054500917, 0.926945671319741114852, 1},
                           .mu = 8.9368327884052163373,
                           .pairs = {{{8.51183482510294572305, 3.28101362432505883004},
                                      {7.14105521918764010577, 6.62304592263927597062},
                                      {4.37869356150680600252, 10.1696932837950116273}}}};

/// Row i of the matrix that differentiates polynomials of degree s at 0, c_1 … c_s, given there (barycentric form).
template <std::size_t s>
constexpr Row<s + 1> derivative(const Row<s>& c, std::size_t i) {
  Row<s + 1> x{}, weight{}, row{};
  std::copy(c.begin(), c.end(), x.begin() + 1);
  for (std::size_t j = 0; j <= s; ++j) {
    weight[j] = 1;
    for (std::size_t k = 0; k <= s; ++k)
      if (k != j) weight[j] /= x[j] - x[k];
  }
  for (std::size_t j = 0; j <= s; ++j) {
    if (j == i) continue;
    row[j] = weight[j] / weight[i] / (x[i] - x[j]);
    row[i] += 1 / (x[i] - x[j]);
  }
  return row;
}

/// Row i less its first entry, since increments are 0 at 0.
template <std::size_t s>
constexpr Row<s> derivative_of_increments(const Row<s>& c, std::size_t i) {
  const Row<s + 1> row = derivative(c, i);
  Row<s> rest{};
  std::copy(row.begin() + 1, row.end(), rest.begin());
  return rest;
}

/// The x in [0, 1] at which |x ∏ (x − c_i)| is largest, to a thousandth.
template <std::size_t s>
constexpr double farthest_from(const Row<s>& c) {
  constexpr int parts = 1000;
  double where = 0, largest = 0;
  for (int k = 1; k < parts; ++k) {
    const double x = static_cast<double>(k) / parts;
    double size = x;
    for (const double node : c) size *= absolute(x - node);
    if (size > largest) where = x, largest = size;
  }
  return where;
}

/// Weights of increments in the polynomial of degree s through 0 and them, and in its derivative, at x between nodes.
template <std::size_t s>
struct Between {
  Row<s> value{}, slope{};

  constexpr Between(const Row<s>& c, double x) {
    for (std::size_t j = 0; j < s; ++j) {
      double weight = x / c[j], sum = 1 / x;
      for (std::size_t k = 0; k < s; ++k)
        if (k != j) weight *= (x - c[k]) / (c[j] - c[k]), sum += 1 / (x - c[k]);
      value[j] = weight;
      slope[j] = weight * sum;
    }
  }
};

/// M^{(j)}(x) of M(x) = ∏ (x − c_i), j = 0 … s.
template <std::size_t s>
constexpr Row<s + 1> derivatives(const Row<s>& c, double x) {
  Row<s + 1> taylor{1};  // of the product so far, in powers of a distance from x
  for (std::size_t i = 0; i < s; ++i)
    for (std::size_t j = i + 2; j-- > 0;) taylor[j] = (x - c[i]) * taylor[j] + (j > 0 ? taylor[j - 1] : 0);
  double factorial = 1;
  for (std::size_t j = 1; j <= s; ++j) taylor[j] *= factorial *= static_cast<double>(j);
  return taylor;
}

/// Real and imaginary part of a vector. (Not every compiler multiplies std::complex in constant expressions.)
template <std::size_t s>
struct ComplexRow {
  Row<s> real{}, imaginary{};

  constexpr void multiply(std::size_t i, double a, double b) {
    const double x = real[i], y = imaginary[i];
    real[i] = a * x - b * y;
    imaginary[i] = a * y + b * x;
  }
};

/// The eigenvector of A⁻¹ for μ, 1 in its last stage: a polynomial p of degree s with p' − μ p = κ M has, but for a
/// factor, p = Σ_j M^{(j)} μ^{s−j}, and M = 0 at the nodes. (p(0) = 0 is the equation of the eigenvalues.)
template <std::size_t s>
constexpr ComplexRow<s> eigenvector(const Row<s>& c, Complex mu) {
  ComplexRow<s> v;
  for (std::size_t i = 0; i < s; ++i) {
    const Row<s + 1> M = derivatives(c, c[i]);
    for (std::size_t j = 1; j <= s; ++j) {
      v.multiply(i, mu.real(), mu.imag());
      v.real[i] += M[j];
    }
  }
  const double a = v.real[s - 1], b = v.imaginary[s - 1], size = a * a + b * b;
  for (std::size_t i = 0; i < s; ++i) v.multiply(i, a / size, -b / size);
  return v;
}

/// θ, θ (1 − θ), θ² (1 − θ), …: what the coefficients of a nested polynomial multiply.
template <std::size_t s>
constexpr Row<s> nested_basis(double theta) {
  Row<s> basis{theta};
  for (std::size_t k = 1; k < s; ++k) basis[k] = basis[k - 1] * (k % 2 == 1 ? 1 - theta : theta);
  return basis;
}

template <std::size_t s>
struct Matrices {
  Square<s> A_inverse{}, T{}, T_inverse{}, coefficients{};
  Row<s> initial_slope{};
  double farthest;
  Between<s> there;

  constexpr explicit Matrices(const Numbers<s>& of)
      : initial_slope(derivative_of_increments(of.c, 0)), farthest(farthest_from(of.c)), there(of.c, farthest) {
    const ComplexRow<s> first = eigenvector(of.c, of.mu);
    for (std::size_t i = 0; i < s; ++i) {
      A_inverse[i] = derivative_of_increments(of.c, i + 1);
      coefficients[i] = nested_basis<s>(of.c[i]);
      T[i][0] = first.real[i];
    }
    for (std::size_t k = 0; k < of.pairs.size(); ++k) {
      const ComplexRow<s> v = eigenvector(of.c, of.pairs[k]);
      for (std::size_t i = 0; i < s; ++i) T[i][2 * k + 1] = v.real[i], T[i][2 * k + 2] = v.imaginary[i];
    }
    T_inverse = inverse(T);
    coefficients = inverse(coefficients);
  }
};

template <std::size_t s>
constexpr double distance(const Square<s>& a, const Square<s>& b) {
  double largest = 0;
  for (std::size_t i = 0; i < s; ++i)
    for (std::size_t j = 0; j < s; ++j) largest = std::max(largest, absolute(a[i][j] - b[i][j]));
  return largest;
}

/// T⁻¹ A⁻¹ T = diag(μ, (α β; −β α), …)
template <std::size_t s>
constexpr bool is_diagonal(const Numbers<s>& of, const Matrices<s>& matrices) {
  Square<s> blocks{};
  blocks[0][0] = of.mu;
  for (std::size_t k = 0; k < of.pairs.size(); ++k) {
    const std::size_t i = 2 * k + 1;
    blocks[i][i] = blocks[i + 1][i + 1] = of.pairs[k].real();
    blocks[i][i + 1] = of.pairs[k].imag();
    blocks[i + 1][i] = -of.pairs[k].imag();
  }
  constexpr double enough = 1e-10;  // T only steers Newton's iteration
  return distance(product(matrices.T_inverse, product(matrices.A_inverse, matrices.T)), blocks) < enough;
}

/// Σ b_i c_i^k = 1 / (k + 1) for k < 2 s − 1, where b is the last row of A: with collocation, that order.
template <std::size_t s>
constexpr bool has_its_order(const Numbers<s>& of, const Matrices<s>& matrices) {
  constexpr double roundoff = 1e-14;
  const Square<s> A = inverse(matrices.A_inverse);
  Row<s> power{};
  power.fill(1);
  for (std::size_t k = 0; k + 1 < 2 * s; ++k) {
    double sum = -1.0 / static_cast<double>(k + 1);
    for (std::size_t i = 0; i < s; ++i) {
      sum += A[s - 1][i] * power[i];
      power[i] *= of.c[i];
    }
    if (absolute(sum) > roundoff) return false;
  }
  return true;
}

/// Σ_i v_i c_i^k = θ^k and Σ_i d_i c_i^k = k θ^{k−1} for k = 1 … s: the polynomial and its slope at θ.
template <std::size_t s>
constexpr bool interpolates(const Numbers<s>& of, const Matrices<s>& matrices) {
  constexpr double roundoff = 1e-13;
  const double theta = matrices.farthest;
  Row<s> power = of.c;
  double before = 1;  // θ^{k−1}
  for (std::size_t k = 1; k <= s; ++k) {
    double value = -theta * before, slope = -static_cast<double>(k) * before;
    for (std::size_t i = 0; i < s; ++i) {
      value += matrices.there.value[i] * power[i];
      slope += matrices.there.slope[i] * power[i];
      power[i] *= of.c[i];
    }
    if (absolute(value) > roundoff || absolute(slope) > roundoff) return false;
    before *= theta;
  }
  return true;
}

template <const auto& of, std::size_t s = of.c.size()>
constexpr Matrices<s> matrices{of};

/// So many components at once, each with its terms in the order of j.
template <std::size_t s, std::size_t width>
void transform_some(const double* matrix, std::size_t n, const double* in, double* out) {
  double v[s][width];
  for (std::size_t j = 0; j < s; ++j)
    for (std::size_t l = 0; l < width; ++l) v[j][l] = in[j * n + l];
  for (std::size_t k = 0; k < s; ++k) {
    double sum[width] = {};
    for (std::size_t j = 0; j < s; ++j)
      for (std::size_t l = 0; l < width; ++l) sum[l] += matrix[k * s + j] * v[j][l];
    for (std::size_t l = 0; l < width; ++l) out[k * n + l] = sum[l];
  }
}

template <std::size_t s>
void transform(const double* matrix, std::size_t n, std::size_t first, std::size_t end, const double* in, double* out) {
  constexpr std::size_t width = 8;
  std::size_t i = first;
  for (; i + width <= end; i += width) transform_some<s, width>(matrix, n, in + i, out + i);
  for (; i < end; ++i) transform_some<s, 1>(matrix, n, in + i, out + i);
}

template <const auto& of>
constexpr RadauFormula formula() noexcept {
  constexpr std::size_t s = of.c.size();
  constexpr const Matrices<s>& m = matrices<of>;
  static_assert(is_diagonal(of, m) && has_its_order(of, m) && interpolates(of, m));
  return {s,           of.c.data(),          m.A_inverse[0].data(), of.mu,
          of.pairs,    m.T[0].data(),        m.T_inverse[0].data(), m.initial_slope.data(),
          m.farthest,  m.there.value.data(), m.there.slope.data(),  m.coefficients[0].data(),
          transform<s>};
}

}  // namespace

constinit const std::array<RadauFormula, radau_formula_count> radau_formulas{formula<three>(), formula<five>(),
                                                                             formula<seven>()};

}  // namespace invariode
