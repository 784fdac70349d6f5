#pragma once
// Explicit Runge-Kutta pairs as data. Tableaux are checked, small ones when they are compiled, large ones by the tests:
// row sums, order conditions of both formulas and of the continuous extension, FSAL, and that the extension joins
// consecutive steps with a continuous derivative.

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

  int order;            ///< q, of the higher formula. The controller's exponent is 1/q.
  int error_order;      ///< of the formula that E compares with
  int crude_order = 0;  ///< of the one that `crude` compares with; 0: there is none
  int extension_order;  ///< order of the continuous extension
  double floor;         ///< smallest factor by which a first failure cuts h
  std::array<double, all_stages> c;
  std::array<std::array<double, all_stages>, all_stages> A;
  std::array<double, Stages> E;
  std::array<double, Stages> crude{};
  std::array<std::array<double, Degree>, all_stages> B;

  [[nodiscard]] constexpr std::array<double, all_stages> b() const { return A[Stages - 1]; }
  /// The weights of the formula that an error estimate compares with.
  [[nodiscard]] constexpr std::array<double, all_stages> lower(const std::array<double, Stages>& estimate) const {
    auto w = b();
    for (std::size_t k = 0; k < Stages; ++k) w[k] -= estimate[k];
    return w;
  }
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
constexpr std::array<std::array<double, D>, S> nested(std::array<std::array<double, D>, S> B) {
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
  constexpr std::size_t most = 9;
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

/// Weights of the continuous extension at θ, or of its derivative with respect to θ.
template <std::size_t S, std::size_t D, std::size_t X>
constexpr std::array<double, S + X> extension_weights(const Tableau<S, D, X>& T, double theta,
                                                      bool derivative = false) {
  std::array<double, S + X> w{};
  for (std::size_t k = 0; k < S + X; ++k) {
    double value = T.B[k][D - 1], slope = 0;
    for (std::size_t j = D - 1; j-- > 0;) {
      const double factor = j % 2 == 0 ? 1 - theta : theta;
      slope = factor * slope + (j % 2 == 0 ? -1 : 1) * value;
      value = T.B[k][j] + factor * value;
    }
    w[k] = derivative ? value + theta * slope : theta * value;
  }
  return w;
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
    if (!reaches(T.extension_order, extension_weights(T, theta), theta)) return false;

  const auto end = extension_weights(T, 1);
  const auto slope0 = extension_weights(T, 0, true);
  const auto slope1 = extension_weights(T, 1, true);
  for (std::size_t k = 0; k < S + X; ++k) {
    if (!close(end[k], T.b()[k])) return false;
    if (!close(slope0[k], k == 0 ? 1 : 0) || !close(slope1[k], k == S - 1 ? 1 : 0)) return false;
  }
  return true;
}

/// Bogacki & Shampine, Appl. Math. Lett. 2 (1989) 321: the pair of ode23. The extension is the cubic Hermite
/// interpolant.
inline constexpr Tableau<4, 3> bogacki_shampine{
    .order = 3,
    .error_order = 2,
    .extension_order = 3,
    .floor = 0.5,
    .c = {0, 1. / 2, 3. / 4, 1},
    .A = {{{}, {1. / 2}, {0, 3. / 4}, {2. / 9, 1. / 3, 4. / 9}}},
    .E = {-5. / 72, 1. / 12, 1. / 9, -1. / 8},
    .B = detail::nested<4, 3>({{{1, -4. / 3, 5. / 9}, {0, 1, -2. / 3}, {0, 4. / 3, -8. / 9}, {0, -1, 1}}}),
};
static_assert(consistent(bogacki_shampine));

/// Dormand & Prince, J. Comput. Appl. Math. 6 (1980) 19: the pair of ode45, with the fourth-order extension of the
/// MATLAB ODE Suite (Shampine & Reichelt, SIAM J. Sci. Comput. 18 (1997) 1).
inline constexpr Tableau<7, 4> dormand_prince{
    .order = 5,
    .error_order = 4,
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
    .B = detail::nested<7, 4>({{{1, -183. / 64, 37. / 12, -145. / 128},
                                {0, 0, 0, 0},
                                {0, 1500. / 371, -1000. / 159, 1000. / 371},
                                {0, -125. / 32, 125. / 12, -375. / 64},
                                {0, 9477. / 3392, -729. / 106, 25515. / 6784},
                                {0, -11. / 7, 11. / 3, -55. / 28},
                                {0, 3. / 2, -4, 5. / 2}}}),
};
static_assert(consistent(dormand_prince));

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

inline constexpr std::array<std::array<double, 16>, 4> dop853_D = {
    {{-8.428938276109013, 0, 0, 0, 0, 0.5667149535193777, -3.0689499459498917, 2.38466765651207, 2.117034582445028,
      -0.871391583777973, 2.2404374302607883, 0.6315787787694688, -0.08899033645133331, 18.148505520854727,
      -9.194632392478356, -4.436036387594894},
     {10.427508642579134, 0, 0, 0, 0, 242.28349177525817, 165.20045171727028, -374.5467547226902, -22.113666853125306,
      7.733432668472264, -30.674084731089398, -9.332130526430229, 15.697238121770845, -31.139403219565178,
      -9.35292435884448, 35.81684148639408},
     {19.985053242002433, 0, 0, 0, 0, -387.0373087493518, -189.17813819516758, 527.8081592054236, -11.57390253995963,
      6.8812326946963, -1.0006050966910838, 0.7777137798053443, -2.778205752353508, -60.19669523126412,
      84.32040550667716, 11.99229113618279},
     {-25.69393346270375, 0, 0, 0, 0, -154.18974869023643, -231.5293791760455, 357.6391179106141, 93.40532418362432,
      -37.45832313645163, 104.0996495089623, 29.8402934266605, -43.53345659001114, 96.32455395918828,
      -39.17726167561544, -149.72683625798564}}};
inline constexpr std::array<std::array<double, 16>, 16> dop853_A = {
    {{},
     {0.05260015195876773},
     {0.0197250569845379, 0.0591751709536137},
     {0.02958758547680685, 0, 0.08876275643042054},
     {0.2413651341592667, 0, -0.8845494793282861, 0.924834003261792},
     {0.037037037037037035, 0, 0, 0.17082860872947386, 0.12546768756682242},
     {0.037109375, 0, 0, 0.17025221101954405, 0.06021653898045596, -0.017578125},
     {0.03709200011850479, 0, 0, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402, 0.008273789163814023},
     {0.6241109587160757, 0, 0, -3.3608926294469414, -0.868219346841726, 27.59209969944671, 20.154067550477894,
      -43.48988418106996},
     {0.47766253643826434, 0, 0, -2.4881146199716677, -0.590290826836843, 21.230051448181193, 15.279233632882423,
      -33.28821096898486, -0.020331201708508627},
     {-0.9371424300859873, 0, 0, 5.186372428844064, 1.0914373489967295, -8.149787010746927, -18.52006565999696,
      22.739487099350505, 2.4936055526796523, -3.0467644718982196},
     {2.273310147516538, 0, 0, -10.53449546673725, -2.0008720582248625, -17.9589318631188, 27.94888452941996,
      -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636},
     {0.054293734116568765, 0, 0, 0, 0, 4.450312892752409, 1.8915178993145003, -5.801203960010585, 0.3111643669578199,
      -0.1521609496625161, 0.20136540080403034, 0.04471061572777259},
     {0.056167502283047954, 0, 0, 0, 0, 0, 0.25350021021662483, -0.2462390374708025, -0.12419142326381637,
      0.15329179827876568, 0.00820105229563469, 0.007567897660545699, -0.008298},
     {0.03183464816350214, 0, 0, 0, 0, 0.028300909672366776, 0.053541988307438566, -0.05492374857139099, 0, 0,
      -0.00010834732869724932, 0.0003825710908356584, -0.00034046500868740456, 0.1413124436746325},
     {-0.42889630158379194, 0, 0, 0, 0, -4.697621415361164, 7.683421196062599, 4.06898981839711, 0.3567271874552811, 0,
      0, 0, -0.0013990241651590145, 2.9475147891527724, -9.15095847217987}}};

}  // namespace detail

/// Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, 2nd ed., Springer 1993, ch. II.5 and II.10: the
/// pair of DOP853, after Dormand & Prince, with two lower formulas, and an extension of order 7 that takes three more
/// stages. (200 order conditions are many for a compiler: they are checked by the tests.)
inline constexpr Tableau<13, 7, 3> dop853{
    .order = 8,
    .error_order = 5,
    .crude_order = 3,
    .extension_order = 7,
    .floor = 1. / 3,
    .c = {0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726, 0.3333333333333333, 0.25,
          0.3076923076923077, 0.6512820512820513, 0.6, 0.8571428571428571, 1, 1, 0.1, 0.2, 0.7777777777777778},
    .A = detail::dop853_A,
    .E = {0.01312004499419488, 0, 0, 0, 0, -1.2251564463762044, -0.4957589496572502, 1.6643771824549864,
          -0.35032884874997366, 0.3341791187130175, 0.08192320648511571, -0.022355307863886294},
    .crude = {-0.18980075407240762, 0, 0, 0, 0, 4.450312892752409, 1.8915178993145003, -5.801203960010585,
              -0.4226823213237919, -0.1521609496625161, 0.20136540080403034, 0.02265179219836082},
    .B = detail::on_hermite(detail::dop853_A[12], 12, detail::dop853_D),
};

namespace detail {

inline constexpr std::array<std::array<double, 17>, 4> verner_D = {
    {{-5.371390466146671, 0, 0, 0, 0, 10.090994058372017, 1.6048446515861623, -980.2390692227265, 1493.2944140306063,
      -1905.6669585622612, 1427.80555087148, -15.704810365687873, 0, -3.2967244317824647, -20.416280692948217,
      16.530071842642716, -18.630641713134295},
     {3.6538310433747028, 0, 0, 0, 0, -10.78498481842795, 32.252140967214956, 4362.545584342862, -6437.548040825131,
      8263.596518734974, -6340.562635665432, 72.60770032694904, 0, 21.540753221872226, 25.945274477652656,
      -53.14832071605428, 59.902178910146596},
     {10.701082645258875, 0, 0, 0, 0, -60.085782826379294, -40.21900265025318, 2844.3021967416184, -4521.083526598545,
      5725.9566320449, -4155.503747758391, 43.12011855576114, 0, 9.510272525730656, 86.74348738893455,
      -10.477678960238496, 67.03594889160313},
     {-5.454547288952965, 0, 0, 0, 0, 79.78911199784015, -61.09670974442174, -14951.543653440334, 22324.571394333743,
      -28594.46085938938, 21748.118154466232, -245.43939702786273, 0, -65.44129872356201, -104.01296920606484,
      114.70018406406496, -239.7294100413036}}};
inline constexpr std::array<std::array<double, 17>, 17> verner_A = {
    {{},
     {0.05},
     {-0.0069931640625, 0.1135556640625},
     {0.0399609375, 0, 0.1198828125},
     {0.36139756280045754, 0, -1.3415240667004928, 1.3701265039000352},
     {0.049047202797202795, 0, 0, 0.23509720422144048, 0.18085559298135673},
     {0.06169289044289044, 0, 0, 0.11236568314640277, -0.03885046071451367, 0.01979188712522046},
     {-1.767630240222327, 0, 0, -62.5, -6.061889377376669, 5.6508231982227635, 65.62169641937624},
     {-1.1809450665549708, 0, 0, -41.50473441114321, -4.434438319103725, 4.260408188586133, 43.75364022446172,
      0.00787142548991231},
     {-1.2814059994414884, 0, 0, -45.047139960139866, -4.731362069449577, 4.514967016593808, 47.44909557172985,
      0.010592282971116612, -0.0057468422638446166},
     {-1.7244701342624853, 0, 0, -60.92349008483054, -5.951518376222393, 5.556523730698456, 63.98301198033305,
      0.014642028250414961, 0.06460408772358203, -0.0793032316900888},
     {-3.301622667747079, 0, 0, -118.01127235975251, -10.141422388456112, 9.139311332232058, 123.37594282840426,
      4.62324437887458, -3.3832777380682018, 4.527592100324618, -5.828495485811623},
     {-3.039515033766309, 0, 0, -109.26086808941763, -9.290642497400293, 8.43050498176491, 114.20100103783314,
      -0.9637271342145479, -5.0348840888021895, 5.958130824002923},
     {0.04427989419007951, 0, 0, 0, 0, 0.3541049391724449, 0.2479692154956438, -15.694202038838084, 25.084064965558564,
      -31.738367786260277, 22.938283273988784, -0.2361324633071542},
     {0.04620700646754963, 0, 0, 0, 0, 0.045039041608424805, 0.23368166977134244, 37.83901368421068,
      -15.949113289454246, 23.028368351816102, -44.85578507769412, -0.06379858768647444, 0, -0.012595035543861663},
     {0.05037946855482041, 0, 0, 0, 0, 0.041098361310460796, 0.17180541533481958, 4.614105319981519,
      -1.7916678830853965, 2.531658930485041, -5.324977860205731, -0.03065532595385635, 0, -0.005254479979429613,
      -0.08399194644224793},
     {0.0408289713299708, 0, 0, 0, 0, 0.4244479514247632, 0.23260915312752345, 2.677982520711806, 0.7420826657338945,
      0.1460377847941461, -3.579344509890565, 0.11388443896001738, 0, 0.012677906510331901, -0.07443436349946675,
      0.047827480797578516}}};

}  // namespace detail

/// Verner, Numer. Algorithms 53 (2010) 383: the most efficient of his pairs of orders 8 and 7, whose thirteenth stage
/// is of the error estimate only; f(t₁, y*) is appended. The extension of order 7 takes the first three of his further
/// stages: on them the order conditions have exactly one solution, and it joins the steps with a continuous derivative.
/// (Solved with 60 digits from 36 digits of A.)
inline constexpr Tableau<14, 7, 3> verner{
    .order = 8,
    .error_order = 7,
    .extension_order = 7,
    .floor = 1. / 3,
    .c = {0, 0.05, 0.1065625, 0.15984375, 0.39, 0.465, 0.155, 0.943, 0.901802041735857, 0.909, 0.94, 1, 1, 1,
          0.3110177634953864, 0.1725, 0.7846},
    .A = detail::verner_A,
    .E = {-3.2721039010281375e-05, 0, 0, 0, 0, -0.0005046250618777704, 0.0001211723589784759, -20.142336771313868,
          5.2371785994398286, -8.156744408794658, 22.938283273988784, -0.2361324633071542, 0.36016794372897754},
    .B = detail::on_hermite(detail::verner_A[13], 13, detail::verner_D),
};

}  // namespace invariode
