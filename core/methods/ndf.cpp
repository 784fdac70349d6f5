#include "methods/ndf.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

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

constexpr double newton_cut = 0.3;  // of h, where a current Jacobian does not help
constexpr int old_jacobian = 20;    // steps
constexpr int look_period = 10;     // steps with one J

constexpr double safety_same = 1.2, safety_lower = 1.3, safety_higher = 1.4;  // 1/c after a success
constexpr double retry_same = 0.833, retry_lower = 0.769, smallest_retry = 0.1;
constexpr double largest_growth = 10;
constexpr double starting_safety = 1.25;

/// R(ρ), leading k × k part: R_ij = Π_{l≤i} (l − 1 − jρ)/l
using Small = std::array<std::array<double, most>, most>;
Small differences_at(double rho, int k) {
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
    : Step(f, weights),
      options_(options),
      newton_(f, weights, linear),
      initial_(f, linear),
      differences_(static_cast<std::size_t>(options.max_order + 2) * weights.size()) {
  for (std::vector<double>* v : {&weight_, &predictor_, &psi_, &d_, &candidate_, &slope_, &scratch_})
    v->resize(weights.size());
}

double Ndf::error_constant(int k) const {
  const auto q = static_cast<std::size_t>(k);
  return (options_.bdf ? 0 : kappa[q] * gamma[q]) + 1.0 / (k + 1);
}

double Ndf::gamma_inverse(int k) const {
  const auto q = static_cast<std::size_t>(k);
  return 1 / (gamma[q] * (1 - (options_.bdf ? 0 : kappa[q])));
}

double Ndf::norm(const double* v) const {
  MaxNorm norm;
  for (std::size_t i = 0; i < n(); ++i) norm.add(v[i] / weight_[i]);
  return norm.value();
}

/// Memory as it is before any step, at a first |h|.
void Ndf::restart(double t, const double* y, double h, int order) {
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  h_ = memory_h_ = h;
  order_ = memory_order_ = order;
  std::fill(differences_.begin(), differences_.end(), 0);
  steps_at_h_ = 0;
  failed_ = false;
  newton_.restart();
}

Outcome Ndf::start(double t, const double* y, const Span& span) {
  restart(t, y, 0, 1);
  if (const Outcome outcome = first_slope(t, y); outcome != Outcome::ok) return outcome;
  const double forward = span.tf >= t ? 1 : -1;
  const double root = std::sqrt(weights_.rtol());
  const double first = first_h(starting_safety * norm(slope_.data()) / root, t, span);
  if (initial_.second(newton_, t, y, forward * first, candidate_.data(), slope_.data(), predictor_.data(),
                      scratch_.data()) == Status::stop)
    return Outcome::stop;
  const double second = norm(scratch_.data());
  h_ = memory_h_ = first_h(starting_safety * std::sqrt(0.5 * second / weights_.rtol()), t, span);
  for (std::size_t i = 0; i < n(); ++i) D(1)[i] = forward * memory_h_ * slope_[i];
  return Outcome::ok;
}

Outcome Ndf::start_from(double t, const double* y, double h, const double* differences) {
  restart(t, y, h, options_.max_order);
  std::copy(differences, differences + static_cast<std::size_t>(order_) * n(), D(1));
  return first_slope(t, y);
}

/// f into `candidate_`, y' with M y' = f into `slope_`; J, and the weights of the start.
Outcome Ndf::first_slope(double t, const double* y) {
  weights_.fill(y, weight_.data());
  return initial_.first(newton_, t, y, weight_.data(), candidate_.data(), slope_.data());
}

/// D_1 … D_k of the present k, from one |h| to another: D ← D R(ρ) U, U = R(1).
void Ndf::rescale_memory(double h) {
  const int k = order_;
  const double rho = h / memory_h_;
  if (rho != 1) {
    const Small R = differences_at(rho, k), U = differences_at(1, k);
    Small RU{};
    for (std::size_t i = 1; i <= static_cast<std::size_t>(k); ++i)
      for (std::size_t j = 1; j <= static_cast<std::size_t>(k); ++j)
        for (std::size_t l = 1; l <= static_cast<std::size_t>(k); ++l) RU[i][j] += R[i][l] * U[l][j];
    for (std::size_t c = 0; c < n(); ++c) {
      double row[most];
      for (int j = 1; j <= k; ++j) row[j] = D(j)[c];
      for (int j = 1; j <= k; ++j) {
        double sum = 0;
        for (int i = 1; i <= k; ++i) sum += row[i] * RU[static_cast<std::size_t>(i)][static_cast<std::size_t>(j)];
        D(j)[c] = sum;
      }
    }
  }
  memory_h_ = h;
  memory_order_ = k;
  steps_at_h_ = 0;
}

Step::Attempt Ndf::attempt(double h, double t1) {
  signed_h_ = h;
  h_ = std::abs(h);
  t1_ = t1;
  newton_.forget_undefined();
  error_ = std::numeric_limits<double>::quiet_NaN();
  const Attempt stopped{Outcome::stop, error_, candidate_.data()};
  const Attempt diverged{Outcome::ok, error_, candidate_.data(), false};
  if (h_ != memory_h_ || order_ != memory_order_) rescale_memory(h_);
  const double c = h * gamma_inverse(order_);
  newton_.renew_if_noise(c);
  if (newton_.repair(t_, y()) == Status::stop) return stopped;
  switch (newton_.prepare(c, t1)) {
    case Outcome::stop: return stopped;
    case Outcome::not_finite: return diverged;
    case Outcome::ok: break;
  }
  predict();
  switch (newton_.solve(c, t1, predictor_.data(), psi_.data(), weight_.data(), d_.data(), candidate_.data())) {
    case Newton::Result::stop: return stopped;
    case Newton::Result::failed: return diverged;
    case Newton::Result::converged: break;
  }
  if (look_due(c)) {
    bool doubtful = false;
    const Outcome outcome = newton_.doubt(c, psi_.data(), d_.data(), doubtful);
    if (outcome == Outcome::stop) return stopped;
    if (doubtful) return diverged;
  }
  error_ = norm(d_.data()) * error_constant(order_);
  return {Outcome::ok, error_, candidate_.data()};
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
  std::copy(y_.begin(), y_.end(), predictor_.begin());
  std::fill(psi_.begin(), psi_.end(), 0);
  for (int j = 1; j <= order_; ++j)
    for (std::size_t i = 0; i < n(); ++i) {
      predictor_[i] += D(j)[i];
      psi_[i] += D(j)[i] * (gamma[static_cast<std::size_t>(j)] * scale);
    }
  weights_.fill(y(), predictor_.data(), weight_.data());
}

double Ndf::optimal_h(int k, double error, double safety) const {
  const double shrink = safety * std::pow(error / weights_.rtol(), 1.0 / (k + 1));
  return shrink > 1 / largest_growth ? h_ / shrink : h_ * largest_growth;
}

/// |h| of a retry with formula k, whose error at the present |h| is `error`.
double Ndf::retry_h(int k, double error, double safety) const {
  return h_ * std::max(smallest_retry, safety * std::pow(weights_.rtol() / error, 1.0 / (k + 1)));
}

/// Whether J is looked at: one that is not stiff cannot be much too large.
bool Ndf::look_due(double c) {
  const int age = newton_.jacobian_age();
  return !newton_.matrix_free() && age > 0 && age % look_period == 0 && newton_.stiff(c, weight_.data());
}

/// Whether an error failure may be due to J: projection hides from Newton's iteration that an old one is wrong, and in
/// algebraic equations it may be so large that the updates are too small to show it. There one that is not old is
/// renewed too, at the second failure of a step.
bool Ndf::misleading_jacobian() {
  const int age = newton_.jacobian_age();
  const bool algebraic = newton_.mass() && newton_.mass()->singular();
  if (algebraic && failed_ && age > 0) return true;
  return (algebraic || options_.renew_on_error) && age >= old_jacobian &&
         newton_.stiff(h_ * gamma_inverse(order_), weight_.data());
}

bool Ndf::reject(Cause cause, double hmin) {
  if (cause == Cause::newton) {
    if (newton_.hopeless()) return false;
    if (newton_.renew_if_old()) return true;
    if (h_ <= hmin) return false;
    h_ = std::max(hmin, newton_cut * h_);
    newton_.renew_if_undefined();
    return true;
  }
  if (h_ <= hmin) return false;
  double h = 0.5 * h_;
  if (!failed_ && cause == Cause::error) {
    h = retry_h(order_, error_, retry_same);
    if (order_ > options_.min_order) {
      for (std::size_t i = 0; i < n(); ++i) scratch_[i] = D(order_)[i] + d_[i];
      const double lower = retry_h(order_ - 1, norm(scratch_.data()) * error_constant(order_ - 1), retry_lower);
      if (lower > h) {
        h = std::min(lower, h_);
        --order_;
      }
    }
  }
  if (cause == Cause::error && misleading_jacobian()) newton_.renew();
  failed_ = true;
  h_ = std::max(hmin, h);
  return true;
}

Outcome Ndf::accept(const double* y1) {
  const int k = order_;
  const double c = signed_h_ * gamma_inverse(k);
  for (std::size_t i = 0; i < n(); ++i) {
    slope_[i] = (psi_[i] + d_[i]) / c;
    d_[i] += y1[i] - candidate_[i];  // the correction, if any, enters all differences
    D(k + 2)[i] = d_[i] - D(k + 1)[i];
    D(k + 1)[i] = d_[i];
  }
  for (int j = k; j >= 1; --j)
    for (std::size_t i = 0; i < n(); ++i) D(j)[i] += D(j + 1)[i];
  t_ = t1_;
  std::copy(y1, y1 + n(), y_.begin());
  newton_.step_accepted();
  failed_ = false;
  steps_at_h_ = std::min(steps_at_h_ + 1, options_.max_order + 2);
  choose_order_and_step();
  return Outcome::ok;
}

void Ndf::choose_order_and_step() {
  const int k = order_;
  if (steps_at_h_ < k + 2) return;
  const auto h_of = [this](int order, double safety) {
    return optimal_h(order, norm(D(order + 1)) * error_constant(order), safety);
  };
  double best = h_of(k, safety_same);
  int order = k;
  const auto offer = [&](int candidate, double safety) {
    if (const double h = h_of(candidate, safety); h > best) {
      best = h;
      order = candidate;
    }
  };
  if (k > options_.min_order) offer(k - 1, safety_lower);
  if (k < options_.max_order) offer(k + 1, safety_higher);
  if (best > h_) {
    h_ = best;
    order_ = order;
  }
}

void Ndf::state(Archive& archive) {
  Step::state(archive);
  newton_.state(archive);
  archive(order_, memory_order_, memory_h_, steps_at_h_, failed_, differences_, weight_, slope_);
  for (const int k : {order_, memory_order_}) archive.require(k >= 1 && k <= options_.max_order);
}

Interpolate Ndf::interpolate() const { return newton_backward; }
std::size_t Ndf::extension_size() const { return static_cast<std::size_t>(memory_order_ + 1) * n(); }
std::size_t Ndf::max_extension_size() const { return static_cast<std::size_t>(options_.max_order + 1) * n(); }

Status Ndf::extension(double* data) {
  data = std::copy(y_.begin(), y_.end(), data);
  std::copy(D(1), D(memory_order_ + 1), data);
  return Status::ok;
}

}  // namespace invariode
