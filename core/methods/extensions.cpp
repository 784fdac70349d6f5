#include "methods/extensions.hpp"

#include <algorithm>
#include <iterator>

#include "methods/ndf.hpp"
#include "methods/runge_kutta.hpp"
#include "methods/trbdf2.hpp"
#include "output/polynomial.hpp"

namespace invariode {
namespace {

bool rows_of_n(const double*, std::size_t size, std::size_t n) { return size > 0 && size % n == 0; }
bool two_cubics(const double*, std::size_t size, std::size_t n) { return size == TrBdf2::extension_rows * n; }
bool numbered(const double* data, std::size_t size, std::size_t n);

constexpr NamedExtension list[] = {{"Runge-Kutta", in_turn<runge_kutta::nested_polynomial>, rows_of_n},
                                   {"power series", power_series, rows_of_n},
                                   {"NDF", in_turn<newton_backward>, rows_of_n},
                                   {"TR-BDF2", in_turn<two_hermite_cubics>, two_cubics},
                                   {"numbered", numbered_extension, numbered}};

/// The extension with that number; null if the number is unknown, or names a numbered extension.
const NamedExtension* of_number(double number) {
  for (std::size_t i = 0; i < std::size(list); ++i)
    if (number == static_cast<double>(i) && list[i].evaluate != numbered_extension) return &list[i];
  return nullptr;
}

bool numbered(const double* data, std::size_t size, std::size_t n) {
  if (size < 1) return false;
  const NamedExtension* one = of_number(data[0]);
  return one != nullptr && one->fits(data + 1, size - 1, n);
}

}  // namespace

std::span<const NamedExtension> extensions() { return list; }

const NamedExtension* find_extension(std::string_view name) {
  const auto* found = std::ranges::find(list, name, &NamedExtension::name);
  return found == std::end(list) ? nullptr : found;
}

const NamedExtension& find_extension(Interpolate evaluate) {
  return *std::ranges::find(list, evaluate, &NamedExtension::evaluate);
}

double number_of_extension(Interpolate evaluate) { return static_cast<double>(&find_extension(evaluate) - list); }

void numbered_extension(const double* data, std::size_t size, std::size_t n, std::span<const double> theta,
                        double* out) {
  of_number(data[0])->evaluate(data + 1, size - 1, n, theta, out);
}

}  // namespace invariode
