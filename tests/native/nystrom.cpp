// The Runge-Kutta-Nystrom pairs: tableaux that are what they say, orders of convergence, compensated sums.

#include "methods/nystrom.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <numeric>
#include <vector>

#include "check.hpp"
#include "compensated.hpp"
#include "methods.hpp"
#include "problems.hpp"

namespace invariode::test::nystrom_laws {

namespace {

constexpr double misprint = 1e-6;  // relative: far above roundoff, far below a wrong digit that shows
constexpr double broken = 1e-9;    // below what is left in the conditions of the next order

/// What is left of exact cancellation; rkn1210 has coefficients of size 50, and larger ones in the extension.
template <class T>
constexpr double roundoff_of(const T& table) {
  return table.order >= 12 ? 3e-12 : 1e-12;
}

template <class Each, const auto&... T>
void for_each_pair(Each each, runge_kutta::Tableaux<T...>) {
  const auto look = [&](const auto& table) {
    const check::Case label(table.name);
    each(table);
  };
  (look(T), ...);
}
template <class Each>
void for_each_pair(Each each) {
  for_each_pair(each, nystrom::Pairs());
}

/// Calls each(name, row, column, coefficient) for every coefficient.
template <class T, class Each>
void for_each_coefficient(T& table, Each each) {
  for (std::size_t i = 0; i < T::stages; ++i) {
    each("E_q", i, 0, table.E_q[i]);
    each("E_v", i, 0, table.E_v[i]);
  }
  for (std::size_t i = 0; i < T::all_stages; ++i) {
    each("c", i, 0, table.c[i]);
    each("b", i, 0, table.b[i]);
    for (std::size_t j = 0; j < T::all_stages; ++j) each("A", i, j, table.A[i][j]);
    for (std::size_t j = 0; j < T::degree; ++j) {
      each("B_q", i, j, table.B_q[i][j]);
      each("B_v", i, j, table.B_v[i][j]);
    }
  }
}

/// Largest errors with `count` equal steps: at their ends and inside.
struct Errors {
  double steps = 0, between = 0;
};
Errors march(const Method& method, Problem problem, int count) {
  const std::size_t n = problem.y0.size();
  const Weights weights(1e-3, std::vector<double>(n, 1e-3), {});
  Callback f = as_callback(problem.f);
  const std::unique_ptr<Step> step = method.step(f, weights);
  std::vector<double> inside(n), exact(n), data(step->extension_size());
  CHECK(step->start(0, problem.y0.data(), {problem.tf, infinity, 0}) == Outcome::ok);
  Errors errors;
  for (int k = 0; k < count; ++k) {
    const double t0 = step->t(), t1 = problem.tf * (k + 1) / count;
    const Step::Attempt proposal = step->attempt(t1 - t0, t1);
    CHECK(proposal.outcome == Outcome::ok && step->accept(proposal.y) == Outcome::ok);
    CHECK(step->extension(data.data()) == Status::ok);
    for (const double theta : {0.3, 0.5, 0.8}) {
      step->interpolate()(data.data(), data.size(), n, std::array{theta}, inside.data());
      problem.solution(t0 + theta * (t1 - t0), nullptr, exact.data());
      errors.between = std::max(errors.between, distance(inside.data(), exact.data(), n));
    }
    problem.solution(t1, nullptr, exact.data());
    errors.steps = std::max(errors.steps, distance(step->y(), exact.data(), n));
  }
  return errors;
}

}  // namespace

TEST(the_tableaux_are_consistent) {
  for_each_pair([](const auto& table) { CHECK(consistent(table, roundoff_of(table))); });
}

TEST(a_misprint_in_any_single_coefficient_is_found) {
  for_each_pair([](const auto& table) {
    auto changed = table;
    for_each_coefficient(changed, [&](const char* name, std::size_t i, std::size_t j, double& coefficient) {
      const check::Case label(name, "[", i, "][", j, "]");
      const double right = coefficient;
      coefficient = std::abs(right) < misprint ? right + misprint : right * (1 + misprint);
      CHECK(!consistent(changed, roundoff_of(table)));
      coefficient = right;
    });
  });
}

TEST(the_orders_claimed_are_the_orders_reached) {
  for_each_pair([](const auto& T) {
    auto lower_q = T.b_bar(), lower_v = T.b;
    for (std::size_t k = 0; k < T.stages; ++k) lower_q[k] -= T.E_q[k], lower_v[k] -= T.E_v[k];
    const auto sharp = [&](Nystrom sum, const auto& weights, int order, double theta) {
      CHECK(nystrom_defect(T.A, T.c, weights, sum, order, theta) < roundoff_of(T));
      CHECK(nystrom_defect(T.A, T.c, weights, sum, order + 1, theta) > broken);
    };
    sharp(Nystrom::position, T.b_bar(), T.order, 1);
    sharp(Nystrom::velocity, T.b, T.order, 1);
    sharp(Nystrom::position, lower_q, T.error_order, 1);
    sharp(Nystrom::velocity, lower_v, T.error_order, 1);
    sharp(Nystrom::position, nested_weights(T.B_q, 0.4), T.extension_order + 1, 0.4);
    sharp(Nystrom::velocity, nested_weights(T.B_v, 0.4), T.extension_order, 0.4);
  });
}

TEST(errors_fall_as_the_orders_say) {
  for (const Method& method : methods()) {
    if (method.equations != Equations::second_order) continue;
    const check::Case label(method.name);
    Problem problem = harmonic();
    problem.tf = 12;
    const int coarse = method.order >= 12 ? 10 : method.order >= 8 ? 20 : 40, fine = 3 * coarse / 2;
    const Errors first = march(method, problem, coarse), second = march(method, problem, fine);
    const auto order = [&](double a, double b) { return std::log(a / b) / std::log(1.0 * fine / coarse); };
    CHECK(order(first.steps, second.steps) > method.order - 0.5);
    CHECK(order(first.between, second.between) > method.extension_order - 0.5);
  }
}

TEST(a_sum_keeps_what_rounding_drops) {
  constexpr int count = 1000000;
  constexpr double part = 1e-17;  // far below half an ulp of 1
  Remainder remainder(1);
  double y = 1;
  for (int k = 0; k < count; ++k) {
    y = remainder.propose(0, y, part);
    remainder.accept();
  }
  CHECK(std::abs((y - 1) + remainder[0] - count * part) < count * eps * part);
  const double rejected = remainder.propose(0, y, 1.0 / 3);  // leaves no trace
  const auto [value, lost] = two_sum(y, part + remainder[0]);
  CHECK(rejected != value && remainder.propose(0, y, part) == value);
  remainder.accept();
  CHECK(remainder[0] == lost);
  remainder.clear();
  CHECK(remainder[0] == 0);
}

}  // namespace invariode::test::nystrom_laws
