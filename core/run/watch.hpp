#pragma once
// Long runs that are watched: for interrupts, and to report how far they are.

#include <algorithm>
#include <chrono>
#include <utility>

#include "run/run.hpp"

namespace invariode {

/// The time that native code runs between two calls of watch().
inline constexpr std::chrono::milliseconds watch_interval(50);

/// Begins the run by begin() and goes on to its end. Whenever `watch_interval` has passed, watch() may stop it
/// by returning false. True: it has ended by itself.
template <class Begin, class Watch>
bool run_watched(Run& run, Begin begin, Watch watch) {
  using Clock = std::chrono::steady_clock;
  constexpr int most = 16;  // steps from one look at the clock to the next: more of those that are fast
  int steps = 1;
  auto watched = Clock::now(), looked = watched;
  State state = begin();
  for (int step = 0; state == State::running;) {
    state = run.advance();
    if (++step < steps) continue;
    step = 0;
    const auto now = Clock::now(), before = std::exchange(looked, now);
    steps = now - before < watch_interval / most ? std::min(2 * steps, most) : 1;
    if (now - watched < watch_interval) continue;
    if (!watch()) return false;
    watched = now;
  }
  return true;
}

}  // namespace invariode
