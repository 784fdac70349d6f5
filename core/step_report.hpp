#pragma once
// What a method reports on its steps, for the tests of the loop and the record of the run.

#include <cstddef>
#include <optional>

#include "linear/work.hpp"

namespace invariode {

/// The first three are known of every method; the others have a default, which a method need not know.
class StepReport {
 public:
  /// The order of the step just accepted.
  [[nodiscard]] virtual int order() const = 0;
  /// y' at the end of the accepted step as the method has it, without another evaluation; after an implicit step only
  /// to the accuracy of its iteration.
  [[nodiscard]] virtual const double* slope() const = 0;
  /// The first component of f that was not finite in the last attempt (or at the start), or -1.
  [[nodiscard]] virtual int undefined_component() const = 0;

  /// Returns, for a method that expands the solution, the first Taylor coefficient of that component that is not
  /// finite, where f is.
  [[nodiscard]] virtual std::optional<int> undefined_coefficient() const { return {}; }

  /// The work of the linear algebra so far, and the cause of its failure in the last attempt; of an explicit method
  /// none.
  [[nodiscard]] virtual LinearWork linear_work() const { return {}; }

  /// The estimated error of the attempt, component by component, into out (n,). False: the method has none.
  virtual bool errors(double* /*out*/) const { return false; }
  /// Returns the vectors (n) that the attempt is made of, slopes or differences of the solution, which stay until the
  /// next operation: every linear function that f keeps vanishes on them. Returns how many, at most `max_directions`.
  /// None: the method does not say.
  virtual std::size_t directions(const double** /*vectors*/) const { return 0; }
  [[nodiscard]] virtual std::size_t max_directions() const { return 0; }
  /// An estimate of |h λ| in the step just accepted, λ the dominant eigenvalue of ∂f/∂y, in units of what the formula
  /// is stable for on the negative real axis. 0: unknown, or there is no such limit.
  [[nodiscard]] virtual double stability() const { return 0; }
  /// The length of its interval of stability on the negative real axis; 0: unknown, or there is no limit.
  [[nodiscard]] virtual double real_limit() const { return 0; }

 protected:
  StepReport() = default;
  ~StepReport() = default;
};

}  // namespace invariode
