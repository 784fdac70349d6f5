#pragma once
// Where the Jacobian at hand was taken, and whether the next attempt needs another one (docs/algorithms.md, 'Newton').

#include "archive.hpp"

namespace invariode {

/// The age of a Jacobian J that serves several steps. It decides by what it is told, and knows nothing of J itself.
class JacobianAge {
 public:
  enum class Taken {
    earlier,    ///< in an earlier step
    here,       ///< at the point that the steps have reached
    plainly,    ///< at that point by plain increments, or to be taken so, after one that was much too large
    at_iterate  ///< at an iterate of the step in work, of which a step has one
  };

  [[nodiscard]] Taken taken() const { return taken_; }
  /// Steps accepted since J was taken.
  [[nodiscard]] int steps() const { return steps_; }
  /// Returns whether J is that of the step in work.
  [[nodiscard]] bool current() const { return taken_ != Taken::earlier; }
  /// Returns whether a J of this step is to have increments that are not adapted to f.
  [[nodiscard]] bool plain() const { return taken_ == Taken::plainly || taken_ == Taken::at_iterate; }
  [[nodiscard]] bool renewal_due() const { return due_; }

  /// A run starts: nothing is asked of a J of before.
  void start() { due_ = false; }
  /// J was taken at the point reached. In a step that has taken one at an iterate it counts as that one.
  void take() {
    due_ = too_large_ = false;
    steps_ = 0;
    if (!plain()) taken_ = Taken::here;
  }
  /// J is about to be taken at an iterate.
  void begin_at_iterate() { taken_ = Taken::at_iterate; }
  /// A preconditioner was set up, where J is not a matrix: it ages as J does.
  void set_up() {
    taken_ = Taken::here;
    steps_ = 0;
  }
  void accept_step() {
    taken_ = Taken::earlier;
    ++steps_;
  }
  /// Residuals say that J is much too large.
  void note_too_large() { too_large_ = true; }

  /// Asks for another J before the next attempt. `renewable`: J may change at all. Returns that.
  bool renew(bool renewable = true) {
    due_ = due_ || renewable;
    return renewable;
  }
  /// After an iteration that failed: is the step to be tried again with another J? A J of the point reached cannot be
  /// improved, unless it is much too large and was taken by increments that were adapted, which may have led to where f
  /// has another derivative. One of an iterate is renewed, and shorter steps are to be
  /// made all the same.
  [[nodiscard]] bool fail(bool renewable, bool adapted) {
    switch (taken_) {
      case Taken::earlier: return renew(renewable);
      case Taken::at_iterate:
        taken_ = Taken::plainly;
        renew(renewable);
        return false;
      case Taken::plainly: return false;
      case Taken::here: break;
    }
    if (!too_large_ || !renewable || !adapted) return false;
    taken_ = Taken::plainly;
    return renew();
  }

  void state(Archive& archive) {
    int taken = static_cast<int>(taken_);
    archive(taken, due_, steps_);
    archive.require(taken >= 0 && taken <= static_cast<int>(Taken::at_iterate) && steps_ >= 0);
    taken_ = static_cast<Taken>(taken);
  }

 private:
  Taken taken_ = Taken::earlier;
  bool due_ = false;
  bool too_large_ = false;
  int steps_ = 0;
};

}  // namespace invariode
