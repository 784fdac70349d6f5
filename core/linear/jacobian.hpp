#pragma once
// The Jacobian of f: a constant matrix, a user function, one that was derived from f, differences or complex steps
// (docs/algorithms.md, 'Jacobians'); and the derivative in t.

#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "callback.hpp"
#include "linear/box.hpp"
#include "linear/jacobian_check.hpp"
#include "linear/matrix.hpp"
#include "linear/misfit.hpp"
#include "linear/pattern.hpp"
#include "weights.hpp"

namespace invariode {

/// ∂f/∂y in the structure of a given matrix.
///
/// Differences are adaptive (Salane, 1986): each column's increment is remembered as a factor of the component's size,
/// raised where the change of f drowned in roundoff and lowered where it was large. Columns that share no row are
/// differenced together (Curtis, Powell and Reid, 1974).
///
/// Complex steps, Im f(t, y + i h e_j) / h, have no truncation error, but f may drop the imaginary part; and a pattern
/// that was found may lack an entry that appears later. Both are examined along the way: differences then replace
/// complex steps, the pattern grows.
class Jacobian {
 public:
  /// `products` has no matrix and no entries: J is known by its products with vectors (linear/matrix_free.hpp).
  /// `derived`: a function that follows from f, and is right; where it is not finite, differences take its place.
  enum class Kind { constant, function, derived, differences, complex_steps, products };

  /// The source of its entries. `complex_f`: f of complex y, pairs of reals in and out.
  struct Source {
    Kind kind = Kind::differences;
    MatrixFunction function;     ///< of these kinds
    Callback complex_f;          ///< of complex steps
    Callback rate;               ///< ∂f/∂t, where it is known
    Callback product;            ///< J v of t and (y | v), of a derived one that is formed by groups of columns
    bool found_pattern = false;  ///< the sparse structure was found from values of f, and may lack entries
  };

  /// `matrix`: the values of a constant one, else the structure. A copy keeps increments of its own.
  Jacobian(const Source& source, Matrix matrix, const Weights& weights);

  /// Evaluates it at (t, y). `slope` = f(t, y), where `needs_slope`, else it may be null; `f` is called for the rest.
  /// The matrix may come out not finite.
  Status evaluate(Callback& f, double t, const double* y, const double* slope);
  [[nodiscard]] bool needs_slope() const;
  /// ∂f/∂t at (t, y), where f is `slope`, into ft (n,): exact where it is known, else by `time_derivative`. 0 where it
  /// is not finite.
  Status time_derivative(Callback& f, double t, const double* y, const double* slope, double h, double* ft);
  /// The matrix is not the derivative of f. Where f changes, by these displacements, with components of y that the
  /// structure excludes, a pattern grows, and bands, which cannot, are computed from groups of columns that f does not
  /// mix. Otherwise increments are too small. The matrix is evaluated again.
  Status complete(Callback& f, double t, const double* y, const double* slope, const std::vector<double>& displacement);
  /// From now on f is evaluated in this box only, whoever calls it: increments lead inside.
  void keep_within(Box box) { box_ = std::move(box); }
  [[nodiscard]] const Box& box() const { return box_; }
  /// Adds J (y − P y) to f(t, P y), P y the nearest point in the box: what Newton's iteration takes for f outside.
  void extend(const double* y, double* f);
  /// Newton's iteration has failed with it: the next evaluation is examined.
  void doubt() { doubtful_now_ = true; }

  [[nodiscard]] const Matrix& matrix() const { return matrix_; }
  /// Its values are there from now on, zeros until it is evaluated.
  void provide() { matrix_.provide(); }
  [[nodiscard]] bool provided() const { return matrix_.values.size() == matrix_.size(); }
  [[nodiscard]] Kind kind() const { return kind_; }
  /// Computed from values of f, not given.
  [[nodiscard]] bool computed() const { return kind_ == Kind::differences || kind_ == Kind::complex_steps; }
  /// The entry that the given structure was first seen to miss.
  [[nodiscard]] const std::optional<Misfit>& misfit() const { return misfit_; }
  /// The scale of increments of component j: its weight, if that is not too small.
  [[nodiscard]] double scale(std::size_t j, const double* y) const { return defined_scale(weights_.at(j, y[j]), y); }
  /// The number of groups of columns for finite differences and complex steps: so many evaluations of f it takes.
  [[nodiscard]] std::size_t groups() const { return groups_ ? groups_->size() : 0; }
  /// Ends the evaluations, and gives back the memory that only these need.
  void end();
  /// Evaluations so far, each of which may be several of f.
  [[nodiscard]] std::int64_t count() const { return count_; }
  /// Evaluations of f at complex y so far.
  [[nodiscard]] std::int64_t complex_calls() const { return source_.complex_f.calls(); }
  /// The t from which on differences have replaced complex steps; NaN: they have not.
  [[nodiscard]] double abandoned_complex_steps() const { return abandoned_complex_steps_; }
  /// The number of times that a pattern that was found has grown.
  [[nodiscard]] std::int64_t enlargements() const { return enlargements_; }
  /// The part of it that is roundoff of f, a norm in the weights; of c J it is |c| times that. 0 except for
  /// differences.
  [[nodiscard]] double noise() const { return noise_; }
  /// Returns whether columns of the latest differences have increments far from √ε |y_j|, chosen after earlier
  /// differences.
  [[nodiscard]] bool adapted() const { return adapted_; }
  /// Evaluates as `evaluate` does, with increments √ε |y_j|; they are adapted again afterwards.
  Status evaluate_plainly(Callback& f, double t, const double* y, const double* slope);
  /// Evaluates finite differences as `evaluate` does, where entries whose increments have changed f_i by no more than
  /// its roundoff are formed again with increasing increments, up to the size of the largest component, or 1.
  Status evaluate_boldly(Callback& f, double t, const double* y, const double* slope);
  /// From the next evaluation on, increments are large enough to stand above the roundoff of f.
  void widen_increments();
  /// Counts and increments; `matrix_state`: the matrix.
  void state(Archive& archive);
  void matrix_state(Archive& archive);

 private:
  struct Column {
    double increment;
    double change;  // largest |Δf_i|
    double size;    // max(|f_i|, |f_i + Δf_i|) in that row
  };

  void group_columns();
  void make_room();
  void make_factors();
  void measure_noise(const double* y, const double* slope);
  Status step_complex(double t, const double* y, bool& finite);
  Status examined_complex_steps(Callback& f, double t, const double* y, const double* slope);
  Status abandon_complex_steps(Callback& f, double t, const double* y, const double* slope);
  Status derive(Callback& f, double t, const double* y, const double* slope);
  Status multiply_groups(double t, const double* y);
  Status difference_anywhere(Callback& f, double t, const double* y, const double* slope);
  Status difference_in_found_pattern(Callback& f, double t, const double* y, const double* slope);
  Status enlarge_pattern(Callback& f, double t, const double* y, const double* slope,
                         const std::vector<double>& displacement, bool& larger);
  void note_misfit(double t, const Pattern& seen, std::size_t first);
  [[nodiscard]] bool holds(std::size_t i, std::size_t j) const;
  JacobianCheck::Verdict examine(Callback& f, double t, const double* y, const double* slope);
  [[nodiscard]] bool examination_due() const;
  Status difference(Callback& f, double t, const double* y, const double* slope);
  Status difference_group(Callback& f, double t, const double* y, const double* slope,
                          const std::vector<std::size_t>& columns, bool again = false);
  [[nodiscard]] double increment(std::size_t j, const double* y, double slope, double factor, bool again = false) const;
  [[nodiscard]] double defined_scale(double scale, const double* y) const;
  template <class Visit>
  void for_each_in_column(std::size_t j, Visit&& visit);

  Source source_;
  Kind kind_;
  Matrix matrix_;
  const Weights& weights_;
  std::int64_t count_ = 0;
  double noise_ = 0;
  bool adapted_ = false;
  double abandoned_complex_steps_ = std::numeric_limits<double>::quiet_NaN();
  std::int64_t enlargements_ = 0;
  bool doubtful_now_ = false;
  bool examined_ = false;  // a pattern that was found, as long as examining it leads anywhere
  std::shared_ptr<const std::vector<std::vector<std::size_t>>> groups_;  // of columns; copies share them
  Pattern beyond_;  // of banded ones: entries in and outside the bands; empty: none outside
  std::optional<Misfit> misfit_;
  // From the first evaluation on:
  std::vector<double> factor_;  // of the columns
  std::vector<Column> columns_;
  std::vector<std::size_t> drowned_;  // columns of a group whose change was roundoff
  std::vector<double> point_, moved_;
  std::vector<double> complex_point_, complex_value_;
  std::vector<double> reach_;  // of the components, for the check
  Box box_;
  JacobianCheck check_;
};

}  // namespace invariode
