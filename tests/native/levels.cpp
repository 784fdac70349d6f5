// Corrections in levels: each level is the least correction that leaves the levels before as they are.

#include "manifold/levels.hpp"

#include <Eigen/Core>
#include <random>
#include <vector>

#include "check.hpp"
#include "decompositions.hpp"
#include "linear/least_norm.hpp"
#include "manifold/projection.hpp"
#include "problems.hpp"

namespace invariode::test::levels_laws {

namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Vector = Eigen::VectorXd;
using Components = std::vector<std::size_t>;

/// Rows of a constant Jacobian with a level.
struct Rows {
  RowMajor J;
  int level = 0;
  Components moves = {};
  std::vector<double> metric = {};
};

/// Linear invariants J y = value in levels, and a point that is off them; one iteration is exact.
struct Linear {
  explicit Linear(std::vector<Rows> all_rows, unsigned seed)
      : rows(std::move(all_rows)), n(static_cast<std::size_t>(rows[0].J.cols())), random(seed) {
    for (std::size_t k = 0; k < rows.size(); ++k) {
      functions.push_back([this, k](double, const double* y, double* r) {
        Eigen::Map<Vector>(r, rows[k].J.rows()) = rows[k].J * Eigen::Map<const Vector>(y, rows[k].J.cols());
      });
      jacobians.push_back([this, k](double, const double*, double* out) {
        std::copy(rows[k].J.data(), rows[k].J.data() + rows[k].J.size(), out);
      });
    }
    y = draw(static_cast<int>(n), 1, random);
    std::vector<double> thr(n);
    for (double& w : thr) w = std::exp(2 * draw(1, 1, random)(0));
    weights = Weights(1e-9, thr, {});
    w = Vector(y.size());
    weights.fill(y.data(), y.data(), w.data());
  }
  Linear(const Linear&) = delete;

  static RowMajor draw(int m, int n, std::mt19937& random) {
    std::normal_distribution<double> normal;
    return RowMajor::NullaryExpr(m, n, [&] { return normal(random); });
  }
  Invariants invariants() {
    std::vector<InvariantBlock> blocks;
    std::size_t m = 0;
    for (std::size_t k = 0; k < rows.size(); ++k) {
      blocks.push_back({.g = as_callback(functions[k]),
                        .jacobian = as_callback(jacobians[k]),
                        .m = static_cast<std::size_t>(rows[k].J.rows()),
                        .level = rows[k].level,
                        .moves = rows[k].moves,
                        .metric = {.function = {}, .values = rows[k].metric}});
      m += blocks.back().m;
    }
    return {n, std::move(blocks), std::vector<double>(m), weights};
  }
  /// y projected onto J y = 0 of all rows.
  Vector project(std::vector<char>* dropped = nullptr) {
    Invariants held = invariants();
    Projector projector(held, weights, 1);
    Vector result = y;
    CHECK(projector.project(0, y.data(), result.data()).outcome == Outcome::ok);
    if (dropped) *dropped = projector.dropped();
    return result;
  }
  /// The same from the definition, level by level, by a null space and a pseudoinverse in the scaled components.
  Vector reference() const {
    Vector result = y;
    RowMajor before(0, y.size());
    for (const Rows& one : rows) {  // in the order of their levels
      RowMajor Z = RowMajor::Zero(y.size(), y.size());
      for (Eigen::Index j = 0; j < y.size(); ++j)
        Z(j, j) = one.moves.empty() || std::count(one.moves.begin(), one.moves.end(), static_cast<std::size_t>(j)) > 0;
      if (before.rows() > 0) {
        const RowMajor cut = before * w.asDiagonal() * Z;
        Z -= pseudoinverse(cut) * cut;
      }
      const RowMajor free = one.J * w.asDiagonal() * Z;
      result -= w.asDiagonal() * Z * smallest_solution(free, one.J * result);
      RowMajor both(before.rows() + one.J.rows(), y.size());
      both << before, one.J;
      before = both;
    }
    return result;
  }
  [[nodiscard]] double difference(const Vector& a, const Vector& b) const {
    return (a - b).cwiseQuotient(w).cwiseAbs().maxCoeff();
  }

  std::vector<Rows> rows;
  std::size_t n;
  std::mt19937 random;
  std::vector<Function> functions, jacobians;
  Vector y, w;
  Weights weights{1, {}, {}};
};

constexpr double conditioned = 1e-10;  // condition numbers of the samples are below 1e5

template <class Check>
void for_seeds(Check check_seed) {
  for (unsigned seed = 0; seed < 40; ++seed) {
    const check::Case label("seed ", seed);
    std::mt19937 random(seed);
    check_seed(seed, [&](int m, int n) { return Linear::draw(m, n, random); });
  }
}

const Components first_half = {0, 1, 2, 3}, second_half = {4, 5, 6, 7};

}  // namespace

TEST(each_level_is_the_least_correction_that_leaves_the_levels_before) {
  for_seeds([](unsigned seed, auto draw) {
    Linear held({{draw(2, 8), 0}, {draw(1, 8), 1}, {draw(2, 8), 2}}, seed);
    const Vector projected = held.project();
    CHECK_CLOSE(held.difference(projected, held.reference()), 0, conditioned);
    for (const Rows& one : held.rows) CHECK_CLOSE((one.J * projected).cwiseAbs().maxCoeff(), 0, conditioned);
  });
}

TEST(constraints_of_mechanics_move_positions_then_velocities_then_what_is_left) {
  for_seeds([](unsigned seed, auto draw) {
    RowMajor positions = RowMajor::Zero(2, 8);
    positions.leftCols(4) = draw(2, 4);
    RowMajor rates = draw(2, 8);
    rates.rightCols(4) = positions.leftCols(4);
    Linear held({{positions, 0, first_half}, {rates, 1, second_half}, {draw(1, 8), 2}}, seed);
    CHECK_CLOSE(held.difference(held.project(), held.reference()), 0, conditioned);

    Linear only_positions({{positions, 0, first_half}, {rates, 1, second_half}}, seed);
    Linear alone({{positions}}, seed);
    const Vector both = only_positions.project(), one = alone.project();
    CHECK_CLOSE((both - one).head(4).cwiseAbs().maxCoeff(), 0, conditioned);  // errors of v do not move q
  });
}

TEST(what_may_not_move_stays_to_the_last_bit) {
  for_seeds([](unsigned seed, auto draw) {
    Linear held({{draw(2, 8), 3, second_half}}, seed);
    const Vector projected = held.project();
    CHECK(projected.head(4) == held.y.head(4));
    CHECK(projected.tail(4) != held.y.tail(4));
  });
}

TEST(a_metric_gives_the_correction_that_is_least_in_it) {
  for_seeds([](unsigned seed, auto draw) {
    const RowMajor J = draw(2, 8), root = draw(4, 4);
    const RowMajor G = root * root.transpose() + 0.1 * RowMajor::Identity(4, 4);
    Linear held({{J, 1, second_half, {G.data(), G.data() + G.size()}}}, seed);
    const RowMajor A = J.rightCols(4), weighted = pseudoinverse(G) * A.transpose();
    Vector nearest = held.y;
    nearest.tail(4) -= weighted * smallest_solution(A * weighted, J * held.y);
    CHECK_CLOSE(held.difference(held.project(), nearest), 0, conditioned);
  });
}

TEST(the_weights_of_the_error_test_are_a_metric_as_others_are) {
  for_seeds([](unsigned seed, auto draw) {
    const RowMajor J = draw(2, 8);
    Linear plain({{J, 1}}, seed);
    const Vector diagonal = plain.w.cwiseAbs2().cwiseInverse();
    Linear same({{J, 1, {}, {diagonal.data(), diagonal.data() + diagonal.size()}}}, seed);
    CHECK_CLOSE(plain.difference(plain.project(), same.project()), 0, conditioned);
  });
}

TEST(the_weights_of_the_error_test_stand_for_a_metric_that_is_not_positive_definite) {
  const RowMajor J = RowMajor::Ones(1, 8);
  Linear plain({{J, 1}}, 3), singular({{J, 1, {}, {1, 1, 1, 0, 1, 1, 1, 1}}}, 3);
  CHECK(plain.project() == singular.project());
}

TEST(one_level_is_the_correction_of_all_together) {
  for_seeds([](unsigned seed, auto draw) {
    const RowMajor J = draw(3, 8);
    Linear level({{J, 5}}, seed), joint({{J}}, seed);
    CHECK_CLOSE(level.difference(level.project(), joint.project()), 0, conditioned);
  });
}

TEST(units_of_the_invariants_do_not_matter) {
  for_seeds([](unsigned seed, auto draw) {
    const RowMajor a = draw(2, 8), b = draw(2, 8);
    RowMajor scaled = b;
    scaled.row(0) *= 1e9;
    scaled.row(1) *= 1e-9;
    Linear plain({{a, 0}, {b, 1}}, seed), other({{a, 0}, {scaled, 1}}, seed);
    CHECK_CLOSE(plain.difference(plain.project(), other.project()), 0, conditioned);
  });
}

TEST(rows_that_depend_on_earlier_levels_or_on_nothing_that_moves_are_left_out) {
  for_seeds([](unsigned seed, auto draw) {
    const RowMajor a = draw(2, 8);
    RowMajor later(3, 8);
    later.row(0) = a.row(0) - 2 * a.row(1);
    later.row(1) = draw(1, 8);
    later.row(2).setZero();
    Linear held({{a, 0}, {later, 1}}, seed), independent({{a, 0}, {later.row(1), 1}}, seed);
    std::vector<char> dropped;
    const Vector projected = held.project(&dropped);
    CHECK(dropped == (std::vector<char>{0, 0, 1, 0, 1}));
    CHECK_CLOSE(held.difference(projected, independent.project()), 0, conditioned);
  });
}

TEST(levels_are_iterated_until_roundoff_is_left) {
  Function circle = [](double, const double* y, double* r) {
    r[0] = y[0] * y[0] + y[1] * y[1] - 1;
    r[1] = y[0] * y[2] + y[1] * y[3];
  };
  Function position = [&](double t, const double* y, double* r) {
    double both[2];
    circle(t, y, both);
    r[0] = both[0];
  };
  Function velocity = [&](double t, const double* y, double* r) {
    double both[2];
    circle(t, y, both);
    r[0] = both[1];
  };
  Function d_position = [](double, const double* y, double* J) { J[0] = 2 * y[0], J[1] = 2 * y[1], J[2] = J[3] = 0; };
  Function d_velocity = [](double, const double* y, double* J) { J[0] = y[2], J[1] = y[3], J[2] = y[0], J[3] = y[1]; };
  const Weights weights(1e-6, std::vector<double>(4, 1e-3), {});
  Invariants held(
      4,
      {{.g = as_callback(position), .jacobian = as_callback(d_position), .m = 1, .moves = {0, 1}},
       {.g = as_callback(velocity), .jacobian = as_callback(d_velocity), .m = 1, .level = 1, .moves = {2, 3}}},
      {0, 0}, weights);
  Projector projector(held, weights, 10);
  double y[4] = {0.61, 0.79, 0.3, -0.2}, r[2];
  CHECK(projector.project(0, y, y).outcome == Outcome::ok);
  circle(0, y, r);
  CHECK_CLOSE(r[0], 0, 4 * eps);
  CHECK_CLOSE(r[1], 0, 4 * eps);
  CHECK(held.jacobian_calls() <= 2 * 5);  // quadratically
}

TEST(invariants_of_one_level_may_not_move_different_components) {
  Linear held({{RowMajor::Ones(1, 8), 1, first_half}, {RowMajor::Ones(1, 8), 1, second_half}}, 0);
  Linear beyond({{RowMajor::Ones(1, 8), 1, {8}}}, 0);
  for (Linear* wrong : {&held, &beyond}) {
    bool refused = false;
    try {
      wrong->project();
    } catch (const std::invalid_argument&) {
      refused = true;
    }
    CHECK(refused);
  }
}

TEST(sparse_rows_order_their_factors_anew_where_the_pattern_changes_but_not_the_number_of_its_entries) {
  // Equations of four pairs of unknowns, of which each may move or not: all sets of unknowns, one after the other.
  RowLayout layout(8);
  layout.add(5, {.starts = {0, 2, 4, 6, 8, 10}, .columns = {0, 1, 1, 2, 2, 3, 4, 5, 6, 7}});
  const std::vector<double> values{1, 2, -1, 3, 2, 1, 1, -1, 2, 5};
  const std::vector<std::size_t> rows{0, 1, 2, 3, 4};
  const std::vector<double> right{1, -2, 3, 0.5, 4};
  const auto solve = [&](SparseRows& sparse, unsigned moves, std::vector<double>& x) {
    std::vector<double> scale(8);
    for (std::size_t j = 0; j < 8; ++j) scale[j] = moves >> j & 1U;
    return sparse.least_norm(layout, values.data(), rows, scale, right, 1e-10, x);
  };
  SparseRows again;
  for (unsigned moves = 0; moves < 256; ++moves) {
    const unsigned scattered = moves * 151 % 256;  // neighbours differ in many unknowns
    const check::Case label("moves ", scattered);
    SparseRows fresh;
    std::vector<double> x(8), expected(8);
    const bool solved = solve(again, scattered, x);
    CHECK(solved == solve(fresh, scattered, expected));
    if (solved) CHECK(x == expected);
  }
}

}  // namespace invariode::test::levels_laws
