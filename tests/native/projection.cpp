// The projection is the minimum-norm Newton correction in the norm of the weights, whatever the units and rank of g.

#include <Eigen/Core>
#include <algorithm>
#include <complex>
#include <random>
#include <vector>

#include "check.hpp"
#include "decompositions.hpp"
#include "problems.hpp"

namespace invariode::test::projection_laws {

namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Vector = Eigen::VectorXd;

/// Invariants J y of a matrix, with the value `value`: one Newton iteration is exact.
struct Linear {
  Linear(RowMajor matrix, const Vector& value, const Weights& weights)
      : J(std::move(matrix)),
        invariants(static_cast<std::size_t>(J.cols()),
                   {{.g = as_callback(g), .jacobian = as_callback(jacobian), .m = static_cast<std::size_t>(J.rows())}},
                   {value.data(), value.data() + value.size()}, weights) {}
  Linear(const Linear&) = delete;

  RowMajor J;
  Function g = [this](double, const double* y, double* r) {
    Eigen::Map<Vector>(r, J.rows()) = J * Eigen::Map<const Vector>(y, J.cols());
  };
  Function jacobian = [this](double, const double*, double* out) { std::copy(J.data(), J.data() + J.size(), out); };
  Invariants invariants;
};

/// A random linear projection problem: y* near `from`, weights of different sizes.
struct Sample {
  Sample(int m, int n, unsigned seed)
      : random(seed),
        J(draw(m, n)),
        from(draw(n, 1)),
        y(from + 0.1 * draw(n, 1)),
        value(J * from),
        weights(1e-9, thresholds(n), {}) {}

  RowMajor draw(int rows, int columns) {
    std::normal_distribution<double> normal;
    return RowMajor::NullaryExpr(rows, columns, [&] { return normal(random); });
  }
  std::vector<double> thresholds(int n) {
    std::vector<double> thr(static_cast<std::size_t>(n));
    for (double& w : thr) w = std::exp(3 * draw(1, 1)(0));
    return thr;
  }
  /// y projected onto J y = value by the projector.
  Vector project(const RowMajor& matrix, const Vector& target, std::vector<char>* dropped = nullptr) const {
    Linear linear(matrix, target, weights);
    Projector projector(linear.invariants, weights, 1);
    Vector result = y;
    CHECK(projector.project(0, from.data(), result.data()).outcome == Outcome::ok);
    if (dropped) *dropped = projector.dropped();
    return result;
  }
  [[nodiscard]] Vector project() const { return project(J, value); }
  /// The same by the dense formula y − W² Jᵀ (J W² Jᵀ)⁻¹ (J y − value).
  [[nodiscard]] Vector reference() const {
    Vector w(y.size());
    weights.fill(from.data(), y.data(), w.data());
    const RowMajor W2Jt = w.cwiseAbs2().asDiagonal() * J.transpose();
    return y - W2Jt * smallest_solution(J * W2Jt, J * y - value);
  }
  /// max_i |a_i − b_i| / w_i.
  [[nodiscard]] double difference(const Vector& a, const Vector& b) const {
    Vector w(y.size());
    weights.fill(from.data(), y.data(), w.data());
    return (a - b).cwiseQuotient(w).cwiseAbs().maxCoeff();
  }

  /// What roundoff may do to a result whose errors grow as κ^power, κ the condition of the rows of J W scaled to 1.
  [[nodiscard]] double roundoff(int power) const {
    Vector w(y.size());
    weights.fill(from.data(), y.data(), w.data());
    const RowMajor rows = (J * w.asDiagonal()).rowwise().normalized();
    const double condition = rows.norm() * pseudoinverse(rows).norm();
    const double size = 1 + y.cwiseQuotient(w).cwiseAbs().maxCoeff() + difference(y, project());
    return 20 * eps * std::pow(condition, power) * size;
  }

  std::mt19937 random;
  RowMajor J;
  Vector from, y, value;
  Weights weights;
};

template <class Check>
void for_samples(Check check_sample) {
  unsigned seed = 0;
  for (int m = 1; m <= 3; ++m)
    for (int n = 4; n <= 7; ++n)
      for (int repeat = 0; repeat < 20; ++repeat, ++seed) {
        const check::Case label("m = ", m, ", n = ", n, ", seed ", seed);
        check_sample(Sample(m, n, seed));
      }
}

int count(const std::vector<char>& flags) { return static_cast<int>(std::count(flags.begin(), flags.end(), 1)); }

}  // namespace

TEST(one_iteration_is_the_correction_of_least_weighted_norm) {
  for_samples([](const Sample& s) { CHECK_CLOSE(s.difference(s.project(), s.reference()), 0, s.roundoff(2)); });
}

TEST(rows_that_nearly_depend_on_each_other_cost_their_condition_and_not_its_square) {
  // The reference is the minimum-norm solution in long double: the rows one after the other, each corrected along its
  // part that is orthogonal to those before it, by Gram and Schmidt's process twice.
  using Precise = Eigen::Matrix<long double, Eigen::Dynamic, 1>;
  for_samples([](const Sample& s) {
    if (s.J.rows() < 2) return;
    for (const double apart : {1e-1, 1e-3, 1e-5}) {
      Sample near = s;
      near.J.row(1) = s.J.row(0) + apart * s.J.row(1);
      near.value = near.J * near.from;
      Vector weight(near.y.size());
      near.weights.fill(near.from.data(), near.y.data(), weight.data());
      const Precise w = weight.cast<long double>(), y = near.y.cast<long double>();
      Precise moved = Precise::Zero(y.size());
      std::vector<Precise> basis;
      for (Eigen::Index i = 0; i < near.J.rows(); ++i) {
        const Precise J = near.J.row(i).cast<long double>(), row = J.cwiseProduct(w);
        Precise along = row / row.norm();
        for (int pass = 0; pass < 2; ++pass)
          for (const Precise& before : basis) along -= before.dot(along) * before;
        along.normalize();
        moved += (J.dot(y) - static_cast<long double>(near.value[i]) - row.dot(moved)) / row.dot(along) * along;
        basis.push_back(along);
      }
      const Vector expected = near.y - moved.cwiseProduct(w).cast<double>();
      const check::Case label("rows apart by ", apart);
      std::vector<char> dropped;
      CHECK_CLOSE(near.difference(near.project(near.J, near.value, &dropped), expected), 0, near.roundoff(1));
      CHECK(count(dropped) == 0);
    }
  });
}

TEST(the_units_of_an_invariant_do_not_matter) {
  for_samples([](const Sample& s) {
    const Vector expected = s.project();
    for (const double unit : {1e-12, 1e12, 1e-200, 1e200}) {
      RowMajor J = s.J;
      Vector value = s.value;
      J.row(0) *= unit;
      value[0] *= unit;
      std::vector<char> dropped;
      CHECK_CLOSE(s.difference(s.project(J, value, &dropped), expected), 0, s.roundoff(1));
      CHECK(count(dropped) == 0);
    }
  });
}

TEST(a_redundant_row_is_dropped_and_flagged_and_changes_nothing) {
  for_samples([](const Sample& s) {
    if (s.J.rows() != 2) return;
    RowMajor J(3, s.J.cols());
    J << s.J, 2 * s.J.row(0) - 3 * s.J.row(1);
    Vector value(3);
    value << s.value, 2 * s.value[0] - 3 * s.value[1];
    std::vector<char> dropped;
    CHECK_CLOSE(s.difference(s.project(J, value, &dropped), s.project()), 0, s.roundoff(2));
    CHECK(count(dropped) == 1);
  });
}

TEST(a_zero_row_is_dropped_and_flagged_and_changes_nothing) {
  for_samples([](const Sample& s) {
    RowMajor J = RowMajor::Zero(s.J.rows() + 1, s.J.cols());
    J.bottomRows(s.J.rows()) = s.J;
    Vector value(J.rows());
    value << -1, s.value;  // cannot be met: must not poison the others
    std::vector<char> dropped;
    CHECK_CLOSE(s.difference(s.project(J, value, &dropped), s.project()), 0, s.roundoff(1));
    CHECK(count(dropped) == 1 && dropped[0] == 1);
  });
  const Sample s(1, 4, 0);
  std::vector<char> dropped;
  CHECK(s.project(RowMajor::Zero(1, 4), Vector::Ones(1), &dropped) == s.y);
  CHECK(count(dropped) == 1);
}

TEST(the_correction_reported_is_the_largest_move_in_units_of_the_weights) {
  for_samples([](const Sample& s) {
    Linear linear(s.J, s.value, s.weights);
    Projector projector(linear.invariants, s.weights, 1);
    Vector y = s.y;
    const Projected did = projector.project(0, s.from.data(), y.data());
    CHECK(did.outcome == Outcome::ok && did.rank == static_cast<std::size_t>(s.J.rows()));
    CHECK_CLOSE(did.correction, s.difference(s.y, y), 0);
  });
}

/// The residual of y = (1 + d) e on the unit sphere is d + d²/2, and the second correction d²/2 of it, of which
/// gradients at y are wrong by d.
TEST(a_second_correction_takes_new_gradients_only_where_the_old_ones_leave_more_than_roundoff) {
  Function g = [](double, const double* y, double* r) { r[0] = (y[0] * y[0] + y[1] * y[1]) / 2; };
  Function jacobian = [](double, const double* y, double* out) { std::copy_n(y, 2, out); };
  const Weights weights(1e-3, {1e-3, 1e-3}, {});
  for (const bool between : {false, true})
    for (const double d : {1e-1, 1e-2, 1e-4, 3e-6, 1e-6, 1e-8, 1e-12, 0.0}) {
      const check::Case label("between = ", between, ", d = ", d);
      Invariants invariants(2, {{.g = as_callback(g), .jacobian = as_callback(jacobian), .m = 1}}, {0.5}, weights);
      Projector projector(invariants, weights, 2);
      const double from[] = {0.8, -0.6}, w[] = {1, 1}, target = 0;
      double y[] = {0.6 * (1 + d), 0.8 * (1 + d)}, left = 0;
      const Outcome outcome = between ? projector.onto(0, w, &target, y, 2) : projector.project(0, from, y).outcome;
      CHECK(outcome == Outcome::ok);
      CHECK(invariants.residual(0, y, &left) == Status::ok);
      CHECK(std::abs(left) <= 4 * eps + std::pow(d, 4));
      if (!between || d > 1e-10) CHECK(invariants.jacobian_calls() == (d > 1e-5 ? 2 : 1));
    }
}

TEST(impose_reaches_roundoff_and_keeps_points_that_have) {
  for (Problem problem : {harmonic(), kepler(0.6), pendulum(), rigid_body(), lotka_volterra()})
    for (const bool user_jacobian : {true, false}) {
      const check::Case label(problem.name, user_jacobian ? "" : ", difference Jacobian");
      const std::size_t n = problem.y0.size();
      const Weights weights(1e-3, std::vector<double>(n, 1e-3), {});
      Invariants invariants = make_invariants(problem, weights, user_jacobian, {});
      Projector projector(invariants, weights, 1);
      std::vector<double> y = problem.y0, r(problem.m), J(problem.m * n);
      for (std::size_t i = 0; i < n; ++i) y[i] += i % 2 ? 0.05 : -0.03;
      Imposed imposed = projector.impose(0, y.data());
      CHECK(imposed.outcome == Outcome::ok && imposed.converged && imposed.iterations < 20);
      CHECK(invariants.residual(0, y.data(), r.data()) == Status::ok);
      CHECK(invariants.jacobian(0, y.data(), J.data()) == Status::ok);
      for (std::size_t i = 0; i < problem.m; ++i) CHECK(std::abs(r[i]) <= invariants.roundoff(i, y.data(), J.data()));
      imposed = projector.impose(0, y.data());
      CHECK(imposed.converged);
    }
}

TEST(impose_leaves_points_that_do_not_converge_as_they_were) {
  const Function sum_of_squares = [](double, const double* y, double* r) { r[0] = y[0] * y[0] + y[1] * y[1]; };
  const Function logarithm = [](double, const double* y, double* r) { r[0] = std::log(y[0] - 1) + y[1]; };
  const Weights weights(1e-3, {1e-3, 1e-3}, {});
  for (const Function& function : {sum_of_squares, logarithm}) {
    Function g = function;
    Invariants invariants(2, {{.g = as_callback(g), .m = 1}}, {-1}, weights);  // no such point, or NaN at this one
    Projector projector(invariants, weights, 1);
    const std::vector<double> before = {0.3, -0.4};
    std::vector<double> y = before;
    const Imposed imposed = projector.impose(0, y.data());
    CHECK(imposed.outcome == Outcome::ok && !imposed.converged);
    CHECK(same_bits(y, before));
  }
}

TEST(an_invariant_that_is_not_finite_fails_the_projection) {
  for (const double bad : {NaN, infinity})
    for (int place = 0; place < 2; ++place) {
      Sample s(2, 4, 1);
      Linear linear(s.J, s.value, s.weights);
      const Function g = linear.g;
      linear.g = [&](double t, const double* y, double* r) {
        g(t, y, r);
        r[place] = bad;
      };
      Projector projector(linear.invariants, s.weights, 1);
      Vector y = s.y;
      CHECK(projector.project(0, s.from.data(), y.data()).outcome == Outcome::not_finite);
      CHECK(projector.onto(0, projector.linearization().w.data(), s.value.data(), y.data(), 3) == Outcome::not_finite);
    }
}

TEST(entries_of_a_jacobian_that_are_not_finite_are_those_of_differences) {
  // g is linear, so its differences are off by roundoff alone: ε of its values, divided by increments of ε^{1/3}.
  for (const double bad : {NaN, infinity})
    for (int place = 0; place < 4; ++place) {
      Sample s(2, 4, 1);
      Linear linear(s.J, s.value, s.weights);
      Vector exact(8), found(8);
      CHECK(linear.invariants.jacobian(0, s.y.data(), exact.data()) == Status::ok);
      const Function jacobian = linear.jacobian;
      linear.jacobian = [&](double t, const double* y, double* J) {
        jacobian(t, y, J);
        J[place] = bad;
      };
      CHECK(linear.invariants.jacobian(0, s.y.data(), found.data()) == Status::ok);
      for (Eigen::Index e = 0; e < exact.size(); ++e) CHECK_CLOSE(found[e], exact[e], 1e-8);
    }
}

TEST(the_difference_jacobian_agrees_with_the_analytic_one) {
  // Central differences with increment ε^{1/3} w: error ε^{2/3} ≈ 4e-11 of the terms, times third derivatives.
  for (Problem problem : {harmonic(), kepler(0.3), pendulum(), rigid_body(), lotka_volterra()}) {
    const check::Case label(problem.name);
    const std::size_t n = problem.y0.size(), size = problem.m * n;
    const Weights weights(1e-3, std::vector<double>(n, 1e-3), {});
    Invariants invariants = make_invariants(problem, weights, true, {});
    std::vector<double> y = problem.y0, exact(size), differences(size);
    for (std::size_t i = 0; i < n; ++i) y[i] += 0.1 * static_cast<double>(i + 1);
    CHECK(invariants.jacobian(0, y.data(), exact.data()) == Status::ok);
    CHECK(invariants.difference_jacobian(0, y.data(), differences.data(), true) == Status::ok);
    CHECK_CLOSE(distance(exact.data(), differences.data(), size), 0, 1e-9);
  }
}

TEST(blocks_with_and_without_a_user_jacobian_stand_side_by_side) {
  Problem with = harmonic(), without = harmonic();
  without.g = [](double, const double* y, double* r) { r[0] = y[0] + y[1], r[1] = y[0] * y[1]; };
  const Weights weights(1e-3, {1e-3, 1e-3}, {});
  const InvariantBlock differences{.g = as_callback(without.g), .m = 2};
  const InvariantBlock analytic{.g = as_callback(with.g), .jacobian = as_callback(with.jacobian), .m = 1};
  Invariants invariants(2, {differences, analytic, differences}, {1, 2, 3, 4, 5}, weights);
  const double y[] = {3, 4};
  double r[5], J[10];
  CHECK(invariants.residual(0, y, r) == Status::ok);
  CHECK(invariants.jacobian(0, y, J) == Status::ok);
  const double residual[] = {7 - 1, 12 - 2, 12.5 - 3, 7 - 4, 12 - 5}, expected[] = {1, 1, 4, 3, 3, 4, 1, 1, 4, 3};
  CHECK(same_bits(r, residual, 5));
  CHECK_CLOSE(distance(J, expected, 10), 0, 1e-9);
  for (std::size_t i = 0; i < 5; ++i) CHECK(invariants.by_differences(i) == (i != 2));
}

TEST(complex_steps_are_exact_and_forward_differences_are_good_to_half_the_digits) {
  // g = sin(x) exp(y), with pairs of reals in and out for the complex step.
  Function g = [](double, const double* y, double* r) { r[0] = std::sin(y[0]) * std::exp(y[1]); };
  Function complex_g = [](double, const double* y, double* r) {
    const std::complex<double> value = std::sin(std::complex(y[0], y[1])) * std::exp(std::complex(y[2], y[3]));
    r[0] = value.real(), r[1] = value.imag();
  };
  const Weights weights(1e-3, {1e-3, 1e-3}, {});
  const double y[] = {0.7, -0.3};
  const double exact[] = {std::cos(0.7) * std::exp(-0.3), std::sin(0.7) * std::exp(-0.3)};
  double J[2];
  Invariants by_step(
      2, {{.g = as_callback(g), .complex_g = as_callback(complex_g), .derivative = Derivative::complex_step, .m = 1}},
      {0}, weights);
  CHECK(by_step.jacobian(0, y, J) == Status::ok);
  CHECK_CLOSE(distance(J, exact, 2), 0, 4 * eps);
  CHECK(!by_step.by_differences(0) && by_step.derivative_calls() == 2 && by_step.calls() == 2);
  Invariants forward(2, {{.g = as_callback(g), .derivative = Derivative::forward, .m = 1}}, {0}, weights);
  CHECK(forward.jacobian(0, y, J) == Status::ok);
  CHECK_CLOSE(distance(J, exact, 2), 0, 1e-7);
  CHECK(forward.by_differences(0) && forward.derivative_calls() == 3);
}

TEST(a_function_that_takes_no_complex_step_goes_over_to_central_differences) {
  Function g = [](double, const double* y, double* r) { r[0] = y[0] * y[0]; };
  Function complex_g = [](double, const double*, double* r) { r[0] = r[1] = NaN; };
  const Weights weights(1e-3, {1e-3}, {});
  Invariants invariants(
      1, {{.g = as_callback(g), .complex_g = as_callback(complex_g), .derivative = Derivative::complex_step, .m = 1}},
      {0}, weights);
  const double y = 3;
  double J = 0;
  CHECK(invariants.jacobian(0, &y, &J) == Status::ok);
  CHECK_CLOSE(J, 6, 1e-8);
  CHECK(invariants.by_differences(0));
  CHECK(invariants.blocks()[0].derivative == Derivative::central);
}

TEST(a_candidate_that_is_close_enough_is_left_alone) {
  Problem problem = harmonic();
  const Weights weights(1e-3, {1e-3, 1e-3}, {});
  Invariants invariants = make_invariants(problem, weights, true, {});
  Projector projector(invariants, weights, 1, 0.01);
  double y[] = {1 + 5e-6, 0};  // the first candidate has no gradient to be judged by
  Projected did = projector.project(0, problem.y0.data(), y);
  CHECK(did.outcome == Outcome::ok && !did.skipped);
  y[0] = 1 + 5e-6;
  did = projector.project(0, problem.y0.data(), y);
  CHECK(did.outcome == Outcome::ok && did.skipped && y[0] == 1 + 5e-6 && did.correction == 0);
  CHECK_CLOSE(did.distance[0], 5e-6, 1e-9);
  y[0] = 1 + 5e-5;
  did = projector.project(0, problem.y0.data(), y);
  CHECK(did.outcome == Outcome::ok && !did.skipped);
  CHECK_CLOSE(y[0], 1, 1e-8);
}

}  // namespace invariode::test::projection_laws
