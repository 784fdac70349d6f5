// Orders of convergence, with fixed steps through the step contract, on a rigid body, whose solution is known.

#include <Eigen/Core>
#include <algorithm>
#include <vector>

#include "check.hpp"
#include "decompositions.hpp"
#include "problems.hpp"

namespace invariode::test::order_laws {

namespace {

/// From order 8 on double precision leaves hardly an asymptotic range: the tableau's own conditions say more.
double slope_tolerance(const Method& method) { return method.order >= 8 ? 0.25 : 0.15; }

/// The leading error coefficients of ode78 are below 1e-6: until roundoff shows, terms of higher order outweigh them.
/// Those of ode89 take a smaller part, but still half of an order.
double slope_excess(const Method& method) {
  return is(method, "ode78") ? 3 : method.order > 8 ? 0.5 : slope_tolerance(method);
}

/// How the steps are projected, or that they are not.
struct Mode {
  const char* name;
  bool project;
  Fsal fsal;
};
constexpr Mode modes[] = {{"plain", false, Fsal::reuse},
                          {"projected, reuse", true, Fsal::reuse},
                          {"projected, evaluate", true, Fsal::evaluate}};

/// Largest errors of a run: of y at the step ends and of the interpolated values inside the steps.
struct Errors {
  double steps = 0;
  double between = 0;
};

/// Integrates with `count` equal steps, as the loop does: attempt, project, accept.
Errors march(const Method& method, const Mode& mode, Problem problem, int count) {
  const std::size_t n = problem.y0.size();
  const Weights weights(1e-3, std::vector<double>(n, 1e-3), {});
  Callback f = as_callback(problem.f);
  Invariants invariants = make_invariants(problem, weights, true, {});
  Projector projector(invariants, weights, method.iterations), other(invariants, weights, 1);
  const std::unique_ptr<Step> step = make_step(method, f, weights, mode.fsal);
  StepInterpolant interpolant(*step, n, mode.project ? Interpolation::projected : Interpolation::raw,
                              mode.project ? &other : nullptr, nullptr, mode.project ? &projector : nullptr);
  const double h = problem.tf / count;
  Errors errors;
  std::vector<double> y0 = problem.y0, y1(n), inside(n), exact(n);
  CHECK(step->start(0, y0.data(), {problem.tf, infinity, 0}) == Outcome::ok);
  for (int k = 0; k < count; ++k) {
    const double t0 = step->t(), t1 = k + 1 == count ? problem.tf : t0 + h;
    const Step::Attempt proposal = step->attempt(t1 - t0, t1);
    std::copy(proposal.y, proposal.y + n, y1.begin());
    if (mode.project) CHECK(projector.project(t1, y0.data(), y1.data()).outcome == Outcome::ok);
    CHECK(step->accept(y1.data()) == Outcome::ok);
    interpolant.accept(t0, y0.data());
    for (const double theta : {0.3, 0.5, 0.8}) {
      const double t = t0 + theta * (t1 - t0);
      CHECK(interpolant.value(t, inside.data()) == Status::ok);
      problem.solution(t, nullptr, exact.data());
      errors.between = std::max(errors.between, distance(inside.data(), exact.data(), n));
    }
    std::copy(y1.begin(), y1.end(), y0.begin());
    problem.solution(t1, nullptr, exact.data());
    errors.steps = std::max(errors.steps, distance(y0.data(), exact.data(), n));
  }
  return errors;
}

/// Least-squares slope of log error over log h, with the numbers of steps doubled from the first.
template <class Error>
double slope(int first, int levels, Error error) {
  double sx = 0, sy = 0, sxx = 0, sxy = 0;
  for (int k = 0; k < levels; ++k) {
    const int count = first << k;
    const double x = -std::log(count), y = std::log(error(count));
    sx += x, sy += y, sxx += x * x, sxy += x * y;
  }
  return (levels * sxy - sx * sy) / (levels * sxx - sx * sx);
}

constexpr int levels = 3;
/// Numbers of steps with which errors are small, and far above roundoff.
int coarsest(const Method& method) {
  return is(method, "ode78") ? 12 : method.order > 8 ? 16 : method.order == 8 ? 24 : 128;
}

Problem long_run() {
  Problem problem = rigid_body();
  problem.tf = 10;
  return problem;
}

/// One step of size h from a point of no symmetry.
Problem one_step(double h) {
  constexpr double start = 0.7;
  Problem problem = rigid_body();
  problem.tf = h;
  problem.solution(start, nullptr, problem.y0.data());
  problem.solution = [exact = problem.solution](double t, const double* y, double* out) { exact(start + t, y, out); };
  return problem;
}

}  // namespace

TEST(the_global_error_at_the_steps_has_the_order_of_the_method_projected_or_not) {
  for (const Method& method : pairs())
    for (const Mode& mode : modes) {
      const check::Case label(method.name, ", ", mode.name);
      const auto error = [&](int count) { return march(method, mode, long_run(), count).steps; };
      const double found = slope(coarsest(method), levels, error);
      CHECK(found > method.order - slope_tolerance(method) && found < method.order + slope_excess(method));
    }
}

TEST(the_global_error_between_the_steps_has_the_order_of_the_method_projected_or_not) {
  for (const Method& method : pairs())
    for (const Mode& mode : modes) {
      const check::Case label(method.name, ", ", mode.name);
      const auto error = [&](int count) { return march(method, mode, long_run(), count).between; };
      const double excess = method.order > 8 ? slope_excess(method) : slope_tolerance(method);
      const double found = slope(coarsest(method), levels, error);
      CHECK(found > method.order - slope_tolerance(method) && found < method.order + excess);
    }
}

TEST(the_local_error_of_the_extension_is_one_order_above_that_of_the_extension) {
  for (const Method& method : pairs())
    for (const Mode& mode : modes) {
      const check::Case label(method.name, ", ", mode.name);
      const auto error = [&](int count) { return march(method, mode, one_step(1.0 / count), 1).between; };
      const int largest = method.order > 8 ? 1 : method.order == 8 ? 3 : 32;  // steps of size 1/largest
      CHECK_CLOSE(slope(largest, levels, error), method.extension_order + 1,
                  method.order >= 8 ? 0.6 : slope_tolerance(method));
    }
}

TEST(projection_removes_the_part_of_the_local_error_that_is_normal_to_the_manifold) {
  // To leading order the local error is multiplied by P = I − W² Jᵀ (J W² Jᵀ)⁻¹ J: never longer in the norm of W.
  for (const Method& method : pairs()) {
    const check::Case label(method.name);
    const double h = method.order >= 8 ? 0.5 : 0.05;  // errors far above roundoff
    Problem problem = kepler(0.3);
    const Weights weights(1e-3, std::vector<double>(4, 1), {});
    Callback f = as_callback(problem.f);
    Invariants invariants = make_invariants(problem, weights, true, {});
    Projector projector(invariants, weights, method.iterations);
    const std::unique_ptr<Step> step = make_step(method, f, weights);
    CHECK(step->start(0, problem.y0.data(), {1, 1, 0}) == Outcome::ok);
    const Step::Attempt proposal = step->attempt(h, h);
    double exact[4], y1[4];
    problem.solution(h, nullptr, exact);
    std::copy(proposal.y, proposal.y + 4, y1);
    CHECK(projector.project(h, problem.y0.data(), y1).outcome == Outcome::ok);
    Eigen::Vector4d before, after;
    Eigen::MatrixXd JW(2, 4);
    for (int j = 0; j < 4; ++j) {
      const double w = projector.linearization().w[static_cast<std::size_t>(j)];
      before[j] = (proposal.y[j] - exact[j]) / w;
      after[j] = (y1[j] - exact[j]) / w;
      for (int i = 0; i < 2; ++i)
        JW(i, j) =
            projector.linearization().gradient(static_cast<std::size_t>(i)).entry(static_cast<std::size_t>(j)) * w;
    }
    const Eigen::Vector4d expected = before - JW.transpose() * pseudoinverse(JW * JW.transpose()) * (JW * before);
    CHECK_CLOSE((after - expected).norm(), 0, 1e-3 * before.norm());
    CHECK(after.norm() < before.norm());
  }
}

}  // namespace invariode::test::order_laws
