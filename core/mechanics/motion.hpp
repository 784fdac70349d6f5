#pragma once
// The equations of motion of a constrained mechanical system (docs/algorithms.md, 'The right-hand side of mechanics').

#include <Eigen/Core>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "callback.hpp"
#include "linear/rows.hpp"
#include "linear/saddle.hpp"
#include "linear/sparse_saddle.hpp"
#include "mechanics/differentiable.hpp"

namespace invariode {

/// M, of a pattern that stays: a constant, or what a function of (t, q) writes: the diagonal, all entries row by row,
/// or the entries of the pattern column by column.
struct MassTerm {
  enum class Writes { nothing, diagonal, rows, entries } writes = Writes::nothing;
  SparseMatrix matrix;  ///< (n_v, n_v): the constant, else the pattern
  Callback function;
};

/// Φ = ∂φ/∂q as a user function of (t, q) writes it, if there is one: all entries row by row, or those of the pattern
/// column by column.
struct JacobianTerm {
  Callback function;
  bool entries = false;
};

/// M v' = Q + Aᵀ λ, q' = K(t, q, v), φ(t, q) = 0, ψ(t, q, v) = 0.
struct MotionTerms {
  std::size_t n_q = 0, n_v = 0;
  MassTerm mass;
  Callback force;                                             ///< Q, a function of (t, (q, v))
  Differentiable constraints;                                 ///< φ, of (t, q)
  Differentiable velocity_constraints;                        ///< ψ, of (t, (q, v))
  Differentiable kinematics;                                  ///< K, of (t, (q, v)); none: q' = v
  JacobianTerm jacobian;                                      ///< none: φ is differentiated
  SparseMatrix phi_pattern, psi_pattern, kinematics_pattern;  ///< of their Jacobians
  std::vector<char> kept;                                     ///< of φ, then of ψ: whether it is imposed
  bool sparse = true;                                         ///< sparse factors are tried, if there are enough zeros
  double dependent = 0;  ///< rows that depend on others to this part of their length are left out
};

/// The cost of the evaluations so far.
struct MotionWork {
  std::int64_t mass, force, constraints, velocity_constraints, kinematics, jacobian;  ///< calls of functions
  std::int64_t sparse, dense;                                                         ///< factorisations
  std::int64_t singular;  ///< points near singular positions
};

/// The right-hand side (q', v') and the laws of the motion: φ = 0, φ' = 0 and ψ = 0, as functions of (t, y) with
/// y = (q, v). Its workspace serves one run at a time.
class Motion {
 public:
  /// Throws std::invalid_argument where sizes do not match.
  explicit Motion(MotionTerms terms);
  Motion(const Motion&) = delete;
  Motion& operator=(const Motion&) = delete;

  /// Its functions of (t, y), those of the laws with the values that are kept; Jacobians are (…, n_q + n_v), row-major.
  /// The mass is its diagonal, where it has no other entries, else (n_v, n_v).
  /// Jacobians also as the entries of their patterns, row by row.
  enum class Part {
    slope,
    mass,
    positions,
    positions_jacobian,
    rates,
    rates_jacobian,
    velocities,
    velocities_jacobian
  };
  [[nodiscard]] Callback callback(Part part);

  /// Returns where a Jacobian, one of the parts, can have entries.
  [[nodiscard]] RowPattern pattern(Part jacobian) const;
  /// Returns a Jacobian as a function of (t, y) that writes the entries of its `pattern`.
  [[nodiscard]] Callback entries(Part jacobian);

  Status slope(double t, const double* y, double* out);
  /// v' and λ; what is not finite makes both NaN. Near singular positions those of the nearest (q, v) that satisfies
  /// the constraints, or interpolated between such points beside.
  Status accelerations(double t, const double* y, ConstrainedSolution& found);
  /// A and the right-hand side γ of A v' = γ, of what is kept.
  Status rows(double t, const double* y);
  [[nodiscard]] const SparseMatrix& A() const { return A_; }
  [[nodiscard]] const Eigen::VectorXd& right_hand_side() const { return gamma_; }
  Status mass(double t, const double* q);
  [[nodiscard]] const SparseMatrix& M() const { return terms_.mass.matrix; }
  /// Q of (t, (q, v)), and q'.
  Status force(double t, const double* y, double* out) { return terms_.force(t, y, out); }
  Status q_dot(double t, const double* y, double* out);

  [[nodiscard]] std::size_t size() const { return terms_.n_q + terms_.n_v; }
  [[nodiscard]] std::size_t n_q() const { return terms_.n_q; }
  [[nodiscard]] std::size_t n_v() const { return terms_.n_v; }
  /// The numbers of values of φ and of ψ that are kept.
  [[nodiscard]] std::size_t m_phi() const { return kept_phi_.size(); }
  [[nodiscard]] std::size_t m_psi() const { return kept_psi_.size(); }
  /// Returns the number of values that the mass has as a part.
  [[nodiscard]] std::size_t mass_size() const { return diagonal_mass_ ? n_v() : n_v() * n_v(); }
  /// Returns whether sparse factors are tried before dense ones.
  [[nodiscard]] bool sparse() const { return sparse_; }
  [[nodiscard]] MotionWork work() const;
  /// Relative error of v'; 0: roundoff.
  [[nodiscard]] double relative_error() const;

 private:
  template <Status (Motion::*function)(double, const double*, double*)>
  static Status entry(void* self, double t, const double* y, double* out) {
    return (static_cast<Motion*>(self)->*function)(t, y, out);
  }

  Status mass_values(double t, const double* y, double* out);
  Status positions(double t, const double* y, double* out);
  Status rates(double t, const double* y, double* out);
  Status velocities(double t, const double* y, double* out);
  /// The Jacobian of a law with respect to (q, v), of all its values, of which `kept` are; that of φ to q alone.
  Status differentiate(Part jacobian, double t, const double* y);
  [[nodiscard]] const SparseMatrix& derivative(Part jacobian) const;
  [[nodiscard]] const std::vector<std::size_t>& kept(Part jacobian) const {
    return jacobian == Part::velocities_jacobian ? kept_psi_ : kept_phi_;
  }
  /// The rows that are kept: all entries, or those of the pattern.
  template <Part jacobian, bool all>
  Status jacobian_rows(double t, const double* y, double* out) {
    if (differentiate(jacobian, t, y) == Status::stop) return Status::stop;
    write_rows(derivative(jacobian), kept(jacobian), all, out);
    return Status::ok;
  }
  void write_rows(const SparseMatrix& from, const std::vector<std::size_t>& kept, bool all, double* out) const;
  Status differentiate_rates(double t, const double* y);
  void keep_values(const std::vector<std::size_t>& kept, double* out, double sign = 1) const;

  Status accelerations_at(double t, const double* y, ConstrainedSolution& found);
  void solve(const Eigen::VectorXd& Q, const Eigen::VectorXd& gamma, ConstrainedSolution& found);
  Status row_values(double t, const double* y);
  Status satisfy(double t, const double* y, bool& found);
  Status interpolate(double t, const double* y, ConstrainedSolution& found, bool& interpolated);
  [[nodiscard]] double turning() const;
  Status correct_positions(double t, double& size);
  Status correct_velocities(double t);
  void choose_patterns();
  [[nodiscard]] std::size_t most_entries() const;
  void combine_rates();
  Status phi_jacobian(double t, const double* q);
  Status curvatures(double t, const double* y);
  void assemble();
  void read_entries(SparseMatrix& into, bool entries) const;

  MotionTerms terms_;
  std::vector<std::size_t> kept_phi_, kept_psi_;
  std::vector<int> place_phi_, place_psi_;  // of each value of φ, ψ: its row in A; -1: not kept
  SparseColumns phi_, psi_, psi_by_v_, kinematics_, kinematics_by_v_;
  SparseMatrix phi_by_v_, A_;
  SparseMatrix phi_by_time_;  // dΦ/dt along the motion
  SparseMatrix rates_;        // the Jacobian of φ' with respect to y
  bool sparse_ = false, diagonal_mass_ = false;
  SparseSaddle saddle_;
  ConstrainedSolution solution_, correction_, there_;
  Eigen::VectorXd force_, gamma_;
  std::vector<double> q_dot_, along_, bend_, values_, size_, ones_, beside_, entries_, terms_of_rate_;
  std::vector<double> satisfying_;  // (q, v) on the constraints
  std::vector<double> shifted_;     // (q, v) beside a singular position
  Eigen::VectorXd nothing_, rest_;  // right-hand sides of corrections: no force, what is left of the constraints
  std::int64_t sparse_count_ = 0, dense_count_ = 0, singular_count_ = 0;
};

}  // namespace invariode
