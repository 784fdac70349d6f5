#pragma once
// Tabulated inputs of f: piecewise polynomials of t.

#include <algorithm>
#include <cstddef>
#include <stdexcept>
#include <utility>
#include <vector>

namespace invariode {

/// `size` functions of t that are polynomials between times; before the first and after the last time they stay as they
/// are there.
class PiecewisePolynomial {
 public:
  /// Piece i starts at times[i]; the last one may start at the last time. `coefficients`: of the powers of t −
  /// times[i], the highest first: for each piece, for each function, degree + 1 of them.
  PiecewisePolynomial(std::vector<double> times, std::vector<double> coefficients, std::size_t degree, std::size_t size)
      : times_(std::move(times)), coefficients_(std::move(coefficients)), degree_(degree), size_(size) {
    const std::size_t of_piece = size * (degree + 1);
    if (of_piece == 0 || coefficients_.empty() || coefficients_.size() % of_piece != 0)
      throw std::invalid_argument("the coefficients are not those of whole pieces");
    pieces_ = coefficients_.size() / of_piece;
    if (pieces_ > times_.size() || pieces_ + 1 < times_.size() || !std::is_sorted(times_.begin(), times_.end()))
      throw std::invalid_argument("the times are not those of the pieces");
  }

  [[nodiscard]] std::size_t size() const { return size_; }

  /// The values at t into out (size,).
  void evaluate(double t, double* out) const {
    const double at = t < times_.front() ? times_.front() : t > times_.back() ? times_.back() : t;
    const auto after = std::upper_bound(times_.begin(), times_.end(), at);
    const auto before = static_cast<std::size_t>(after - times_.begin());
    const std::size_t piece = std::min(before == 0 ? 0 : before - 1, pieces_ - 1);
    const double x = at - times_[piece];
    const double* c = coefficients_.data() + piece * size_ * (degree_ + 1);
    for (std::size_t j = 0; j < size_; ++j, c += degree_ + 1) {
      double value = c[0];
      for (std::size_t k = 1; k <= degree_; ++k) value = value * x + c[k];
      out[j] = value;
    }
  }

 private:
  std::vector<double> times_, coefficients_;
  std::size_t degree_, size_, pieces_ = 0;
};

}  // namespace invariode
