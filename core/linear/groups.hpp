#pragma once
// Columns that can be differenced together.

#include <cstddef>
#include <vector>

namespace invariode {

using ColumnGroups = std::vector<std::vector<std::size_t>>;

/// The columns of a sparse matrix, given as compressed columns, in groups without a common row: each column in the
/// first group that fits (Curtis, Powell and Reid, 1974).
ColumnGroups group_columns(std::size_t rows, std::size_t columns, const int* starts, const int* indices);

}  // namespace invariode
