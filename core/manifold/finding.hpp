#pragma once
// What the tests of invariants find (guard.hpp).

namespace invariode {

/// Evidence against the invariants.
struct Finding {
  enum class Kind { none, stop, undefined, off_value, jumps_off, wrong_jacobian, not_conserved, held };
  Kind kind = Kind::none;
  int invariant = -1;
  int component = -1;  ///< wrong_jacobian: the column; held: the component that is held at a bound
  double t = 0;
  /// off_value, jumps_off: the residual; wrong_jacobian: the entry given; not_conserved: d/dt of the invariant; held:
  /// what bounds add to d/dt of the invariant.
  double size = 0;
  /// off_value, jumps_off: the distance from the invariant in units of rtol; wrong_jacobian: the difference quotient;
  /// not_conserved: ρ; held: the distance that bounds have added, in units of rtol.
  double distance = 0;
  double drift = 0;  ///< not_conserved: the largest drift of an invariant in a step, in units of rtol
};

}  // namespace invariode
