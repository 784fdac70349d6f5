#pragma once
// What a caller from outside has promised is tested by this; what the code itself relies on, by assert.

#include <stdexcept>
#include <string>
#include <string_view>

namespace invariode {

/// Throws std::invalid_argument unless that is right.
inline void require(bool right, std::string_view what) {
  if (!right) throw std::invalid_argument(std::string(what));
}

}  // namespace invariode
