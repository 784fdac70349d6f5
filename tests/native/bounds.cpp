// Within bounds the projection is the nearest point in the norm of the weights; slopes lose what leads out.

#include "manifold/bounds.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <limits>
#include <numeric>
#include <random>
#include <stdexcept>
#include <vector>

#include "check.hpp"
#include "decompositions.hpp"
#include "manifold/active_set.hpp"
#include "problems.hpp"

namespace invariode::test::bounds_laws {

namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Vector = Eigen::VectorXd;

constexpr double infinite = std::numeric_limits<double>::infinity();

/// A candidate, partly negative, near a manifold J y = J from with positive points.
struct Sample {
  Sample(int m, int n, unsigned seed) : random(seed), J(draw(m, n)), from(draw(n, 1).cwiseAbs()), y(from) {
    for (int j = 0; j < n; ++j)
      if (draw(1, 1)(0) > 0) from[j] = y[j] = 0;
    y += 0.05 * draw(n, 1);
  }
  RowMajor draw(int rows, int columns) {
    std::normal_distribution<double> normal;
    return RowMajor::NullaryExpr(rows, columns, [&] { return normal(random); });
  }

  std::mt19937 random;
  RowMajor J;
  Vector from, y;
};

/// Of the points of J y = value with the components of `fixed` at 0, the one nearest to `candidate`; empty if J y =
/// value has no such solution.
Vector nearest_with_fixed(const Sample& s, const Vector& value, const Vector& w, unsigned fixed) {
  Vector point = s.y;
  RowMajor scaled = s.J * w.asDiagonal();
  for (Eigen::Index j = 0; j < point.size(); ++j) {
    if ((fixed >> j & 1U) == 0) continue;
    point[j] = 0;
    scaled.col(j).setZero();
  }
  const Vector residual = value - s.J * point;
  point += w.cwiseProduct(smallest_solution(scaled, residual));
  return (s.J * point - value).norm() < 1e-10 && (point.array() >= -1e-12).all() ? point : Vector();
}

/// By trying every set of components at their bounds.
Vector nearest(const Sample& s, const Vector& value, const Vector& w) {
  Vector best;
  double least = infinite;
  for (unsigned fixed = 0; fixed < 1U << s.y.size(); ++fixed) {
    const Vector point = nearest_with_fixed(s, value, w, fixed);
    if (point.size() == 0) continue;
    const double distance = (point - s.y).cwiseQuotient(w).norm();
    if (distance < least) {
      least = distance;
      best = point;
    }
  }
  return best;
}

bool refused(const std::vector<double>& lower, const std::vector<double>& upper) {
  try {
    const Bounds bounds(lower, upper);
  } catch (const std::invalid_argument&) {
    return true;
  }
  return false;
}

}  // namespace

TEST(the_projection_within_bounds_is_the_nearest_point) {
  int compared = 0, active = 0, far = 0;
  for (unsigned seed = 0; seed < 2000; ++seed) {
    const int n = 3 + static_cast<int>(seed % 4), m = 1 + static_cast<int>(seed % 2);
    const Sample s(m, n, seed);
    const Vector value = s.J * s.from;
    std::vector<double> threshold(static_cast<std::size_t>(n));
    std::iota(threshold.begin(), threshold.end(), 2.0);  // above the candidates, whose sizes change as they are moved
    const Weights weights(1e-9, threshold, {});
    Function g = [&](double, const double* y, double* r) {
      Eigen::Map<Vector>(r, m) = s.J * Eigen::Map<const Vector>(y, n);
    };
    Function jacobian = [&](double, const double*, double* out) { std::copy(s.J.data(), s.J.data() + m * n, out); };
    Invariants invariants(static_cast<std::size_t>(n),
                          {{.g = as_callback(g), .jacobian = as_callback(jacobian), .m = static_cast<std::size_t>(m)}},
                          {value.data(), value.data() + m}, weights);
    Projector projector(invariants, weights, 1);
    const Bounds bounds(std::vector<double>(static_cast<std::size_t>(n)),
                        std::vector<double>(static_cast<std::size_t>(n), infinite));
    ActiveSet set(projector, bounds);
    Vector w(n), found = s.y;
    weights.fill(s.from.data(), s.y.data(), w.data());
    const Vector best = nearest(s, value, w);
    const Projected did = set.project(0, s.from.data(), found.data());
    CHECK(did.outcome == Outcome::ok);
    const check::Case label("seed ", seed);
    CHECK(bounds.contain(found.data()));
    CHECK((s.J * found - value).norm() < 1e-10);
    const double optimal = (best - s.y).cwiseQuotient(w).norm();
    far += (found - s.y).cwiseQuotient(w).norm() > optimal * (1 + 1e-6) ? 1 : 0;
    ++compared;
    active += set.active() ? 1 : 0;
  }
  CHECK(compared == 2000);
  CHECK(far <= 4);  // where as many components are free as there are invariants, multipliers may be ambiguous
  CHECK(active > 1000);
}

TEST(a_manifold_outside_of_the_bounds_is_no_success) {
  const Weights weights(1e-6, {1, 1}, {});
  Function sum = [](double, const double* y, double* r) { *r = y[0] + y[1]; };
  Function ones = [](double, const double*, double* J) { J[0] = J[1] = 1; };
  Invariants invariants(2, {{.g = as_callback(sum), .jacobian = as_callback(ones), .m = 1}}, {1}, weights);
  Projector projector(invariants, weights, 1);
  const Bounds bounds({0, 0}, {0.4, 0.4});
  ActiveSet set(projector, bounds);
  std::vector<double> from{0.4, 0.4}, y{0.41, 0.3};
  CHECK(set.project(0, from.data(), y.data()).outcome == Outcome::not_finite);
}

TEST(slopes_that_lead_out_are_found) {
  const Bounds bounds({0, -infinite, 0, 1}, {infinite, 2, 1, 1});
  const std::vector<double> y{-0.1, 2, 0.5, 1};
  const auto outward = [&](double forward, const std::vector<double>& slope) {
    std::vector<std::size_t> components;
    for (const Bounds::Interval& one : bounds.intervals())
      if (Bounds::leads_out(one, y.data(), forward, slope.data())) components.push_back(one.component);
    return components;
  };
  CHECK((outward(1, {-1, 3, -4, 5}) == std::vector<std::size_t>{0, 1, 3}));
  CHECK((outward(-1, {-1, 3, -4, 5}) == std::vector<std::size_t>{3}));  // backwards the others lead in
  CHECK(outward(1, {std::numeric_limits<double>::quiet_NaN(), 0, 0, 0}).empty());
}

TEST(wrong_bounds_are_refused) {
  CHECK(refused({0}, {1, 1}));
  CHECK(refused({2}, {1}));
  CHECK(refused({std::numeric_limits<double>::quiet_NaN()}, {1}));
  CHECK(!refused({1}, {1}));
}

}  // namespace invariode::test::bounds_laws
