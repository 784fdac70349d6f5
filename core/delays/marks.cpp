#include "delays/marks.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "aim.hpp"
#include "weights.hpp"

namespace invariode {
namespace {

constexpr double merged_within = hmin_ulps;  // spacings: no step fits between
constexpr double passed_since = 64;          // spacings

double spacing_of(const Mark& mark) { return std::max(mark.spacing, ulp(mark.t)); }

}  // namespace

void Marks::add(const Mark& mark) {
  auto place = std::ranges::lower_bound(all_, mark.t, {}, &Mark::t);
  const auto same = [&](const Mark& one) {
    return std::abs(one.t - mark.t) < merged_within * std::max(spacing_of(one), spacing_of(mark));
  };
  for (auto near : {place, place == all_.begin() ? all_.end() : place - 1})
    if (near != all_.end() && same(*near)) {
      if (mark.level < near->level && mark.level <= 1) near->rates.assign(mark.rates.size(), 0);
      if (mark.level <= 1)
        for (std::size_t i = 0; i < mark.rates.size(); ++i)
          if (near->rates[i] == 0) near->rates[i] = mark.rates[i];
      near->level = std::min(near->level, mark.level);
      near->spacing = std::max(near->spacing, mark.spacing);
      return;
    }
  all_.insert(place, mark);
}

void Marks::pass(double t) {
  std::erase_if(all_, [t](const Mark& one) { return one.t < t - passed_since * std::max(spacing_of(one), ulp(t)); });
}

double Marks::beyond(double t) const {
  const auto next = std::ranges::upper_bound(all_, t, {}, &Mark::t);
  return next == all_.end() ? std::numeric_limits<double>::infinity() : next->t;
}

const Mark* Marks::at(double t, double tolerance) const {
  const auto next = std::ranges::lower_bound(all_, t - tolerance, {}, &Mark::t);
  return next != all_.end() && next->t <= t + tolerance ? &*next : nullptr;
}

void Marks::state(Archive& archive) {
  std::vector<double> t, spacing, level, rates;
  for (const Mark& one : all_) {
    t.push_back(one.t);
    spacing.push_back(one.spacing);
    level.push_back(one.level);
    rates.insert(rates.end(), one.rates.begin(), one.rates.end());
  }
  archive.resizable(t);
  archive.resizable(spacing);
  archive.resizable(level);
  archive.resizable(rates);
  if (!archive.reading()) return;
  archive.require(spacing.size() == t.size() && level.size() == t.size() && std::ranges::is_sorted(t));
  const std::size_t k = t.empty() ? 0 : rates.size() / t.size();
  archive.require(rates.size() == k * t.size());
  all_.clear();
  constexpr double most_levels = 1000;
  for (std::size_t i = 0; i < t.size(); ++i) {
    archive.require(std::isfinite(t[i]) && spacing[i] >= 0 && level[i] >= 0 && level[i] < most_levels);
    const double* first = rates.data() + i * k;
    all_.push_back({t[i], static_cast<int>(level[i]), spacing[i], {first, first + k}});
  }
}

}  // namespace invariode
