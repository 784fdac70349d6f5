#pragma once
// Taylor series of any order (docs/algorithms.md, 'Taylor series'; Jorba and Zou, A software package for the numerical
// integration of ODEs by means of high-order Taylor methods, Exp. Math. 14 (2005) 99-117).

#include <cstddef>
#include <limits>
#include <optional>
#include <vector>

#include "compensated.hpp"
#include "methods/conditions.hpp"
#include "methods/taylor_kernel.hpp"
#include "series.hpp"
#include "step.hpp"

namespace invariode {

/// y(t + unit s) = Σ c_k s^k up to the order of the series. The expansion at the end of a step is the next one's, and
/// its first coefficient, against the slope of the polynomial, tells the error of the step. A step ends where a
/// condition of f changes its sign: the polynomial is that of one branch.
class Taylor final : public Step {
 public:
  static constexpr int lowest_order = 3, highest_order = taylor::highest_order;

  /// `series` outlives this. `projected`: candidates will be moved, so that an expansion there would be of no use; f is
  /// evaluated instead.
  Taylor(Callback& f, const Weights& weights, SystemSeries& series, bool projected);

  Outcome start(double t, const double* y, const Span& span) override;
  Attempt attempt(double h, double t1) override;
  bool errors(double* out) const override;
  bool reject(Cause cause, double hmin) override;
  Outcome accept(const double* y1) override;
  void state(Archive& archive) override;

  /// All coefficients but the first.
  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return order_; }

  [[nodiscard]] Interpolate interpolate() const override;
  [[nodiscard]] std::size_t extension_size() const override { return (order_ + 1) * n(); }
  [[nodiscard]] bool extends_by_powers() const override { return true; }
  [[nodiscard]] int degree() const override { return order(); }
  Status extension(double* data) override;
  Status extension_of_attempt(double* data, std::size_t& size) override;

  [[nodiscard]] int order() const override { return static_cast<int>(order_); }
  /// |h λ| from the ratio of the last two coefficients: λ^k / k! outgrows all others where stability limits h.
  [[nodiscard]] double stability() const override;
  [[nodiscard]] double real_limit() const override;
  [[nodiscard]] const double* slope() const override;
  [[nodiscard]] int undefined_component() const override { return undefined_.component; }
  [[nodiscard]] std::optional<int> undefined_coefficient() const override { return undefined_.coefficient; }

 private:
  /// Coefficients (order + 1, n) in s = (t − t_k) / unit.
  struct Expansion {
    std::vector<double> c;
    double unit = 1, per_unit = 1;  // and its reciprocal
    bool finite = true;
  };
  [[nodiscard]] const double* row(const Expansion& expansion, std::size_t k) const {
    return expansion.c.data() + k * n();
  }
  [[nodiscard]] const Expansion& at_point_reached() const { return accepted_ ? *next_ : *current_; }
  [[nodiscard]] Expansion& at_point_reached() { return accepted_ ? *next_ : *current_; }

  Status rest(double t, const double* y, Expansion& into);
  Status expand(double t, const double* y, Expansion& into);
  template <class Size>
  INVARIODE_SHARED bool propose(Size size);
  Status evaluate_at_candidate();
  Status look_at_rest();
  Status look_ahead(double t, const Expansion& expansion, double length, double reach);
  Status find_cut(double t, const Expansion& expansion, double length);
  [[nodiscard]] double reach(const Expansion& expansion) const;
  [[nodiscard]] double norm(const double* v) const;
  [[nodiscard]] double defect(std::size_t i) const;
  [[nodiscard]] int first_undefined(const double* v) const;

  /// The coefficient that was not finite in the last attempt.
  struct Undefined {
    int component = -1;
    std::optional<int> coefficient;  ///< nothing: f
  };

  Series& series_;
  const Bounds* bounds_;
  Conditions conditions_;
  bool projected_;
  std::size_t order_;
  double exponent_;  // 1 / (p + 1)
  double factor_;    // of h: (rtol e^{−0.7})^{1/(p−1)}
  Expansion expansions_[2];
  Expansion *current_ = &expansions_[0], *next_ = &expansions_[1];
  Remainder remainder_;
  std::vector<double> values_;
  double* candidate_ = nullptr;    // y*
  double* end_slope_ = nullptr;    // of the polynomial, in the unit of its expansion
  double* f_value_ = nullptr;      // where f writes
  const double* end_f_ = nullptr;  // f(t₁, y*), times 1 / `per_end_unit_`
  double* inverse_weight_ = nullptr;
  double* slope_ = nullptr;
  double t1_ = 0;
  double error_ = 0;
  double length_ = 0;                       // t₁ − t
  double per_unit_ = 1, per_end_unit_ = 1;  // 1 / unit
  double unit_of_error_ = 0;
  double free_ = 0;      // |h|, were it not for conditions
  double searched_ = 0;  // up to this |h| from the point reached, conditions were looked for
  double cut_ = std::numeric_limits<double>::infinity();  // just before this |h| the first of them changes its sign;
                                                          // infinite: none does
  int close_ = 0;                                         // so many steps in a row were cut shortly after their start
  bool crosses_ = false;                                  // the attempt ends there
  bool expanded_ = false;                                 // next_ is the expansion at the candidate
  bool failed_ = false;                                   // an attempt of this step failed
  bool accepted_ = false;
  Undefined undefined_;
};

}  // namespace invariode
