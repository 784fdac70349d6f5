#pragma once
// Eigen counts with signed numbers.

#include <Eigen/Core>
#include <cstddef>

namespace invariode {

inline Eigen::Index index(std::size_t i) { return static_cast<Eigen::Index>(i); }

}  // namespace invariode
