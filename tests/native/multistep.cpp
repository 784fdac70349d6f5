// Formulas of each order of the methods that vary it: Adams and NDF at constant h with an exact starting history,
// Radau. What they store and reproduce.

#include <array>
#include <type_traits>
#include <vector>

#include "check.hpp"
#include "problems.hpp"

namespace invariode {

/// Access to methods that choose their order themselves.
struct FixedOrder {
  static void hold(Adams& step, int k) { step.order_ = k; }
  static void hold(Ndf& step, int k) { step.order_ = k; }
  static void hold(Radau& step, int) { step.lowest_ = step.highest_; }

  /// Memory of equal steps h and the order k: differences = [∇^0 f … ∇^{k−1} f] at t, each (n,).
  static void remember(Adams& step, int k, double h, const std::vector<double>& differences) {
    std::copy(differences.begin(), differences.end(), step.phi(1));
    step.order_ = step.previous_order_ = k;
    step.phase1_ = false;
    for (int i = 1; i <= k; ++i) step.psi_[static_cast<std::size_t>(i)] = i * h;
  }
  /// The same, where differences = [∇^1 y … ∇^k y].
  static void remember(Ndf& step, int k, double h, const std::vector<double>& differences) {
    std::copy(differences.begin(), differences.end(), step.D(1));
    step.order_ = step.memory_order_ = k;
    step.memory_h_ = h;
  }
};

}  // namespace invariode

namespace invariode::test::multistep_laws {

namespace {

/// ∇^j of the samples v(t), v(t − h), … of n components, v taken at each time by `sample`.
template <class Sample>
std::vector<double> backward_difference(int j, double t, double h, std::size_t n, Sample sample) {
  std::vector<double> sum(n), value(n);
  double binomial = 1;
  for (int i = 0; i <= j; ++i) {
    sample(t - i * h, value.data());
    for (std::size_t c = 0; c < n; ++c) sum[c] += (i % 2 == 0 ? binomial : -binomial) * value[c];
    binomial *= static_cast<double>(j - i) / (i + 1);
  }
  return sum;
}

/// A method with formulas of one order.
template <class Method>
struct Fixed {
  template <class... More>
  Fixed(Callback& f, const Weights& weights, int order, const More&... more)
      : k(order), jacobian(differences(weights)), step(make(f, weights, jacobian, order, more...)) {}

  static Method make(Callback& f, const Weights& weights, const Jacobian& jacobian, int order, bool bdf = false) {
    const LinearAlgebra linear{.jacobian = &jacobian};
    if constexpr (std::is_same_v<Method, Adams>)
      return Adams(f, weights, order);
    else if constexpr (std::is_same_v<Method, Ndf>)
      return Ndf(f, weights, linear, {.max_order = order, .bdf = bdf});
    else
      return Radau(f, weights, linear, order);
  }

  /// At t, with the exact history of steps h.
  template <class Solution, class F>
  void begin(double t, double h, Solution solution, F f) {
    const std::size_t n = step.n();
    std::vector<double> y(n);
    solution(t, y.data());
    FixedOrder::hold(step, k);
    CHECK(step.start(t, y.data(), {.tf = t + h, .hmax = h, .hmin = 0}) == Outcome::ok);
    if constexpr (!std::is_same_v<Method, Radau>) {
      const auto sample = [&](double at, double* out) {
        std::vector<double> exact(n);
        solution(at, exact.data());
        if constexpr (std::is_same_v<Method, Adams>)
          f(at, exact.data(), out);
        else
          std::copy(exact.begin(), exact.end(), out);
      };
      constexpr int first = std::is_same_v<Method, Adams> ? 0 : 1;
      std::vector<double> history;
      for (int i = first; i < first + k; ++i) {
        const std::vector<double> difference = backward_difference(i, t, h, n, sample);
        history.insert(history.end(), difference.begin(), difference.end());
      }
      FixedOrder::remember(step, k, h, history);
    }
  }
  Step::Attempt attempt(double h, double t1) {
    FixedOrder::hold(step, k);
    return step.attempt(h, t1);
  }

  int k;
  Jacobian jacobian;
  Method step;
};
using FixedAdams = Fixed<Adams>;
using FixedNdf = Fixed<Ndf>;
using FixedRadau = Fixed<Radau>;

/// Largest error over [start, start + span] with `count` equal steps, projected or not.
template <class Fixed, class... Formula>
double march(Problem problem, double start, double span, int count, bool project, Formula... formula) {
  const std::size_t n = problem.y0.size();
  const Weights weights(1e-13, std::vector<double>(n, 1), {});
  Callback f = as_callback(problem.f);
  const auto solution = [&](double t, double* y) { problem.solution(t, nullptr, y); };
  problem.solution(start, nullptr, problem.y0.data());
  std::optional<Invariants> invariants;
  std::optional<Projector> projector;
  if (project) projector.emplace(invariants.emplace(make_invariants(problem, weights, true, {})), weights, 1);
  Fixed fixed(f, weights, formula...);
  const double h = span / count;
  fixed.begin(start, h, solution, problem.f);
  Step& step = fixed.step;
  std::vector<double> y1(n), exact(n);
  double error = 0;
  for (int k = 0; k < count; ++k) {
    const double t1 = start + (k + 1) * h;
    const Step::Attempt proposal = fixed.attempt(h, t1);
    CHECK(proposal.outcome == Outcome::ok && proposal.converged);
    std::copy(proposal.y, proposal.y + n, y1.begin());
    if (project) CHECK(projector->project(t1, step.y(), y1.data()).outcome == Outcome::ok);
    CHECK(step.accept(y1.data()) == Outcome::ok);
    solution(t1, exact.data());
    error = std::max(error, distance(y1.data(), exact.data(), n));
  }
  return error;
}

/// The order that the errors with `count` and 3/2 `count` steps show.
template <class Error>
double order(int count, Error error) {
  return std::log(error(count) / error(count + count / 2)) / std::log(1.5);
}

constexpr double slope_tolerance = 0.15;

/// Two oscillators and their total energy, one invariant in four dimensions. The solution has no singularity anywhere
/// in the complex plane, so that high orders show at moderate h.
Problem two_oscillators() {
  const double w = std::sqrt(2.0);
  return {.name = "two oscillators",
          .y0 = {1, 0, 0.5, 0},
          .tf = 4,
          .f = [w](double, const double* y,
                   double* out) { out[0] = y[1], out[1] = -y[0], out[2] = w * y[3], out[3] = -w * y[2]; },
          .m = 1,
          .g = [](double, const double* y,
                  double* r) { r[0] = (y[0] * y[0] + y[1] * y[1] + y[2] * y[2] + y[3] * y[3]) / 2; },
          .jacobian = [](double, const double* y, double* J) { std::copy(y, y + 4, J); },
          .solution =
              [w](double t, const double*, double* y) {
                y[0] = std::cos(t), y[1] = -std::sin(t), y[2] = 0.5 * std::cos(w * t), y[3] = -0.5 * std::sin(w * t);
              }};
}

/// y' = p'(t) of degree k − 1, so that y is a polynomial of degree k.
Problem polynomial(int degree) {
  return {.name = "polynomial",
          .y0 = {0},
          .tf = 4,
          .f = [degree](double t, const double*, double* out) { out[0] = degree * std::pow(t, degree - 1); },
          .solution = [degree](double t, const double*, double* y) { y[0] = std::pow(t, degree); }};
}

}  // namespace

TEST(adams_formulas_of_order_k_have_order_k_plus_1_projected_or_not) {
  // With local extrapolation. Above order 8 what is stable at all is roundoff already; see the next law.
  constexpr int counts[] = {0, 4000, 2000, 1000, 600, 450, 350, 320, 340};
  for (int k = 1; k <= 8; ++k)
    for (const bool project : {false, true}) {
      const check::Case label("order ", k, project ? ", projected" : "");
      const auto error = [&](int count) { return march<FixedAdams>(two_oscillators(), 1, 40, count, project, k); };
      CHECK_CLOSE(order(counts[k], error), k + 1, slope_tolerance);
    }
}

TEST(the_local_error_of_adams_formulas_of_order_k_has_order_k_plus_2) {
  // Of a quadrature of t^{k+1} it is a multiple of h^{k+2}: the fitted order is that, to roundoff.
  for (int k = 1; k <= Adams::highest_order; ++k) {
    const check::Case label("order ", k);
    const auto error = [&](int count) { return march<FixedAdams>(polynomial(k + 2), 0, 4.0 / count, 1, false, k); };
    CHECK_CLOSE(order(2, error), k + 2, 1e-3);
  }
}

TEST(the_local_error_has_that_order_on_oscillators_projected_or_not_as_far_as_roundoff_lets_it_be_seen) {
  for (int k = 1; k <= Adams::highest_order; ++k)
    for (const bool project : {false, true}) {
      const check::Case label("order ", k, project ? ", projected" : "");
      const auto error = [&](int count) { return march<FixedAdams>(two_oscillators(), 1, 1.0 / count, 1, project, k); };
      CHECK_CLOSE(order(k < 6 ? 40 : 8, error), k + 2, k < 6 ? slope_tolerance : 0.7);
    }
}

TEST(bdfs_and_ndfs_of_order_k_have_order_k_projected_or_not) {
  for (int k = 1; k <= Ndf::highest_order; ++k)
    for (const bool bdf : {false, true})
      for (const bool project : {false, true}) {
        const check::Case label(bdf ? "BDF " : "NDF ", k, project ? ", projected" : "");
        const auto error = [&](int count) { return march<FixedNdf>(rigid_body(), 1, 4, count, project, k, bdf); };
        CHECK_CLOSE(order(k == 1 ? 2000 : 400, error), k, slope_tolerance);
      }
}

TEST(radau_formulas_of_s_stages_have_order_2_s_minus_1_projected_or_not) {
  for (const RadauFormula& formula : radau_formulas)
    for (const bool project : {false, true}) {
      const check::Case label("order ", formula.order(), project ? ", projected" : "");
      const auto error = [&](int count) {
        return march<FixedRadau>(two_oscillators(), 1, 40, count, project, formula.order());
      };
      CHECK_CLOSE(order(formula.stages == 3   ? 160
                        : formula.stages == 5 ? 40
                                              : 18,
                        error),
                  formula.order(), formula.stages == 3 ? slope_tolerance : 0.3);
    }
}

TEST(the_extension_of_radau_is_the_collocation_polynomial_exact_for_degree_s) {
  for (const RadauFormula& formula : radau_formulas) {
    const check::Case label("order ", formula.order());
    const int degree = static_cast<int>(formula.stages);
    const auto worst = [&](int power) {  // error inside a step from t = 1 to 2
      Problem problem = polynomial(power);
      const Weights weights(1e-13, {1}, {});
      Callback f = as_callback(problem.f);
      FixedRadau fixed(f, weights, formula.order());
      fixed.begin(1, 1, [&](double t, double* y) { problem.solution(t, nullptr, y); }, problem.f);
      const Step::Attempt proposal = fixed.attempt(1, 2);
      CHECK(fixed.step.accept(proposal.y) == Outcome::ok);
      CHECK(fixed.step.degree() == degree && fixed.step.order() == formula.order());
      std::vector<double> data(fixed.step.extension_size());
      CHECK(fixed.step.extension(data.data()) == Status::ok);
      double largest = 0;
      for (double theta = 0; theta <= 1; theta += 1.0 / 16) {
        double y = 0;
        fixed.step.interpolate()(data.data(), data.size(), 1, std::array{theta}, &y);
        largest = std::max(largest, std::abs(y / std::pow(1 + theta, power) - 1));
      }
      return largest;
    };
    CHECK(worst(degree) < 1e-14 * std::pow(2, degree));
    CHECK(worst(degree + 1) > 1e-6);
  }
}

TEST(formulas_integrate_polynomials_of_their_degree_to_roundoff_also_when_h_changes) {
  // Adams of order k with local extrapolation: degree k + 1. NDF of order k, and Radau: degree k. h follows a fixed
  // pattern.
  constexpr double pattern[] = {1, 1, 1, 0.5, 0.5, 1.25, 1.25, 0.75, 2, 1};
  const auto run = [&](auto& fixed, const Problem& problem) {
    fixed.begin(1, 0.1, [&](double t, double* y) { problem.solution(t, nullptr, y); }, problem.f);
    Step& step = fixed.step;
    double t = 1, exact = 0;
    for (const double factor : pattern) {
      const double h = 0.1 * factor;
      const Step::Attempt proposal = fixed.attempt(h, t + h);
      CHECK(step.accept(proposal.y) == Outcome::ok);
      t = step.t();
      problem.solution(t, nullptr, &exact);
      CHECK_CLOSE(step.y()[0], exact, 1e-11 * exact);
    }
  };
  const Weights weights(1e-10, {1}, {});
  for (int k = 1; k <= Adams::highest_order; ++k) {
    const check::Case label("Adams ", k);
    Problem problem = polynomial(k + 1);
    Callback f = as_callback(problem.f);
    FixedAdams fixed(f, weights, k);
    run(fixed, problem);
  }
  for (int k = 1; k <= Ndf::highest_order; ++k) {
    const check::Case label("NDF ", k);
    Problem problem = polynomial(k);
    Callback f = as_callback(problem.f);
    FixedNdf fixed(f, weights, k, false);
    run(fixed, problem);
  }
  for (const RadauFormula& formula : radau_formulas) {
    const check::Case label("Radau ", formula.order());
    Problem problem = polynomial(formula.order());
    Callback f = as_callback(problem.f);
    FixedRadau fixed(f, weights, formula.order());
    run(fixed, problem);
  }
}

TEST(a_rejected_attempt_is_taken_back_to_roundoff) {
  for (const Method* method : {find_method("ode113"), find_method("ode15s")}) {
    const check::Case label(method->name);
    Problem problem = kepler(0.3);
    const Weights weights(1e-8, std::vector<double>(4, 1e-3), {});
    Callback f = as_callback(problem.f);
    const std::unique_ptr<Step> bench = make_step(*method, f, weights);
    const std::unique_ptr<Step> plain = make_step(*method, f, weights);
    for (Step* step : {bench.get(), plain.get()}) {
      CHECK(step->start(0, problem.y0.data(), {.tf = 10, .hmax = 1, .hmin = 0}) == Outcome::ok);
      for (int k = 0; k < 20; ++k) {
        const double h = step->h();
        const Step::Attempt proposal = step->attempt(h, step->t() + h);
        if (!proposal.converged)
          CHECK(step->reject(Cause::newton, 0));
        else if (proposal.error > 1e-8)
          CHECK(step->reject(Cause::error, 0));
        else
          CHECK(step->accept(std::vector<double>(proposal.y, proposal.y + 4).data()) == Outcome::ok);
      }
    }
    const std::vector<double> y(bench->y(), bench->y() + 4);
    const double h = plain->h(), t = plain->t();
    for (int k = 0; k < 2; ++k) {
      (void)bench->attempt(h, t + h);
      CHECK(bench->reject(Cause::projection, 0));
      CHECK(same_bits(y.data(), bench->y(), 4) && bench->t() == t);
    }
    CHECK(bench->h() < h);
  }
}

TEST(an_ndf_step_stores_differences_of_the_projected_solution) {
  // The polynomial through the stored values passes through the projected ones at both ends of the step.
  Problem problem = kepler(0.5);
  const Weights weights(1e-4, std::vector<double>(4, 1e-3), {});
  Callback f = as_callback(problem.f);
  const std::unique_ptr<Step> step = make_step(named("ode15s"), f, weights);
  CHECK(step->start(0, problem.y0.data(), {.tf = 10, .hmax = 1, .hmin = 0}) == Outcome::ok);
  std::vector<double> before = problem.y0;
  for (int k = 0; k < 10; ++k) {
    const double h = step->h();
    const Step::Attempt proposal = step->attempt(h, step->t() + h);
    std::vector<double> y1(proposal.y, proposal.y + 4);
    for (double& y : y1) y += 1e-5;
    CHECK(step->accept(y1.data()) == Outcome::ok);
    std::vector<double> data(step->extension_size()), y(4);
    CHECK(step->extension(data.data()) == Status::ok);
    step->interpolate()(data.data(), data.size(), 4, std::array{0.0}, y.data());
    CHECK_CLOSE(distance(y.data(), before.data(), 4), 0, 100 * eps);
    step->interpolate()(data.data(), data.size(), 4, std::array{1.0}, y.data());
    CHECK_CLOSE(distance(y.data(), y1.data(), 4), 0, 4 * eps);
    before = y1;
  }
}

TEST(adams_evaluates_twice_a_step_and_once_a_failure_projected_or_not) {
  for (const Problem& problem : {kepler(0.5), without_invariants(kepler(0.5)), lotka_volterra()}) {
    Run run(named("ode113"), problem);
    CHECK(run.run() == State::reached_end);
    const Counts& counts = run->counts();
    CHECK(run->manifold().guard() == nullptr || counts.projections >= counts.steps);
    CHECK(run.f.calls() == 1 + 2 * counts.steps + counts.failed);
  }
}

TEST(the_stiff_circle_is_no_trap) {
  // y stays on the unit circle, its angle relaxes to 1 at a stiff rate: projection hides Newton's errors from Newton.
  for (const double rate : {1e3, 1e6}) {
    Problem circle{.name = "circle",
                   .y0 = {1, 0},
                   .tf = 10,
                   .f =
                       [rate](double, const double* y, double* out) {
                         const double turn = -rate * (std::atan2(y[1], y[0]) - 1);
                         out[0] = -y[1] * turn, out[1] = y[0] * turn;
                       },
                   .m = 1,
                   .g = [](double, const double* y, double* r) { r[0] = y[0] * y[0] + y[1] * y[1]; },
                   .jacobian = [](double, const double* y, double* J) { J[0] = 2 * y[0], J[1] = 2 * y[1]; }};
    Run run(named("ode15s"), circle);
    CHECK(run.run() == State::reached_end);
    CHECK(run->counts().steps <= 250);
    CHECK(run->step().linear_work().jacobians >= 2);
  }
}

TEST(newton_that_fails_with_an_old_jacobian_renews_it_and_keeps_h) {
  // λ jumps from 1 to 1e6 at t = 1, so that the Jacobian of the start is far off.
  Problem problem = scalar("jump", 1, 2, [](double t, const double* y, double* out) {
    out[0] = (t < 1 ? -1 : -1e6) * (y[0] - 1 - 0.1 * t);
  });
  const Weights weights(1e-3, {1e-3}, {});
  Callback f = as_callback(problem.f);
  const std::unique_ptr<Step> step = make_step(named("ode15s"), f, weights);
  CHECK(step->start(0, problem.y0.data(), {.tf = 2, .hmax = 0.1, .hmin = 0}) == Outcome::ok);
  Step::Attempt proposal = step->attempt(0.01, 0.01);
  CHECK(step->accept(std::vector<double>{proposal.y[0]}.data()) == Outcome::ok);
  proposal = step->attempt(1, 1.01);
  CHECK(!proposal.converged);
  CHECK(step->reject(Cause::newton, 0));
  CHECK(step->h() == 1);
  CHECK(step->linear_work().jacobians == 1);
  (void)step->attempt(1, 1.01);
  CHECK(step->linear_work().jacobians == 2);
}

}  // namespace invariode::test::multistep_laws
