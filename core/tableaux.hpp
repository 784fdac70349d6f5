#pragma once
// Explicit Runge-Kutta pairs as data. A tableau checks itself when it is compiled: row sums, order conditions of both
// formulas and of the continuous extension, FSAL, and that the extension joins consecutive steps with a continuous
// derivative.

#include <array>
#include <cstddef>

namespace invariode {

/// A pair with local extrapolation: the higher formula b is the last row of A (first same as last), E = b − b̂ gives the
/// error of the lower one, and y(θ) = y + h Σ_k k_k (B_k · [θ, θ², …]) is the continuous extension. (A pair without the
/// FSAL property has it once f(t₁, y*) is appended as a stage of weight 0: that value is the next step's first stage in
/// any case.)
template <std::size_t Stages, std::size_t Degree>
struct Tableau {
  static constexpr std::size_t stages = Stages;
  static constexpr std::size_t degree = Degree;

  int order;            ///< q, of the higher formula; the lower one has q − 1. The controller's exponent is 1/q.
  int extension_order;  ///< order of the continuous extension
  double floor;         ///< smallest factor by which a first failure cuts h
  std::array<double, Stages> c;
  std::array<std::array<double, Stages>, Stages> A;
  std::array<double, Stages> E;
  std::array<std::array<double, Degree>, Stages> B;

  [[nodiscard]] constexpr const std::array<double, Stages>& b() const { return A[Stages - 1]; }
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

}  // namespace detail

/// Largest |Σ_k w_k Φ_k(tree) − θ^r/γ(tree)| over all rooted trees of r ≤ order nodes: the defect in the order
/// conditions of the weights w for the value at t + θh (Hairer, Nørsett, Wanner, Solving ODEs I, ch. II.2).
template <std::size_t S>
constexpr double order_defect(const std::array<std::array<double, S>, S>& A, const std::array<double, S>& w, int order,
                              double theta = 1) {
  constexpr std::size_t most = 8;
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
    } while (tree.next());
  }
  return worst;
}

/// Weights of the continuous extension at θ, or of its derivative with respect to θ.
template <std::size_t S, std::size_t D>
constexpr std::array<double, S> extension_weights(const Tableau<S, D>& T, double theta, bool derivative = false) {
  std::array<double, S> w{};
  for (std::size_t k = 0; k < S; ++k) {
    double power = derivative ? 1 : theta;
    for (std::size_t j = 0; j < D; ++j, power *= theta)
      w[k] += T.B[k][j] * power * (derivative ? static_cast<double>(j + 1) : 1);
  }
  return w;
}

/// Coefficients of size about 10 enter sums of up to a hundred products: what is left of exact cancellation.
inline constexpr double tableau_roundoff = 1e-13;

/// True where a tableau is what it says. Every condition that a misprint in one coefficient breaks is tested.
template <std::size_t S, std::size_t D>
constexpr bool consistent(const Tableau<S, D>& T) {
  const auto close = [](double a, double b) { return detail::absolute(a - b) <= tableau_roundoff; };
  for (std::size_t i = 0; i < S; ++i) {
    double sum = 0;
    for (std::size_t j = 0; j < S; ++j) {
      if (j >= i && T.A[i][j] != 0) return false;  // explicit
      sum += T.A[i][j];
    }
    if (!close(sum, T.c[i])) return false;
  }
  if (T.c[0] != 0 || T.c[S - 1] != 1) return false;  // FSAL: the last stage is f(t₁, y*)
  if (T.E[S - 1] == 0) return false;                 // the error estimate sees every stage, a NaN in the last one too

  std::array<double, S> lower{};
  for (std::size_t k = 0; k < S; ++k) lower[k] = T.b()[k] - T.E[k];
  if (order_defect(T.A, T.b(), T.order) > tableau_roundoff) return false;
  if (order_defect(T.A, lower, T.order - 1) > tableau_roundoff) return false;
  for (const double theta : {0.25, 0.5, 0.75, 1.0})
    if (order_defect(T.A, extension_weights(T, theta), T.extension_order, theta) > tableau_roundoff) return false;

  const auto end = extension_weights(T, 1);
  const auto slope0 = extension_weights(T, 0, true);
  const auto slope1 = extension_weights(T, 1, true);
  for (std::size_t k = 0; k < S; ++k) {
    if (!close(end[k], T.b()[k])) return false;
    if (!close(slope0[k], k == 0 ? 1 : 0) || !close(slope1[k], k == S - 1 ? 1 : 0)) return false;
  }
  return true;
}

/// Bogacki & Shampine, Appl. Math. Lett. 2 (1989) 321: the pair of ode23. The extension is the cubic Hermite
/// interpolant.
inline constexpr Tableau<4, 3> bogacki_shampine{
    .order = 3,
    .extension_order = 3,
    .floor = 0.5,
    .c = {0, 1. / 2, 3. / 4, 1},
    .A = {{{}, {1. / 2}, {0, 3. / 4}, {2. / 9, 1. / 3, 4. / 9}}},
    .E = {-5. / 72, 1. / 12, 1. / 9, -1. / 8},
    .B = {{{1, -4. / 3, 5. / 9}, {0, 1, -2. / 3}, {0, 4. / 3, -8. / 9}, {0, -1, 1}}},
};
static_assert(consistent(bogacki_shampine));

/// Dormand & Prince, J. Comput. Appl. Math. 6 (1980) 19: the pair of ode45, with the fourth-order extension of the
/// MATLAB ODE Suite (Shampine & Reichelt, SIAM J. Sci. Comput. 18 (1997) 1).
inline constexpr Tableau<7, 4> dormand_prince{
    .order = 5,
    .extension_order = 4,
    .floor = 0.1,
    .c = {0, 1. / 5, 3. / 10, 4. / 5, 8. / 9, 1, 1},
    .A = {{{},
           {1. / 5},
           {3. / 40, 9. / 40},
           {44. / 45, -56. / 15, 32. / 9},
           {19372. / 6561, -25360. / 2187, 64448. / 6561, -212. / 729},
           {9017. / 3168, -355. / 33, 46732. / 5247, 49. / 176, -5103. / 18656},
           {35. / 384, 0, 500. / 1113, 125. / 192, -2187. / 6784, 11. / 84}}},
    .E = {71. / 57600, 0, -71. / 16695, 71. / 1920, -17253. / 339200, 22. / 525, -1. / 40},
    .B = {{{1, -183. / 64, 37. / 12, -145. / 128},
           {0, 0, 0, 0},
           {0, 1500. / 371, -1000. / 159, 1000. / 371},
           {0, -125. / 32, 125. / 12, -375. / 64},
           {0, 9477. / 3392, -729. / 106, 25515. / 6784},
           {0, -11. / 7, 11. / 3, -55. / 28},
           {0, 3. / 2, -4, 5. / 2}}},
};
static_assert(consistent(dormand_prince));

}  // namespace invariode
