// Sensitivities are moved to the tangent of the manifold along the directions in which the state is, and no farther.

#include <algorithm>
#include <limits>
#include <random>
#include <vector>

#include "check.hpp"
#include "decompositions.hpp"
#include "problems.hpp"
#include "sensitivity/tangent.hpp"
#include "sensitivity/variations.hpp"

namespace invariode::test::sensitivity_laws {

namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Vector = Eigen::VectorXd;

/// Invariants G y = c of two parameters with G S_j = 0, between weights of very different sizes.
struct Case {
  Case(int m, int n, int level)
      : G(RowMajor::NullaryExpr(m, n, [this] { return normal(random); })),
        Y(RowMajor::NullaryExpr(1 + k, n, [this] { return normal(random); })),
        weights(1e-6, thresholds(n), {}),
        invariants(static_cast<std::size_t>(n), {block(level)}, std::vector<double>(static_cast<std::size_t>(m)),
                   weights),
        projector(invariants, weights, 2),
        tangent(invariants, weights, static_cast<std::size_t>(n) * (1 + k), nullptr) {}
  Case(const Case&) = delete;

  std::vector<double> thresholds(int n) {
    std::vector<double> thr(static_cast<std::size_t>(n));
    for (double& w : thr) w = std::exp(5 * normal(random));
    return thr;
  }
  InvariantBlock block(int level) {
    InvariantBlock all{.g = as_callback(g),
                       .jacobian = as_callback(gradients),
                       .m = static_cast<std::size_t>(G.rows()),
                       .level = level};
    all.tangent = as_callback(rates);
    return all;
  }
  Vector S(int j) const { return Y.row(1 + j); }

  static constexpr int k = 2;
  std::mt19937 random{7};
  std::normal_distribution<double> normal;
  RowMajor G, Y;
  Function g = [this](double, const double* y, double* r) {
    Eigen::Map<Vector>(r, G.rows()) = G * Eigen::Map<const Vector>(y, G.cols());
  };
  Function gradients = [this](double, const double*, double* out) { std::copy_n(G.data(), G.size(), out); };
  Function rates = [this](double, const double* all, double* out) {
    for (int j = 0; j < k; ++j)
      Eigen::Map<Vector>(out + j * G.rows(), G.rows()) =
          G * Eigen::Map<const Vector>(all + (1 + j) * G.cols(), G.cols());
  };
  Weights weights;
  Invariants invariants;
  Projector projector;
  TangentProjector tangent;
};

}  // namespace

TEST(the_correction_is_the_least_one_to_the_tangent) {
  for (const int level : {0, 1})
    for (const int m : {1, 2, 3}) {
      const check::Case label(m, " invariants of level ", level);
      Case one(m, 6, level);
      const Vector from = one.Y.row(0);
      const RowMajor before = one.Y;
      const Projected did = one.projector.project(0, from.data(), one.Y.data());
      CHECK(did.outcome == Outcome::ok && did.rank == static_cast<std::size_t>(m));
      CHECK(one.tangent.follow(one.projector, 0, one.Y.data()) == Outcome::ok);
      const auto w = one.projector.linearization().w;
      const RowMajor scaled = one.G * Eigen::Map<const Vector>(w.data(), one.G.cols()).asDiagonal();
      for (int j = 0; j < Case::k; ++j) {
        const Vector least = smallest_solution(scaled, one.G * Vector(before.row(1 + j)));
        const Vector moved = Vector(before.row(1 + j)) - one.S(j);
        for (Eigen::Index i = 0; i < moved.size(); ++i) {
          const double unit = w[static_cast<std::size_t>(i)], roundoff = 4 * eps * std::abs(before(1 + j, i)) / unit;
          CHECK_CLOSE(moved[i] / unit, least[i], 1e-10 * least.norm() + roundoff);
        }
        CHECK((one.G * one.S(j)).norm() <= 1e-13 * one.G.norm() * one.S(j).norm());
      }
    }
}

TEST(what_is_held_keeps_the_rate_that_it_had) {
  Case one(2, 5, 0);
  InvariantBlock held = one.block(0);
  held.held = true;
  Invariants invariants(5, {held}, {0, 0}, one.weights);
  TangentProjector tangent(invariants, one.weights, 5 * (1 + Case::k), nullptr);
  CHECK(tangent.hold(0, one.Y.data()) == Status::ok);
  const Vector rate = one.G * one.S(1);
  one.Y.row(2).array() += 0.5;
  CHECK(tangent.settle(0, one.Y.data()) == Outcome::ok);
  CHECK(((one.G * one.S(1)) - rate).norm() <= 1e-13 * one.G.norm() * one.S(1).norm());
}

TEST(sensitivities_have_tolerances_of_their_own) {
  const Weights state(1e-3, {2, 3}, {1, 4});
  const Variations variations{.k = 2, .slope = {}, .tolerance = {1e-3, 2e-3, 3e-3, 4e-3}};
  const Weights all = augmented(state, variations, true), none = augmented(state, variations, false);
  CHECK(all.size() == 6);
  CHECK_CLOSE(all.at(4, 0), 3, 1e-12);
  CHECK(all.at(5, 2) == 8);  // the scale of the second component
  CHECK(none.at(1, 0) == 3 && none.at(3, 1e300) == std::numeric_limits<double>::infinity());
}

}  // namespace invariode::test::sensitivity_laws
