#pragma once
// The methods that most laws of the native tests are about.

#include <algorithm>
#include <iterator>
#include <vector>

#include "methods/registry.hpp"

namespace invariode {

/// Those that take any function for f. (The others have tests of their own.)
inline std::vector<Method> general_methods() {
  std::vector<Method> chosen;
  std::ranges::copy_if(methods(), std::back_inserter(chosen),
                       [](const Method& method) { return method.equations == Equations::any; });
  return chosen;
}

/// And those for second-order systems: laws of steps, on problems that are such systems.
inline std::vector<Method> methods_of_second_order() {
  std::vector<Method> chosen;
  std::ranges::copy_if(methods(), std::back_inserter(chosen),
                       [](const Method& method) { return method.equations != Equations::graph; });
  return chosen;
}

}  // namespace invariode
