#include "mechanics.hpp"

#include <nanobind/stl/tuple.h>

#include <Eigen/Core>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "linear/saddle.hpp"

namespace invariode::binding {
namespace {

Eigen::MatrixXd to_eigen(const ConstMatrix& a) {
  using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  return Eigen::Map<const Rows>(a.data(), static_cast<Eigen::Index>(a.shape(0)), static_cast<Eigen::Index>(a.shape(1)));
}

Eigen::Map<const Eigen::VectorXd> to_eigen(const ConstVector& a) {
  return {a.data(), static_cast<Eigen::Index>(a.size())};
}

Vector to_numpy(const Eigen::VectorXd& a) {
  return to_array<Vector>(std::vector<double>(a.begin(), a.end()), static_cast<std::size_t>(a.size()));
}

std::tuple<Vector, Vector, int, bool> solve(const ConstMatrix& mass, const ConstMatrix& rows, const ConstVector& force,
                                            const ConstVector& right, double threshold) {
  const ConstrainedSolution found =
      solve_saddle(to_eigen(mass), to_eigen(rows), to_eigen(force), to_eigen(right), threshold);
  return {to_numpy(found.a), to_numpy(found.lambda), static_cast<int>(found.rank), found.unique};
}

}  // namespace

void define_mechanics(nb::module_& module) {
  module.def("solve_saddle", &solve, nb::arg("mass"), nb::arg("rows"), nb::arg("force"), nb::arg("right"),
             nb::arg("threshold"),
             "a and λ of M a = Q + Aᵀ λ, A a = γ; the rank of A; whether a is unique (else it is NaN).");
}

}  // namespace invariode::binding
