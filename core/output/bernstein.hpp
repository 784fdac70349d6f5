#pragma once
// Polynomials on [0, 1] in Bernstein form, whose coefficients bound them and show where they have roots.

#include <algorithm>
#include <cstddef>
#include <vector>

#include "output/root.hpp"
#include "weights.hpp"

namespace invariode::bernstein {

constexpr double roundoff = 64 * eps;  // of the coefficients, in units of the sum of the sizes of the powers'

/// Σ a_k θ^k = Σ b_j (p over j) θ^j (1 − θ)^{p−j}, b_j = Σ_k (j over k) / (p over k) a_k
inline void from_powers(const std::vector<double>& a, std::vector<double>& b) {
  const std::size_t p = a.size() - 1;
  double binomial = 1;  // (p over k)
  for (std::size_t k = 0; k <= p; ++k) {
    b[k] = a[k] / binomial;
    binomial = binomial * static_cast<double>(p - k) / static_cast<double>(k + 1);
  }
  for (std::size_t r = 1; r <= p; ++r)
    for (std::size_t j = p; j >= r; --j) b[j] += b[j - 1];
}

/// Splits the coefficients into those on the two halves, by de Casteljau's algorithm: the second ones take the place of
/// b.
inline void halve(double* b, std::size_t count, double* first) {
  for (std::size_t r = 0; r < count; ++r) {
    first[r] = b[0];
    for (std::size_t j = 0; j + r + 1 < count; ++j) b[j] = 0.5 * (b[j] + b[j + 1]);
  }
}

/// Returns whether all coefficients are on one side of zero, and farther from it than `margin`.
inline bool on_one_side(const double* b, std::size_t count, double margin) {
  const auto [low, high] = std::minmax_element(b, b + count);
  return *low > margin || *high < -margin;
}

/// Changes of sign, zeros left out: at least as many as there are roots between 0 and 1, and more by an even number
/// (Descartes).
inline int sign_changes(const double* b, std::size_t count) {
  int changes = 0, last = 0;
  for (std::size_t j = 0; j < count; ++j) {
    const int sign = sign_of(b[j]);
    changes += sign * last < 0;
    if (sign != 0) last = sign;
  }
  return changes;
}

/// A part of [0, 1] on which there is one root; or, `unresolved`, some that are too close together to be told apart;
/// or, of no width, a point that is one.
struct Isolated {
  double low, high;
  bool unresolved;
};

/// Isolates the roots between 0 and 1 of the polynomial with these coefficients, by halving, from 0 on: `visit` gets
/// each, and returns false to end that. Parts that are not wider than `narrowest`, or on which no coefficient exceeds
/// `flat`, are unresolved. The work needs `boxes`.
template <class Visit>
void isolate(const double* coefficients, std::size_t count, double narrowest, double flat, std::vector<double>& boxes,
             Visit&& visit) {
  struct Box {
    double low, high;
  };
  std::vector<Box> left{{0, 1}};
  boxes.assign(coefficients, coefficients + count);
  while (!left.empty()) {
    const auto [low, high] = left.back();
    double* b = boxes.data() + (left.size() - 1) * count;
    const int changes = sign_changes(b, count);
    const bool small = high - low <= narrowest || max_norm(count, [b](std::size_t j) { return b[j]; }) <= flat;
    const bool unresolved = changes > 1 && small;
    if (changes <= 1 || unresolved) {
      if (changes > 0 && !visit(Isolated{low, high, unresolved})) return;
      left.pop_back();
      continue;
    }
    boxes.resize((left.size() + 1) * count);
    b = boxes.data() + (left.size() - 1) * count;
    halve(b, count, b + count);
    const double middle = 0.5 * (low + high);
    if (b[0] == 0 && !visit(Isolated{middle, middle, false})) return;
    left.back() = {middle, high};
    left.push_back({low, middle});
  }
}

}  // namespace invariode::bernstein
