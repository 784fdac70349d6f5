#pragma once
// What is known of ∂f/∂y, and does not fit f.

#include <cstddef>

#include "archive.hpp"

namespace invariode {

/// The first misfit that was seen: f_row changes with y_column, which the given structure excludes; or the given J says
/// something else than f of how f_row changes along a direction.
struct Misfit {
  enum class Kind : unsigned char { pattern, bands, matrix } kind = Kind::matrix;
  double t = 0;
  std::size_t row = 0, column = 0;  ///< `matrix`: no column
  std::size_t lower = 0,
              upper = 0;  ///< `bands`: those that would hold all entries seen; 0: f mixes nearly all components
  double change = 0, predicted = 0;  ///< `matrix`: of f_row, by f and by J

  void state(Archive& archive) {
    archive(kind, t, row, column, lower, upper, change, predicted);
    archive.require(kind <= Kind::matrix);
  }
};

}  // namespace invariode
