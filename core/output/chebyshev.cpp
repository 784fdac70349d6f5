#include "output/chebyshev.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cassert>
#include <cmath>
#include <numbers>
#include <utility>

#include "output/root.hpp"

namespace invariode {
namespace {

constexpr std::size_t first_degree = 8, last_degree = 32;
constexpr int deepest = 12;                 // halvings: a kink is left to the signs of samples in 1/4096 of the step
constexpr std::size_t most_samples = 2000;  // of a step: of noise, which no interpolant resolves
constexpr double negligible = 1e-13;        // of the largest coefficient, above the roundoff of some dozen operations
constexpr std::size_t tail = 3;             // so many coefficients have to be negligible
constexpr double doubt = 100;  // in units of these, where the interpolant is tested: their sum, roundoff of t
constexpr double between[] = {-0.62831, 0.35217};  // where: no Chebyshev points
constexpr double narrowest = 1e-4;  // two roots that are closer, in an interval of 2, are below that resolution
constexpr double located = 1e-9;    // roots of the interpolant, which separate those of the function

/// cos(kπ / degree), k < 2 degree. Degrees are powers of two, so that those of the last one serve all, to the last bit.
double point(std::size_t k, std::size_t degree) {
  static const std::array<double, 2 * last_degree> cosines = [] {
    std::array<double, 2 * last_degree> all{};
    for (std::size_t i = 0; i < all.size(); ++i)
      all[i] = std::cos(std::numbers::pi * static_cast<double>(i) / static_cast<double>(last_degree));
    return all;
  }();
  return cosines[k * (last_degree / degree)];
}

/// c_j = 2 / N Σ″ v_k cos(jkπ / N), the terms of both ends halved, and c_0 and c_N too.
void transform(const std::vector<double>& values, std::vector<double>& coefficients) {
  const std::size_t degree = values.size() - 1, period = 2 * degree;
  assert(std::has_single_bit(degree) && degree <= last_degree);
  coefficients.assign(degree + 1, 0);
  for (std::size_t j = 0; j <= degree; ++j) {
    double sum = 0.5 * (values.front() + (j % 2 == 0 ? values.back() : -values.back()));
    for (std::size_t k = 1; k < degree; ++k) sum += values[k] * point(j * k & (period - 1), degree);
    coefficients[j] = sum * (j == 0 || j == degree ? 1.0 : 2.0) / static_cast<double>(degree);
  }
}

double largest(const std::vector<double>& values) {
  double result = 0;
  for (const double value : values) result = std::max(result, std::abs(value));
  return result;
}

/// |T_j| ≤ 1 and |T_j′| ≤ j²: is there no root, or one at most?
bool has_no_root(const std::vector<double>& c) {
  double others = 0;
  for (std::size_t j = 1; j < c.size(); ++j) others += std::abs(c[j]);
  return others < std::abs(c[0]);
}
bool is_monotonic(const std::vector<double>& c) {
  double others = 0;
  for (std::size_t j = 2; j < c.size(); ++j) others += static_cast<double>(j * j) * std::abs(c[j]);
  return others < std::abs(c[1]);
}

}  // namespace

RootSeparator::RootSeparator() {
  for (std::vector<double>* const one : {&values_, &finer_, &coefficients_, &part_values_, &part_coefficients_})
    one->reserve(2 * last_degree + 1);
  roots_.reserve(2 * last_degree + 1);
  left_.reserve(deepest + 2);
  parts_.reserve(64);  // halvings down to the resolution of a double
}

bool RootSeparator::separate(const Sample& sample, const std::function<bool(double& value)>& noise, const Ends& ends,
                             bool zero_at_start, std::vector<double>& points) {
  const auto [a, ea, b, eb] = ends;
  assert(a != b);
  samples_ = 0;
  noise_ = 0;
  ask_noise_ = &noise;
  left_.assign(1, {a, ea, b, eb, 0});
  while (!left_.empty()) {
    const Interval on = left_.back();
    left_.pop_back();
    bool resolved = false;
    if (samples_ < most_samples && !interpolate(sample, on, resolved)) return false;
    const double middle = on.time(0);
    if (resolved && locate_roots()) {
      if (on.a == a && zero_at_start && (roots_.empty() || roots_.front() > narrowest - 1))
        roots_.insert(roots_.begin(), -1);
      split_between_roots(on, points);
    } else if (samples_ < most_samples && on.depth < deepest && middle != on.a && middle != on.b) {
      const double value = values_[(values_.size() - 1) / 2];
      left_.push_back({middle, value, on.b, on.eb, on.depth + 1});
      left_.push_back({on.a, on.ea, middle, value, on.depth + 1});
      continue;
    }
    if (on.b != b) points.push_back(on.b);
  }
  return true;
}

/// The interpolant on the interval, of the lowest degree that resolves the function, if one does.
bool RootSeparator::interpolate(const Sample& sample, const Interval& on, bool& resolved) {
  values_ = {on.eb, on.ea};
  while (values_.size() <= last_degree && !resolved) {
    do {
      if (!refine(sample, on)) return false;
    } while (values_.size() <= first_degree);
    transform(values_, coefficients_);
    resolved = decayed();
    if (!resolved && ask_noise_ != nullptr) {
      if (!(*std::exchange(ask_noise_, nullptr))(noise_)) return false;
      resolved = decayed();
    }
    if (resolved && !confirmed(sample, on, resolved)) return false;
  }
  return true;
}

/// Samples between the points that are there: twice the degree.
bool RootSeparator::refine(const Sample& sample, const Interval& on) {
  const std::size_t degree = 2 * (values_.size() - 1);
  finer_.assign(degree + 1, 0);
  for (std::size_t k = 0; k < values_.size(); ++k) finer_[2 * k] = values_[k];
  for (std::size_t k = 1; k < degree; k += 2)
    if (!sample(on.time(point(k, degree)), finer_[k])) return false;
  samples_ += degree / 2;
  values_.swap(finer_);
  return true;
}

bool RootSeparator::decayed() const {
  double largest = 0;
  for (const double c : coefficients_) largest = std::max(largest, std::abs(c));
  return std::isfinite(largest) && std::all_of(coefficients_.end() - tail, coefficients_.end(), [&](double c) {
           return std::abs(c) <= std::max(negligible * largest, noise_);
         });
}

/// Coefficients decay by accident too: does the interpolant agree with the function between its points?
bool RootSeparator::confirmed(const Sample& sample, const Interval& on, bool& agrees) {
  const double allowed = doubt * std::max(negligible * largest(values_), noise_);
  for (const double x : between) {
    double value = 0;
    if (!sample(on.time(x), value)) return false;
    ++samples_;
    agrees = agrees && std::abs(value - evaluate(x)) <= allowed;
  }
  return true;
}

/// Clenshaw's recurrence.
double RootSeparator::evaluate(double x) const {
  double b1 = 0, b2 = 0;
  for (std::size_t j = coefficients_.size() - 1; j > 0; --j) b2 = std::exchange(b1, coefficients_[j] + 2 * x * b1 - b2);
  return coefficients_[0] + x * b1 - b2;
}

/// The roots of the interpolant at which its sign changes, in their order. False: it is nowhere near as large in some
/// part as elsewhere, and says nothing about the function there.
bool RootSeparator::locate_roots() {
  roots_.clear();
  const std::size_t degree = coefficients_.size() - 1;
  const double resolution = doubt * negligible * largest(coefficients_);
  if (largest(coefficients_) <= noise_) return true;  // there is nothing to be seen
  parts_.assign(1, {-1, 1});
  while (!parts_.empty()) {
    const auto [low, high] = parts_.back();
    parts_.pop_back();
    const double middle = 0.5 * (low + high);
    const double at_high = evaluate(high), at_low = evaluate(low);
    if (high - low == 2) {
      part_coefficients_ = coefficients_;
    } else {
      part_values_.resize(degree + 1);
      for (std::size_t k = 1; k < degree; ++k)
        part_values_[k] = evaluate(middle + 0.5 * (high - low) * point(k, degree));
      part_values_.front() = at_high;
      part_values_.back() = at_low;
      transform(part_values_, part_coefficients_);
    }
    if (has_no_root(part_coefficients_)) continue;
    const bool flat = largest(part_coefficients_) <= resolution;
    if (flat && high - low > narrowest) return false;
    if (flat || is_monotonic(part_coefficients_)) {
      // What is zero counts as positive, so that a root between two parts belongs to one of them.
      if ((at_high < 0) != (at_low < 0)) {
        double root = high;
        const auto e = [&](double x, double& value) {
          value = evaluate(x);
          return true;
        };
        if (find_root(e, low, at_low, high, at_high, located, root)) roots_.push_back(root);
      }
      continue;
    }
    parts_.emplace_back(middle, high);
    parts_.emplace_back(low, middle);
  }
  return true;
}

void RootSeparator::split_between_roots(const Interval& on, std::vector<double>& points) const {
  for (std::size_t i = 1; i < roots_.size(); ++i) points.push_back(on.time(0.5 * (roots_[i - 1] + roots_[i])));
}

}  // namespace invariode
