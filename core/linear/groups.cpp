#include "linear/groups.hpp"

#include <algorithm>
#include <cassert>
#include <utility>

namespace invariode {

ColumnGroups group_columns(std::size_t rows, std::size_t columns, const int* starts, const int* indices) {
  ColumnGroups groups;
  std::vector<std::vector<std::size_t>> groups_of_row(rows);
  std::vector<std::size_t> taken_for;  // of each group: the last column that could not join it, plus 1
  for (std::size_t j = 0; j < columns; ++j) {
    const int *first = indices + starts[j], *last = indices + starts[j + 1];
    assert(std::all_of(first, last, [rows](int i) { return i >= 0 && static_cast<std::size_t>(i) < rows; }));
    std::size_t taken = 0;  // when all groups are, there is nothing more to learn: a full matrix takes n² operations
    for (const int* i = first; i != last && taken < groups.size(); ++i)
      for (const std::size_t g : groups_of_row[static_cast<std::size_t>(*i)])
        if (std::exchange(taken_for[g], j + 1) != j + 1) ++taken;
    std::size_t group = 0;
    while (group < groups.size() && taken_for[group] == j + 1) ++group;
    if (group == groups.size()) {
      groups.emplace_back();
      taken_for.push_back(0);
    }
    groups[group].push_back(j);
    for (const int* i = first; i != last; ++i) groups_of_row[static_cast<std::size_t>(*i)].push_back(group);
  }
  return groups;
}

}  // namespace invariode
