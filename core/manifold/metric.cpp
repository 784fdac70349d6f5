#include "manifold/metric.hpp"

#include <cmath>
#include <stdexcept>
#include <utility>

#include "linear/index.hpp"

namespace invariode {
MetricFactor::MetricFactor(Metric metric, std::vector<std::size_t> components)
    : metric_(std::move(metric)),
      components_(std::move(components)),
      fixed_(components_.size()),
      part_(index(components_.size())) {
  const std::size_t k = components_.size();
  if (metric_.values.size() == k)
    diagonal_.resize(index(k));
  else if (metric_.values.size() == k * k)
    factor_ = std::make_unique<Eigen::LLT<Eigen::MatrixXd>>(index(k));
  else
    throw std::invalid_argument("a metric has other components than its invariant may move");
}

Status MetricFactor::update(double t, const double* y) {
  if (metric_.function && metric_.function(t, y, metric_.values.data()) == Status::stop) return Status::stop;
  if (metric_.function || !known_) factorize();
  known_ = true;
  return Status::ok;
}

void MetricFactor::keep(const char* fixed) {
  bool changed = false;
  for (std::size_t j = 0; j < fixed_.size(); ++j) {
    const char stays = fixed != nullptr ? fixed[components_[j]] : 0;
    changed = changed || stays != fixed_[j];
    fixed_[j] = stays;
  }
  if (changed && known_ && factor_) factorize();
}

void MetricFactor::factorize() {
  const Eigen::Map<const Eigen::VectorXd> values(metric_.values.data(), index(metric_.values.size()));
  regular_ = values.allFinite();
  if (!regular_) return;
  if (diagonal_.size() > 0) {
    regular_ = (values.array() > 0).all();
    if (regular_) diagonal_ = values.cwiseSqrt();
    return;
  }
  const Eigen::Index k = part_.size();
  Eigen::MatrixXd G = Eigen::Map<const Eigen::MatrixXd>(metric_.values.data(), k, k);
  for (Eigen::Index j = 0; j < k; ++j) {
    if (fixed_[static_cast<std::size_t>(j)] == 0) continue;
    G.row(j).setZero();
    G.col(j).setZero();
    G(j, j) = 1;
  }
  factor_->compute(G);
  regular_ = factor_->info() == Eigen::Success;
}

void MetricFactor::gather(const double* a) {
  for (std::size_t j = 0; j < components_.size(); ++j) part_[index(j)] = fixed_[j] != 0 ? 0 : a[components_[j]];
}

void MetricFactor::divide(const double* a, double* x) {
  gather(a);
  if (diagonal_.size() > 0)
    part_.array() /= diagonal_.array();
  else
    factor_->matrixL().solveInPlace(part_);
  for (std::size_t j = 0; j < components_.size(); ++j) x[components_[j]] = part_[index(j)];
}

void MetricFactor::divide_transposed(double* x) {
  gather(x);
  if (diagonal_.size() > 0)
    part_.array() /= diagonal_.array();
  else
    factor_->matrixU().solveInPlace(part_);
  for (std::size_t j = 0; j < components_.size(); ++j) x[components_[j]] = part_[index(j)];
}

}  // namespace invariode
