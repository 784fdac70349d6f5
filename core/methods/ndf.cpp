#include "methods/ndf.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <type_traits>

#include "methods/initial_step.hpp"

namespace invariode {
namespace {

constexpr int most = Ndf::highest_order + 3;  // indices start at 1

/// γ_k = 1 + 1/2 + … + 1/k
constexpr std::array<double, most> gamma = [] {
  std::array<double, most> g{};
  for (std::size_t k = 1; k < g.size(); ++k) g[k] = g[k - 1] + 1.0 / static_cast<double>(k);
  return g;
}();

/// The parameters of Klopfenstein and Shampine that make an NDF of a BDF.
constexpr double kappa[most] = {0, -37.0 / 200, -1.0 / 9, -0.0823, -0.0415, 0, 0, 0};

constexpr double safety_same = 1.2, safety_lower = 1.3, safety_higher = 1.4;  // 1/c after a success
constexpr double retry_same = 0.833, retry_lower = 0.769;
constexpr double largest_growth = 10;

/// R(ρ), leading k × k part: R_ij = Π_{l≤i} (l − 1 − jρ)/l
using Small = std::array<std::array<double, most>, most>;
constexpr Small differences_at(double rho, int k) {
  Small R{};
  for (int j = 1; j <= k; ++j) {
    double product = 1;
    for (int i = 1; i <= k; ++i) {
      product *= (i - 1 - j * rho) / i;
      R[static_cast<std::size_t>(i)][static_cast<std::size_t>(j)] = product;
    }
  }
  return R;
}

constexpr Small U = differences_at(1, Ndf::highest_order);  // upper triangular: [l][j] is 0 where l > j

/// Calls visit(k) with a constant k, so that its loops over differences are unrolled, and those over components become
/// vector instructions.
template <class Visit>
void with_order(int k, const Visit& visit) {
  switch (k) {
    case 1: return visit(std::integral_constant<std::size_t, 1>());
    case 2: return visit(std::integral_constant<std::size_t, 2>());
    case 3: return visit(std::integral_constant<std::size_t, 3>());
    case 4: return visit(std::integral_constant<std::size_t, 4>());
    default: return visit(std::integral_constant<std::size_t, 5>());
  }
}

/// Returns whether `error`, in units of the tolerance, surely allows formula k no longer step: no root tells more.
bool too_large_to_grow(int k, double error, double safety) {
  constexpr double rounding = 1 + 1e-9;
  double power = safety;
  for (int j = 0; j < k; ++j) power *= safety;
  return error * power > rounding;
}

}  // namespace

void newton_backward(const double* data, std::size_t size, std::size_t n, double theta, double* out) {
  std::copy(data, data + n, out);
  const double s = theta - 1;
  double product = 1;
  double m = 0;
  for (const double* D = data + n; D != data + size; D += n, ++m) {
    product *= (s + m) / (m + 1);
    for (std::size_t i = 0; i < n; ++i) out[i] += D[i] * product;
  }
}

Ndf::Ndf(Callback& f, const Weights& weights, const LinearAlgebra& linear, const Options& options)
    : ImplicitBase(f, weights, linear),
      options_(options),
      differences_(static_cast<std::size_t>(options.max_order + 2) * weights.size()) {
  provide({&slope_, &predictor_, &psi_, &d_, &scratch_});
  solver_.keep_factors();
}

double Ndf::error_constant(int k) const {
  const auto q = static_cast<std::size_t>(k);
  return (options_.bdf ? 0 : kappa[q] * gamma[q]) + 1.0 / (k + 1);
}

double Ndf::gamma_inverse(int k) const {
  const auto q = static_cast<std::size_t>(k);
  return 1 / (gamma[q] * (1 - (options_.bdf ? 0 : kappa[q])));
}

/// 1/h is 1.25 √(‖y''‖ / (2 rtol)).
Outcome Ndf::start(double t, const double* y, const Span& span) {
  order_ = memory_order_ = 1;
  std::fill(differences_.begin(), differences_.end(), 0);
  steps_at_h_ = 0;
  solver_.restart();
  const Outcome outcome = begin(t, y, candidate_.data(), slope_.data());
  if (outcome != Outcome::ok) return outcome;
  const double first = starting_safety * norm(slope_.data()) / std::sqrt(weights_.rtol());
  if (bend(span, first, candidate_.data(), slope_.data(), predictor_.data(), scratch_.data()) == Status::stop)
    return Outcome::stop;
  const double reciprocal = starting_safety * std::sqrt(0.5 * norm(scratch_.data()) / weights_.rtol());
  if (choose_initial_step(span, first, reciprocal, candidate_.data(), slope_.data(), predictor_.data(),
                          scratch_.data()) == Outcome::stop)
    return Outcome::stop;
  memory_h_ = h_;
  const double forward = span.tf >= t ? 1 : -1;
  for (std::size_t i = 0; i < n(); ++i) D(1)[i] = forward * memory_h_ * slope_[i];
  return Outcome::ok;
}

/// D_1 … D_k of the present k, from one |h| to another: D ← D R(ρ) U, U = R(1).
void Ndf::rescale_memory(double h) {
  const int k = order_;
  assert(k >= 1 && k <= options_.max_order && memory_h_ > 0);
  const double rho = h / memory_h_;
  if (rho != 1) {
    const Small R = differences_at(rho, k);
    with_order(k, [this, &R](const auto order) {
      Small RU{};
      for (std::size_t i = 1; i <= order; ++i)
        for (std::size_t j = 1; j <= order; ++j)
          for (std::size_t l = 1; l <= j; ++l) RU[i][j] += R[i][l] * U[l][j];
      double* first = differences_.data();
      for (std::size_t c = 0; c < n(); ++c, ++first) {
        double row[order];
        for (std::size_t j = 0; j < order; ++j) row[j] = first[j * n()];
        for (std::size_t j = 0; j < order; ++j) {
          double sum = 0;
          for (std::size_t i = 0; i < order; ++i) sum += row[i] * RU[i + 1][j + 1];
          first[j * n()] = sum;
        }
      }
    });
  }
  memory_h_ = h;
  memory_order_ = k;
  steps_at_h_ = 0;
}

Step::Attempt Ndf::attempt(double h, double t1) {
  begin_attempt(h, t1);
  if (h_ != memory_h_ || order_ != memory_order_) rescale_memory(h_);
  const double c = h * gamma_inverse(order_);
  solver_.renew_if_noise(c);
  if (solver_.repair(t_, y()) == Status::stop) return proposal(Newton::Result::stop);
  Newton::Result result = newton_result(solver_.prepare(c, t1));
  if (result == Newton::Result::converged) {
    predict();
    result = solver_.solve(c, t1, predictor_.data(), psi_.data(), weight_.data(), d_.data(), candidate_.data());
  }
  if (result == Newton::Result::converged) error_ = norm(d_.data()) * error_constant(order_);
  return proposal(result);
}

bool Ndf::errors(double* out) const {
  for (std::size_t i = 0; i < n(); ++i) out[i] = d_[i] * error_constant(order_);
  return true;
}

std::size_t Ndf::directions(const double** vectors) const {
  for (int j = 1; j <= order_; ++j) *vectors++ = D(j);
  *vectors = d_.data();
  return static_cast<std::size_t>(order_) + 1;
}

/// p = y + Σ D_j and ψ = invGa_k Σ γ_j D_j of c f(t₁, p + d) = M (ψ + d), where d = ∇^{k+1} y₁; the weights of the
/// step.
void Ndf::predict() {
  const double scale = gamma_inverse(order_);
  std::array<double, most> factor{};
  for (std::size_t j = 1; j <= static_cast<std::size_t>(order_); ++j) factor[j] = gamma[j] * scale;
  with_order(order_, [&, n = n()](const auto order) {
    const double* __restrict difference = differences_.data();
    double* __restrict predictor = predictor_.data(), * __restrict psi = psi_.data();
    for (std::size_t i = 0; i < n; ++i) {
      double p = y_[i], sum = 0;
      for (std::size_t j = 0; j < order; ++j) {
        p += difference[j * n + i];
        sum += difference[j * n + i] * factor[j + 1];
      }
      predictor[i] = p;
      psi[i] = sum;
    }
  });
  weights_.fill(y(), predictor_.data(), weight_.data());
}

double Ndf::optimal_h(int k, double error, double safety) const {
  const double shrink = safety * std::pow(error / weights_.rtol(), 1.0 / (k + 1));
  return shrink > 1 / largest_growth ? h_ / shrink : h_ * largest_growth;
}

/// Returns whether an error failure may be due to J: projection hides from Newton's iteration that an old one is wrong,
/// and in algebraic equations it may be so large that the updates are too small to show it. There a J that is not old
/// is renewed too, at the second failure of a step.
bool Ndf::misleading_jacobian() {
  const int age = solver_.jacobian_age();
  const bool algebraic = solver_.mass() && solver_.mass()->singular();
  if (algebraic && failed_ && age > 0) return true;
  return (algebraic || options_.renew_on_error) && age >= old_jacobian &&
         solver_.stiff(h_ * gamma_inverse(order_), weight_.data());
}

bool Ndf::reject(Cause cause, double hmin) {
  if (cause == Cause::newton)
    return solver_.forget_other_factors() || retry_newton(hmin, newton_cut) || (h_ <= hmin && solver_.iterate_fully());
  if (h_ <= hmin) return false;
  const double h = !failed_ && cause == Cause::error ? retry_order_and_h() : 0.5 * h_;
  if (cause == Cause::error && misleading_jacobian()) solver_.renew();
  failed_ = true;
  h_ = std::max(hmin, h);
  return true;
}

/// |h| after an error failure, with the order below if that allows a longer one.
double Ndf::retry_order_and_h() {
  const double same = retry_h(error_, order_ + 1, retry_same);
  if (order_ == 1) return same;
  for (std::size_t i = 0; i < n(); ++i) scratch_[i] = D(order_)[i] + d_[i];
  const double lower = retry_h(norm(scratch_.data()) * error_constant(order_ - 1), order_, retry_lower);
  if (!(lower > same)) return same;
  --order_;
  return std::min(lower, h_);
}

Outcome Ndf::accept(const double* y1) {
  const double c = signed_h_ * gamma_inverse(order_);
  with_order(order_, [&, n = n()](const auto order) {
    double* __restrict difference = differences_.data(), * __restrict slope = slope_.data(), * __restrict d = d_.data();
    const double *psi = psi_.data(), *candidate = candidate_.data();
    for (std::size_t i = 0; i < n; ++i) {
      slope[i] = (psi[i] + d[i]) / c;
      d[i] += y1[i] - candidate[i];  // the correction, if any, enters all differences
      difference[(order + 1) * n + i] = d[i] - difference[order * n + i];
      difference[order * n + i] = d[i];
      for (std::size_t j = order; j-- > 0;) difference[j * n + i] += difference[(j + 1) * n + i];
    }
  });
  commit(y1);
  failed_ = false;
  steps_at_h_ = std::min(steps_at_h_ + 1, options_.max_order + 2);
  choose_order_and_step();
  return Outcome::ok;
}

void Ndf::choose_order_and_step() {
  const int k = order_;
  if (steps_at_h_ < k + 2) return;
  double best = h_;
  const auto offer = [&](int order, double safety) {
    const double error = norm(D(order + 1)) * error_constant(order);
    if (too_large_to_grow(order, error / weights_.rtol(), safety)) return;
    if (const double h = optimal_h(order, error, safety); h > best) {
      best = h;
      order_ = order;
    }
  };
  offer(k, safety_same);
  if (k > 1) offer(k - 1, safety_lower);
  if (k < options_.max_order) offer(k + 1, safety_higher);
  h_ = best;
}

void Ndf::state(Archive& archive) {
  Step::state(archive);
  solver_.state(archive);
  archive(order_, memory_order_, memory_h_, steps_at_h_, failed_, differences_, weight_, slope_);
  for (const int k : {order_, memory_order_}) archive.require(k >= 1 && k <= options_.max_order);
}

Interpolate Ndf::interpolate() const { return in_turn<newton_backward>; }
std::size_t Ndf::extension_size() const { return static_cast<std::size_t>(memory_order_ + 1) * n(); }
std::size_t Ndf::max_extension_size() const { return static_cast<std::size_t>(options_.max_order + 1) * n(); }

/// The differences that the step would leave.
Status Ndf::extension_of_attempt(double* data, std::size_t& size) {
  size = static_cast<std::size_t>(order_ + 1) * n();
  std::copy(candidate_.begin(), candidate_.end(), data);
  const double* later = d_.data();
  for (int j = order_; j >= 1; --j) {
    double* difference = data + static_cast<std::size_t>(j) * n();
    for (std::size_t i = 0; i < n(); ++i) difference[i] = D(j)[i] + later[i];
    later = difference;
  }
  return Status::ok;
}

Status Ndf::extension(double* data) {
  data = std::copy(y_.begin(), y_.end(), data);
  std::copy(D(1), D(memory_order_ + 1), data);
  return Status::ok;
}

}  // namespace invariode
