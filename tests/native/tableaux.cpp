// A tableau is what it says, and no misprint passes.

#include "methods/runge_kutta.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <set>

#include "check.hpp"
#include "methods/runge_kutta_kernel.hpp"
#include "methods/stability.hpp"

namespace invariode::test::tableaux_laws {

namespace {

constexpr double broken = 1e-7;    // far above roundoff, below what is left in the conditions of the next order
constexpr double misprint = 1e-6;  // relative: far above tableau_roundoff, far below a wrong digit that shows

/// What is left of exact cancellation; the pairs of order 8 have coefficients of size 100, and larger in the extension.
template <class T>
constexpr double roundoff_of(const T& table) {
  return table.order >= 8 ? 1e-12 : tableau_roundoff;
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
  for_each_pair(each, runge_kutta::Pairs());
}

/// Calls each(table, name, row, column, coefficient) for every coefficient of A, c, E and B; b is a row of A.
template <class T, class Each>
void for_each_coefficient(T& table, Each each) {
  for (std::size_t i = 0; i < T::stages; ++i) {
    each("E", i, 0, table.E[i]);
    if (table.crude_order > 0) each("crude", i, 0, table.crude[i]);
  }
  for (std::size_t i = 0; i < T::all_stages; ++i) {
    each("c", i, 0, table.c[i]);
    for (std::size_t j = 0; j < T::all_stages; ++j) each("A", i, j, table.A[i][j]);
    for (std::size_t j = 0; j < T::degree; ++j) each("B", i, j, table.B[i][j]);
  }
}

template <class T>
void check_misprints(const T& table) {
  T changed = table;
  int tried = 0;
  for_each_coefficient(changed, [&](const char* name, std::size_t i, std::size_t j, double& coefficient) {
    if (std::abs(coefficient) < roundoff_of(table)) return;  // cancelled in the extension
    const check::Case label(name, "[", i, "][", j, "]");
    const double right = coefficient;
    for (const double factor : {1 - misprint, 1 + misprint, -1.0, 0.0}) {
      coefficient = right * factor;
      CHECK(!consistent(changed, roundoff_of(table)));
    }
    coefficient = right;
    ++tried;
  });
  CHECK(consistent(changed, roundoff_of(table)));
  CHECK(tried >= 20);
}

/// The same for coefficients that are zero.
template <class T>
void check_intruders(const T& table) {
  T changed = table;
  for_each_coefficient(changed, [&](const char* name, std::size_t i, std::size_t j, double& coefficient) {
    if (coefficient != 0) return;
    const check::Case label(name, "[", i, "][", j, "]");
    coefficient = misprint;
    CHECK(!consistent(changed, roundoff_of(table)));
    coefficient = 0;
  });
}

/// All conditions up to the order hold, at least one of the next order does not.
template <class T>
void check_order_is_sharp(const T& table) {
  const double roundoff = roundoff_of(table);
  const auto middle = nested_weights(table.B, 0.5);
  CHECK(order_defect(table.A, table.b(), table.order) < roundoff);
  CHECK(order_defect(table.A, table.b(), table.order + 1) > broken);
  CHECK(order_defect(table.A, table.lower(table.E), table.error_order) < roundoff);
  CHECK(order_defect(table.A, table.lower(table.E), table.error_order + 1) > broken);
  if (table.crude_order > 0) {
    CHECK(order_defect(table.A, table.lower(table.crude), table.crude_order) < roundoff);
    CHECK(order_defect(table.A, table.lower(table.crude), table.crude_order + 1) > broken);
  }
  CHECK(order_defect(table.A, middle, table.extension_order, 0.5) < roundoff);
  CHECK(order_defect(table.A, middle, table.extension_order + 1, 0.5) > broken);
}

}  // namespace

TEST(the_tableaux_are_consistent) {
  for_each_pair([](const auto& table) { CHECK(consistent(table, roundoff_of(table))); });
}

TEST(a_misprint_in_any_single_coefficient_is_found) {
  for_each_pair([](const auto& table) { check_misprints(table); });
}

TEST(a_coefficient_in_the_place_of_any_zero_is_found) {
  for_each_pair([](const auto& table) { check_intruders(table); });
}

TEST(the_orders_claimed_are_the_orders_reached) {
  for_each_pair([](const auto& table) { check_order_is_sharp(table); });
}

/// R(−x), the higher formula's y after a step of size 1 of y' = −x y from 1.
template <class T>
double growth(const T& table, double x) {
  std::array<double, T::stages> y{};  // the arguments of the stages
  for (std::size_t i = 0; i < T::stages; ++i) {
    y[i] = 1;
    for (std::size_t j = 0; j < i; ++j) y[i] -= x * table.A[i][j] * y[j];
  }
  return y.back();
}

template <const auto& T>
void check_bends() {
  if constexpr (T.watches_bends()) {
    const check::Case label(T.name);
    static constexpr auto difference = runge_kutta::bend_weights<T>();
    double part = 0, most = 0;  // of slopes 1 up to a stage and 0 after it
    for (std::size_t i = 0; i < T.bends.size(); ++i) {
      CHECK(i == 0 || T.c[T.bends[i - 1]] < T.c[T.bends[i]]);
      part += difference[T.bends[i]];
      const bool last = i + 1 == T.bends.size();
      CHECK(std::abs(part) <= 1 + tableau_roundoff);
      CHECK(last ? std::abs(part) <= tableau_roundoff : std::abs(part) > 0.5);
      most = std::max(most, std::abs(part));
    }
    CHECK(std::abs(most - 1) <= tableau_roundoff);
  }
}
template <const auto&... T>
void check_bends_of_all(runge_kutta::Tableaux<T...>) {
  (check_bends<T>(), ...);
}

TEST(a_jump_of_slopes_between_any_two_stages_shows_in_the_divided_difference) {
  check_bends_of_all(runge_kutta::Pairs());
}

TEST(the_limits_of_stability_are_the_first_at_which_the_formulas_grow) {
  for_each_pair([](const auto& table) {
    constexpr double step = 1. / 64;
    double x = step;
    while (std::abs(growth(table, x)) <= 1) x += step;
    CHECK(x == table.real_limit);
  });
}

TEST(every_rooted_tree_is_visited_once_with_its_density) {
  // Numbers of rooted trees: Hairer, Nørsett, Wanner, Solving ODEs I, ch. II.2 (OEIS A000081). The density is least for
  // the bush, r, and largest for the chain, r!.
  constexpr int expected[] = {1, 1, 2, 4, 9, 20, 48, 115, 286, 719};
  double factorial = 1;
  for (std::size_t r = 1; r <= 10; ++r) {
    factorial *= static_cast<double>(r);
    const check::Case label("trees with ", r, " nodes");
    detail::RootedTree<10> tree(r);
    std::set<decltype(tree.level)> seen;
    double least = factorial, most = 0;
    int count = 0;
    do {
      ++count;
      seen.insert(tree.level);
      least = std::min(least, tree.density());
      most = std::max(most, tree.density());
    } while (tree.next());
    CHECK(count == expected[r - 1] && seen.size() == static_cast<std::size_t>(count));
    CHECK(least == static_cast<double>(r));
    CHECK(most == factorial);
  }
}

}  // namespace invariode::test::tableaux_laws
