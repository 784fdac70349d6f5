// Weights, the norm of the error test, and the spacing of doubles.

#include "weights.hpp"

#include <limits>
#include <vector>

#include "check.hpp"
#include "problems.hpp"

namespace invariode::test::weights_laws {

TEST(the_norm_is_the_largest_size_and_lets_nan_through_in_any_position) {
  const std::vector<double> values = {1, -5, 3, 0, 4};
  for (std::size_t bad = 0; bad <= values.size(); ++bad) {  // the last round has none
    const check::Case label("NaN at ", bad);
    MaxNorm norm;
    for (std::size_t i = 0; i < values.size(); ++i) norm.add(i == bad ? NaN : values[i]);
    CHECK(bad < values.size() ? std::isnan(norm.value()) : norm.value() == 5);
  }
  MaxNorm of_infinity;
  for (const double v : {1.0, -infinity, 2.0}) of_infinity.add(v);
  CHECK(of_infinity.value() == infinity);
  CHECK(MaxNorm{}.value() == 0);
}

TEST(the_norm_of_many_terms_is_that_of_all_of_them) {
  for (const std::size_t n : {0, 1, 3, 63, 64, 65, 200}) {
    for (std::size_t at = 0; at < n; ++at) {
      const check::Case label("n = ", n, ", at ", at);
      const auto with = [&](double v) { return max_norm(n, [&](std::size_t i) { return i == at ? v : 1.0; }); };
      CHECK(with(-5) == 5 && with(-infinity) == infinity && std::isnan(with(NaN)));
    }
    CHECK(max_norm(n, [](std::size_t) { return -1.0; }) == (n > 0 ? 1 : 0));
  }
}

TEST(a_vector_is_finite_only_if_every_value_is) {
  const double largest = std::numeric_limits<double>::max();
  const std::vector<double> good = {largest, -largest, 0, std::numeric_limits<double>::denorm_min(), largest};
  CHECK(all_finite(good.data(), good.size()));
  CHECK(all_finite(good.data(), 0));
  for (std::size_t i = 0; i < good.size(); ++i)
    for (const double bad : {NaN, infinity, -infinity}) {
      std::vector<double> v = good;
      v[i] = bad;
      CHECK(!all_finite(v.data(), v.size()));
    }
}

TEST(a_weight_is_the_largest_of_both_values_and_the_threshold) {
  const Weights weights(1e-3, {0.5, 2}, {});
  CHECK(weights.at(0, -3, 1) == 3);
  CHECK(weights.at(0, 1, -3) == 3);
  CHECK(weights.at(0, 0.1, -0.2) == 0.5);
  const double y[] = {-3, 1}, yhat[] = {1, -7};
  double w[2];
  weights.fill(y, w);
  CHECK(w[0] == 3 && w[1] == 2);
  weights.fill(y, yhat, w);
  CHECK(w[0] == 3 && w[1] == 7);
}

TEST(a_vector_rtol_scales_the_weights_of_its_components) {
  // rtol = (1e-2, 1e-4), atol = 1e-6: the error of component i stays below max(rtol_i |y_i|, atol).
  const Weights weights(1e-4, {1e-2, 1e-2}, {100, 1});
  for (const double y : {0.0, 1e-5, 1e-3, 1.0, -50.0}) {
    CHECK_CLOSE(1e-4 * weights.at(0, y), std::max(1e-2 * std::abs(y), 1e-6), 1e-20);
    CHECK_CLOSE(1e-4 * weights.at(1, y), std::max(1e-4 * std::abs(y), 1e-6), 1e-20);
  }
}

TEST(under_pure_relative_control_at_zero_no_error_passes_but_zero) {
  const Weights weights(1e-3, {0, 1}, {});
  CHECK(weights.pure_relative(0) && !weights.pure_relative(1));
  const double w = weights.at(0, 0, 0);
  CHECK(0 / w == 0);  // not NaN
  CHECK(!(std::numeric_limits<double>::min() / w <= weights.rtol()));
  CHECK(weights.at(0, 1e-300) == 1e-300);
}

TEST(ulp_is_the_distance_to_the_next_double_away_from_zero) {
  CHECK(ulp(1) == eps);
  CHECK(ulp(-1) == eps);
  CHECK(ulp(2) == 2 * eps);
  CHECK(ulp(std::nextafter(2.0, 0.0)) == eps);
  CHECK(ulp(0) == std::numeric_limits<double>::denorm_min());
  CHECK(ulp(1e300) > 0);
}

}  // namespace invariode::test::weights_laws
