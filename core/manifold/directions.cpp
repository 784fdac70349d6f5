#include "manifold/directions.hpp"

#include <numeric>

namespace invariode {

void Directions::orthonormalize(const double* w, double threshold) {
  basis_.provide(n_, vectors_.size());
  basis_.clear();
  waiting_.resize(vectors_.size());
  std::iota(waiting_.begin(), waiting_.end(), std::size_t{0});
  const Eigen::Map<const Eigen::VectorXd> weights(w, index(n_));
  for (const std::size_t k : waiting_)
    basis_.vector(k) = Eigen::Map<const Eigen::VectorXd>(vectors_[k], index(n_)).cwiseQuotient(weights);
  double first = 0;
  basis_.add(waiting_, [&](std::size_t, double length) {
    if (basis_.members().empty()) first = length;
    return !(length > threshold * first);
  });
}

void Directions::cut(double* row) {
  Eigen::Map<Eigen::VectorXd> cut(row, index(n_));
  rest_ = cut;
  cut.setZero();
  for (const std::size_t q : basis_.members()) {
    const double component = basis_.vector(q).dot(rest_);
    cut += component * basis_.vector(q);
  }
}

}  // namespace invariode
