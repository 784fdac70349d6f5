#pragma once
// An explicit Runge-Kutta pair as data that checks itself: row sums, order conditions of both formulas and of the
// continuous extension, FSAL, and that the extension joins consecutive steps with a continuous derivative. Small
// tableaux are checked when they are compiled, large ones by the tests. Each pair has a file of its own, named after
// the method.

#include <array>
#include <cstddef>
#include <limits>

namespace invariode {

/// A pair with local extrapolation: the higher formula b is row `stages` − 1 of A (first same as last), E = b − b̂ gives
/// the error of the lower one, and y(θ) = y + h Σ_k k_k P_k(θ), P = θ (B₀ + (1−θ) (B₁ + θ (B₂ + (1−θ) (B₃ + …)))), is
/// the continuous extension, exact at both ends in roundoff too. It may take
/// `Extra` stages of its own, evaluated only when someone looks between the ends. (A pair without the FSAL property has
/// it once f(t₁, y*) is appended as a stage of weight 0: that value is the next step's first stage in any case. Where
/// it has no part in E it is evaluated once y₁ is known.)
///
/// With two lower formulas the error is e₁² / √(e₁² + (e₂/10)²), e₁ and e₂ the norms of what E and `crude` give
/// (Hairer, Nørsett, Wanner, Solving ODEs I, ch. II.10).
template <std::size_t Stages, std::size_t Degree, std::size_t Extra = 0>
struct Tableau {
  static constexpr std::size_t stages = Stages;
  static constexpr std::size_t degree = Degree;
  static constexpr std::size_t all_stages = Stages + Extra;

  const char* name;                  ///< of the method
  const char* summary;               ///< what it is and what it is for, in a few words
  const char* source;                ///< where the coefficients come from
  const char* scipy_name = nullptr;  ///< of the same pair in `scipy.integrate.solve_ivp`, if it is there
  int iterations;                    ///< of the projection in a step (paper, section 4)
  int refine = 1;                    ///< points per step that the function of this name returns
  int order;                         ///< q, of the higher formula.
  int error_order;                   ///< of the formula that E compares with
  int crude_order = 0;               ///< of the one that `crude` compares with; 0: there is none
  int extension_order;               ///< order of the continuous extension
  double real_limit;                 ///< of |h λ| on the negative real axis, where the higher formula is stable
  double floor;                      ///< smallest factor by which a first failure cuts h
  bool predicts = true;              ///< the controller sees a trend of the errors; the suite's sees the last one
  std::array<double, all_stages> c;
  std::array<std::array<double, all_stages>, all_stages> A;
  std::array<double, Stages> E;
  std::array<double, Stages> crude{};
  /// Five accurate stages in the order of their times, whose slopes show a jump of f in the step that E may not show:
  /// see `Kernel::bend`. Empty: E suffices.
  std::array<std::size_t, 5> bends{};
  std::array<std::array<double, Degree>, all_stages> B;

  [[nodiscard]] constexpr std::array<double, all_stages> b() const { return A[Stages - 1]; }
  /// The weights of the formula that an error estimate compares with.
  [[nodiscard]] constexpr std::array<double, all_stages> lower(const std::array<double, Stages>& estimate) const {
    auto w = b();
    for (std::size_t k = 0; k < Stages; ++k) w[k] -= estimate[k];
    return w;
  }
  [[nodiscard]] constexpr bool watches_bends() const { return bends[4] != 0; }
  /// The controller's exponent.
  [[nodiscard]] constexpr double exponent() const { return 1.0 / order; }
  /// Returns whether f(t₁, y*) has a part in the error estimate. Where it has none, it is evaluated once y₁ is known.
  [[nodiscard]] constexpr bool last_in_error() const { return E[Stages - 1] != 0; }
};

namespace detail {

constexpr double absolute(double x) { return x < 0 ? -x : x; }

/// A rooted tree as the level sequence of its nodes in preorder, the root at level 0.
template <std::size_t Most>
struct RootedTree {
  std::array<std::size_t, Most> level{};
  std::size_t nodes = 0;

  constexpr explicit RootedTree(std::size_t n) : nodes(n) {
    for (std::size_t i = 0; i < n; ++i) level[i] = i;
  }

  /// Steps to the next tree with as many nodes (Beyer & Hedetniemi, SIAM J. Comput. 9 (1980) 706); false after the
  /// last.
  constexpr bool next() {
    std::size_t p = nodes;
    while (p > 0 && level[p - 1] <= 1) --p;
    if (p == 0) return false;
    --p;
    const std::size_t q = parent(p);
    for (std::size_t i = p; i < nodes; ++i) level[i] = level[i - (p - q)];
    return true;
  }

  [[nodiscard]] constexpr std::size_t parent(std::size_t node) const {
    std::size_t q = node - 1;
    while (level[q] + 1 != level[node]) --q;
    return q;
  }

  /// γ: the product over all nodes of the size of the subtree that hangs from each.
  [[nodiscard]] constexpr double density() const {
    std::array<std::size_t, Most> size{};
    double gamma = 1;
    for (std::size_t v = nodes; v-- > 0;) {
      size[v] += 1;
      gamma *= static_cast<double>(size[v]);
      if (v > 0) size[parent(v)] += size[v];
    }
    return gamma;
  }
};

/// From the coefficients of θ, θ², … of each stage those of the form θ (B₀ + (1−θ) (B₁ + θ (B₂ + …))).
template <std::size_t S, std::size_t D>
constexpr std::array<std::array<double, D>, S> to_nested(std::array<std::array<double, D>, S> B) {
  for (auto& p : B)
    for (std::size_t j = 0; j < D; ++j) {  // p_j, p_{j+1}, … are the coefficients of 1, θ, … of what is left
      if (j % 2 == 1) continue;            // its value at 0 is p_j, and the rest is θ times a polynomial
      for (std::size_t i = D - 1; i-- > j;) p[i] += p[i + 1];  // its value at 1, and minus the quotient by 1 − θ
      for (std::size_t i = j + 1; i < D; ++i) p[i] = -p[i];
    }
  return B;
}

}  // namespace detail

/// Largest |Σ_k w_k Φ_k(tree) − θ^r/γ(tree)| over all rooted trees of r ≤ order nodes: the defect in the order
/// conditions of the weights w for the value at t + θh (Hairer, Nørsett, Wanner, Solving ODEs I, ch. II.2). The first
/// one above `enough` will do.
template <std::size_t S>
constexpr double order_defect(const std::array<std::array<double, S>, S>& A, const std::array<double, S>& w, int order,
                              double theta = 1, double enough = std::numeric_limits<double>::infinity()) {
  constexpr std::size_t most = 10;  // nodes: one above the highest order, where the conditions must fail
  double worst = 0;
  double power = 1;
  for (std::size_t r = 1; r <= static_cast<std::size_t>(order); ++r) {
    power *= theta;
    detail::RootedTree<most> tree(r);
    do {
      std::array<std::array<double, S>, most> phi{};
      for (auto& node : phi) node.fill(1);
      for (std::size_t v = r; v-- > 1;) {
        auto& up = phi[tree.parent(v)];
        for (std::size_t i = 0; i < S; ++i) {
          double sum = 0;
          for (std::size_t j = 0; j < S; ++j) sum += A[i][j] * phi[v][j];
          up[i] *= sum;
        }
      }
      double sum = 0;
      for (std::size_t i = 0; i < S; ++i) sum += w[i] * phi[0][i];
      const double defect = detail::absolute(sum - power / tree.density());
      if (defect > worst) worst = defect;
      if (worst > enough) return worst;
    } while (tree.next());
  }
  return worst;
}

/// Weights at θ, or their derivatives with respect to θ, of a continuous extension with these coefficients.
template <std::size_t S, std::size_t D>
constexpr std::array<double, S> nested_weights(const std::array<std::array<double, D>, S>& B, double theta,
                                               bool derivative = false) {
  std::array<double, S> w{};
  for (std::size_t k = 0; k < S; ++k) {
    double value = B[k][D - 1], slope = 0;
    for (std::size_t j = D - 1; j-- > 0;) {
      const double factor = j % 2 == 0 ? 1 - theta : theta;
      slope = factor * slope + (j % 2 == 0 ? -1 : 1) * value;
      value = B[k][j] + factor * value;
    }
    w[k] = derivative ? value + theta * slope : theta * value;
  }
  return w;
}

/// The derivatives at θ of θ, θ (1−θ), θ² (1−θ), …, the terms of a continuous extension.
template <std::size_t D>
constexpr std::array<double, D> nested_slopes(double theta) {
  std::array<double, D> slopes{};
  double value = theta, slope = 1;
  for (std::size_t d = 0; d < D; ++d) {
    slopes[d] = slope;
    const bool even = d % 2 == 0;
    const double factor = even ? 1 - theta : theta;
    slope = factor * slope + (even ? -value : value);
    value *= factor;
  }
  return slopes;
}

/// Coefficients of size about 10 enter sums of up to a hundred products: what is left of exact cancellation.
inline constexpr double tableau_roundoff = 1e-13;

/// True where a tableau is what it says. Every condition that a misprint in one coefficient breaks is tested.
template <std::size_t S, std::size_t D, std::size_t X>
constexpr bool consistent(const Tableau<S, D, X>& T, double roundoff = tableau_roundoff) {
  const auto close = [roundoff](double a, double b) { return detail::absolute(a - b) <= roundoff; };
  for (std::size_t i = 0; i < S + X; ++i) {
    double sum = 0;
    for (std::size_t j = 0; j < S + X; ++j) {
      if (j >= i && T.A[i][j] != 0) return false;  // explicit
      sum += T.A[i][j];
    }
    if (!close(sum, T.c[i])) return false;
  }
  if (T.c[0] != 0 || T.c[S - 1] != 1) return false;      // FSAL: the last stage is f(t₁, y*)
  if (T.E[S - 1] == 0 && T.E[S - 2] == 0) return false;  // the error estimate sees a NaN in the last stage it has

  const auto reaches = [&T, roundoff](int order, const std::array<double, S + X>& w, double theta = 1) {
    return order_defect(T.A, w, order, theta, roundoff) <= roundoff;
  };
  if (!reaches(T.order, T.b()) || !reaches(T.error_order, T.lower(T.E))) return false;
  if (T.crude_order > 0 && !reaches(T.crude_order, T.lower(T.crude))) return false;
  for (const double theta : {0.25, 0.5, 0.75, 1.0})
    if (!reaches(T.extension_order, nested_weights(T.B, theta), theta)) return false;

  const auto end = nested_weights(T.B, 1);
  const auto slope0 = nested_weights(T.B, 0, true);
  const auto slope1 = nested_weights(T.B, 1, true);
  for (std::size_t k = 0; k < S + X; ++k) {
    if (!close(end[k], T.b()[k])) return false;
    if (!close(slope0[k], k == 0 ? 1 : 0) || !close(slope1[k], k == S - 1 ? 1 : 0)) return false;
  }
  return true;
}

namespace detail {

/// A continuous extension that adds to the cubic Hermite interpolant: θ (Δ + (1−θ) (h f₀ − Δ + θ (2 Δ − h f₀ − h f₁ +
/// …))) with Δ = y₁ − y₀ and f₁ the stage `last`; what follows is `rest`.
template <std::size_t S, std::size_t D>
constexpr std::array<std::array<double, D + 3>, S> on_hermite(const std::array<double, S>& b, std::size_t last,
                                                              const std::array<std::array<double, S>, D>& rest) {
  std::array<std::array<double, D + 3>, S> B{};
  for (std::size_t k = 0; k < S; ++k) {
    const double at0 = k == 0 ? 1 : 0, at1 = k == last ? 1 : 0;
    B[k][0] = b[k];
    B[k][1] = at0 - b[k];
    B[k][2] = 2 * b[k] - at0 - at1;
    for (std::size_t j = 0; j < D; ++j) B[k][j + 3] = rest[j][k];
  }
  return B;
}

}  // namespace detail

}  // namespace invariode
