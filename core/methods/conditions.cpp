#include "methods/conditions.hpp"

#include <algorithm>
#include <cmath>

#include "output/bernstein.hpp"

namespace invariode {
namespace {

constexpr double narrowest = 0x1p-26;  // √ε, of the length: roots that are closer are not told apart
constexpr double located = 2 * eps;    // width of a root, of where it is

}  // namespace

Conditions::Conditions(SystemSeries& series) : series_(series) {
  if (!any()) return;
  const auto rows = static_cast<std::size_t>(series.solution.order()) + 1;
  all_.resize(rows * series.count);
  one_.resize(rows);
  bernstein_.resize(rows);
}

Status Conditions::first(double t, double unit, const double* c, double length, std::optional<double>& root) {
  root.reset();
  const std::size_t m = series_.count;
  if (series_.conditions(t, unit, c, all_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m; ++i) {
    double power = 1;
    for (std::size_t k = 0; k < one_.size(); ++k, power *= length) one_[k] = power * all_[k * m + i];
    if (!all_finite(one_.data(), one_.size())) continue;  // the acceptance test is left
    if (const std::optional<double> found = first_root(); found && (!root || *found < *root)) root = found;
  }
  return Status::ok;
}

std::optional<double> Conditions::first_root() {
  const std::size_t count = one_.size();
  double size = 0;
  for (const double a : one_) size += std::abs(a);
  if (size == 0) return {};
  if (one_[0] == 0) return 0;
  bernstein::from_powers(one_, bernstein_);
  if (bernstein::on_one_side(bernstein_.data(), count, bernstein::roundoff * size)) return {};
  const int start = sign_of(one_[0]);
  std::optional<double> found;
  const auto e = [this](double theta, double& out) {
    out = value(theta);
    return true;
  };
  bernstein::isolate(bernstein_.data(), count, narrowest, 0, boxes_, [&](const bernstein::Isolated& part) {
    const double at_low = value(part.low), at_high = value(part.high);
    double root = part.high;
    if (at_low * at_high < 0)
      (void)find_root(e, part.low, at_low, part.high, at_high, located * part.high, root);
    else if (at_high != 0 && sign_of(at_high) == start)
      return true;  // two roots, or none but for roundoff
    found = root;
    return false;
  });
  return found;
}

double Conditions::value(double theta) const {
  double sum = 0;
  for (std::size_t k = one_.size(); k-- > 0;) sum = sum * theta + one_[k];
  return sum;
}

}  // namespace invariode
