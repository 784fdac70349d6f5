#pragma once
// Projection of sensitivities onto the tangent of the manifold (docs/algorithms.md, 'Sensitivities').

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include "archive.hpp"
#include "callback.hpp"
#include "linear/mass.hpp"
#include "manifold/bounds.hpp"
#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "weights.hpp"

namespace invariode {

/// Where the state y is on g(t, y, p) = c(p), its sensitivities satisfy G S_j + g_pj = dc/dp_j. They are moved there by
///
///   S_j ← S_j − W² Gᵀ (G W² Gᵀ)⁺ (G S_j + g_pj − dc/dp_j),
///
/// W the weights of the state: linear in S_j, with the factors and the rank with which the state was projected. Those
/// are of the point before its last correction, so that for an invariant that is not linear the correction is repeated
/// until what is left is roundoff.
///
/// Functions that only rise or fall move no exact solution, whose S is not bound by them: what they correct in y is
/// error. S keeps its G S_j + g_pj of them.
class TangentProjector {
 public:
  /// All blocks of the invariants have a tangent. The weights are of the state; Y has `size` doubles. `bounds` may be
  /// null; all belong to the caller.
  TangentProjector(Invariants& invariants, const Weights& weights, std::size_t size, const Bounds* bounds);

  /// dc/dp of what is held becomes G S_j + g_pj at (t, Y); of what is demanded it is 0.
  Status hold(double t, const double* Y);
  /// Moves S to dc/dp, after `state`, a projector of the same invariants, has moved the state at t.
  Outcome follow(Projector& state, double t, double* Y) { return onto(state, t, rate_.data(), Y); }
  /// Moves S to other values of G S_j + g_pj, (k, m).
  Outcome onto(Projector& state, double t, const double* target, double* Y);
  /// Moves S at a point that was not projected, with the weights max(|y|, thr).
  Outcome settle(double t, double* Y);
  /// G S_j + g_pj, (k, m).
  Status evaluate(double t, const double* Y, double* out);
  [[nodiscard]] std::size_t size() const { return rate_.size(); }

  void state(Archive& archive) { archive(rate_); }

 private:
  struct Block {
    Callback tangent;
    std::size_t m;
    bool held;
  };

  bool off_tangent(const Projector& state, const double* S, const double* target, double* residual) const;

  Invariants& invariants_;
  const Bounds* bounds_;
  std::size_t n_, k_, m_;
  std::vector<Block> blocks_;
  std::optional<Projector> own_;  // of points that no other one has projected
  const Weights& weights_;
  std::vector<double> rate_;                         // dc/dp, (k, m)
  std::vector<double> value_, block_value_, delta_;  // (k, m), of one block, (n)
};

/// The tangent of the algebraic equations.
class AlgebraicTangent {
 public:
  /// `slopes`: (t, Y) -> J S_j + f_pj, (k, n). The mass matrix belongs to the caller.
  AlgebraicTangent(const Callback& slopes, const Mass& mass, std::size_t k)
      : slopes_(slopes), mass_(mass), slope_(k * mass.matrix().n()) {}
  AlgebraicTangent(const AlgebraicTangent&) = delete;
  AlgebraicTangent& operator=(const AlgebraicTangent&) = delete;

  /// Zᵀ (J S_j + f_pj), (k, equations). Refers to this object.
  Callback callback() { return {&entry, this}; }

 private:
  static Status entry(void* self, double t, const double* Y, double* out);

  Callback slopes_;
  const Mass& mass_;
  std::vector<double> slope_;
};

/// Moves components of the state that are outside of their bounds onto them, where they do not depend on the
/// parameters: their rows of S become 0. Here and below Y is the state, of the size of the bounds, with any S behind
/// it.
void clip(const Bounds& bounds, std::span<double> Y);
/// Components of the state that a projection or a bound has moved onto a bound do not depend on the parameters there:
/// their rows of S become 0. From the candidate to Y, whose S is the candidate's still. Returns whether there were any.
bool rest_at_bounds(const Bounds& bounds, const double* candidate, std::span<double> Y);
/// Rows of S of these components become 0, if they are at their bounds.
void forget_at_bounds(const Bounds& bounds, std::span<const std::size_t> held, std::span<double> Y);

}  // namespace invariode
