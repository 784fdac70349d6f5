#include "manifold/quadratic.hpp"

#include <algorithm>
#include <stdexcept>
#include <utility>

namespace invariode {

Quadratic::Quadratic(std::size_t n, std::size_t terms, std::vector<std::size_t> first, std::vector<std::size_t> second)
    : n_(n), terms_(terms), first_(std::move(first)), second_(std::move(second)) {
  const auto beyond = [n](std::size_t j) { return j >= n; };
  if (terms_ == 0 || first_.size() % terms_ != 0 || first_.size() != second_.size())
    throw std::invalid_argument("products of components that do not fill the equations");
  if (std::any_of(first_.begin(), first_.end(), beyond) || std::any_of(second_.begin(), second_.end(), beyond))
    throw std::invalid_argument("products of components that the state does not have");
}

void Quadratic::values(const double* y, double* g) const {
  for (std::size_t p = 0; p < first_.size(); ++p) {
    if (p % terms_ == 0) *g++ = 0;
    g[-1] += y[first_[p]] * y[second_[p]];
  }
}

void Quadratic::gradients(const double* y, double* J) const {
  std::fill(J, J + m() * n_, 0);
  for (std::size_t p = 0; p < first_.size(); ++p) {
    double* row = J + p / terms_ * n_;
    row[first_[p]] += y[second_[p]];
    row[second_[p]] += y[first_[p]];
  }
}

}  // namespace invariode
