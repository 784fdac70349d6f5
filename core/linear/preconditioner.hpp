#pragma once
// A user's preconditioner, as the core calls it.

#include <memory>

#include "callback.hpp"

namespace invariode {

/// Solves (M − c J) x = b, more or less. What a set-up has made belongs to the run: several runs may share the
/// functions.
class Preconditioner {
 public:
  using SetUp = Status(void* context, double t, const double* y, double c, std::shared_ptr<void>& made);
  using Solve = Status(void* context, void* made, double* b);

  Preconditioner() = default;
  Preconditioner(SetUp* to_set_up, Solve* to_solve, void* context)
      : set_up_(to_set_up), solve_(to_solve), context_(context) {}

  /// Sets up the preconditioner for J at (t, y).
  Status set_up(double t, const double* y, double c) { return set_up_(context_, t, y, c, made_); }
  /// b becomes x, with what was set up last.
  Status solve(double* b) { return solve_(context_, made_.get(), b); }
  explicit operator bool() const noexcept { return set_up_ != nullptr; }

 private:
  friend class Piece;

  SetUp* set_up_ = nullptr;
  Solve* solve_ = nullptr;
  void* context_ = nullptr;
  std::shared_ptr<void> made_;
};

}  // namespace invariode
