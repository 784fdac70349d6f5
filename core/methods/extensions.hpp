#pragma once
// The raw continuous extensions of the methods, under the names that they have in files.

#include <cstddef>
#include <span>
#include <string_view>

#include "step.hpp"

namespace invariode {

struct NamedExtension {
  const char* name;
  Interpolate evaluate;
  bool (*fits)(const double* data, std::size_t size, std::size_t n);  ///< whether it can read data of that size
};

/// All of them. Their order is that of the numbers in files: new ones go to the end.
[[nodiscard]] std::span<const NamedExtension> extensions();
/// Returns the extension with a name, or null.
[[nodiscard]] const NamedExtension* find_extension(std::string_view name);
[[nodiscard]] const NamedExtension& find_extension(Interpolate evaluate);

/// Evaluates the extension of a method whose steps are made by others: data = [number of the extension in the list |
/// the data of that extension].
void numbered_extension(const double* data, std::size_t size, std::size_t n, std::span<const double> theta,
                        double* out);
[[nodiscard]] double number_of_extension(Interpolate evaluate);

}  // namespace invariode
