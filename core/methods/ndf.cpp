#include "methods/ndf.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

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

constexpr int newton_iterations = 4;
constexpr double newton_goal = 0.5;         // of rtol: the error of the iteration
constexpr double newton_first_goal = 0.05;  // the same for the first iteration, where the rate is an old one
constexpr double slowest_rate = 0.9;
constexpr double rate_memory = 0.9;  // what remains of the last rate in the present one
constexpr double newton_cut = 0.3;   // of h, where a current Jacobian does not help
constexpr int old_jacobian = 20;     // steps
constexpr double stiffness = 10;     // h invGa_k ‖J‖ above which an old Jacobian may do harm

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

Ndf::Ndf(Callback& f, const Weights& weights, Jacobian jacobian, Mass* mass, const Options& options)
    : Step(f, weights),
      options_(options),
      jacobian_(std::move(jacobian)),
      mass_(mass),
      lu_(make_factorization(jacobian_.matrix().structure, options.lapack)),
      differences_(static_cast<std::size_t>(options.max_order + 2) * weights.size()) {
  for (std::vector<double>* v :
       {&weight_, &predictor_, &psi_, &d_, &candidate_, &residual_, &slope_, &f_value_, &scratch_})
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

Outcome Ndf::evaluate(double t, const double* y, double* out) {
  undefined_ = false;
  if (!all_finite(y, n())) return Outcome::not_finite;
  if (f_(t, y, out) == Status::stop) return Outcome::stop;
  if (all_finite(out, n())) return Outcome::ok;
  if (out != f_value_.data()) std::copy(out, out + n(), f_value_.begin());
  undefined_ = true;
  return Outcome::not_finite;
}

/// Memory as it is before any step, at a first |h|.
void Ndf::restart(double t, const double* y, double h, int order) {
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  h_ = memory_h_ = h;
  order_ = memory_order_ = order;
  std::fill(differences_.begin(), differences_.end(), 0);
  steps_at_h_ = 0;
  factored_ = 0;
  rate_known_ = renew_ = failed_ = false;
}

Outcome Ndf::start(double t, const double* y, const Span& span) {
  restart(t, y, 0, 1);
  const double forward = span.tf >= t ? 1 : -1;
  std::vector<double> f0(n()), later(n());
  if (const Outcome outcome = evaluate(t, y, f0.data()); outcome != Outcome::ok) return outcome;
  if (jacobian_.evaluate(f_, t, y, f0.data()) == Status::stop) return Outcome::stop;
  jacobian_current_ = true;
  jacobian_age_ = 0;
  weights_.fill(y, weight_.data());

  MassSolver solver;
  const Matrix& J = jacobian_.matrix();
  const auto solve_for_slope = [&](std::vector<double>& f, const double* ft) {
    if (mass_) solver.slope(*mass_, ft, f.data());
  };
  if (mass_) {
    if (mass_->evaluate(t) == Status::stop) return Outcome::stop;
    if (!solver.factor(*mass_, J, weight_.data(), options_.lapack)) {
      work_.singular = true;
      return Outcome::not_finite;
    }
  }
  slope_ = f0;
  solve_for_slope(slope_, nullptr);
  const double root = std::sqrt(weights_.rtol());
  const double first = first_h(starting_safety * norm(slope_.data()) / root, t, span);

  // The second derivative decides: M y'' = f_t + J y'.
  const double step = forward * std::min(std::sqrt(eps) * std::max(std::abs(t), std::abs(t + forward * first)), first);
  const double increment = (t + step) - t;
  if (const Outcome outcome = evaluate(t + increment, y, later.data()); outcome == Outcome::stop) return outcome;
  for (std::size_t i = 0; i < n(); ++i) later[i] = undefined_ || increment == 0 ? 0 : (later[i] - f0[i]) / increment;
  undefined_ = false;
  if (mass_ && mass_->singular()) {
    slope_ = f0;
    solve_for_slope(slope_, later.data());
  }
  J.multiply(slope_.data(), scratch_.data());
  for (std::size_t i = 0; i < n(); ++i) scratch_[i] += later[i];
  solve_for_slope(scratch_, nullptr);
  const double second = norm(scratch_.data());
  h_ = memory_h_ = first_h(starting_safety * std::sqrt(0.5 * second / weights_.rtol()), t, span);
  for (std::size_t i = 0; i < n(); ++i) D(1)[i] = forward * memory_h_ * slope_[i];
  return Outcome::ok;
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

/// Takes the Jacobian at (t, y).
Status Ndf::renew_jacobian() {
  renew_ = false;
  if (jacobian_.kind() == Jacobian::Kind::differences) {
    const Outcome outcome = evaluate(t_, y(), residual_.data());
    if (outcome == Outcome::stop) return Status::stop;
  }
  factored_ = 0;
  jacobian_current_ = true;
  jacobian_age_ = 0;
  return jacobian_.evaluate(f_, t_, y(), residual_.data());
}

/// Factorises M − c J, unless that has been done. `not_finite`: it is singular.
Outcome Ndf::factor(double c) {
  if (c == factored_) return Outcome::ok;
  ++work_.factorizations;
  rate_known_ = false;
  factored_ = 0;
  work_.undefined_jacobian = !all_finite(jacobian_.matrix().values.data(), jacobian_.matrix().values.size());
  work_.singular = !lu_->factor(mass_ ? &mass_->matrix() : nullptr, c, jacobian_.matrix());
  if (work_.singular) return Outcome::not_finite;
  factored_ = c;
  return Outcome::ok;
}

Step::Attempt Ndf::attempt(double h, double t1) {
  signed_h_ = h;
  h_ = std::abs(h);
  t1_ = t1;
  undefined_ = false;
  error_ = std::numeric_limits<double>::quiet_NaN();
  const Attempt stopped{Outcome::stop, error_, candidate_.data()};
  const Attempt diverged{Outcome::ok, error_, candidate_.data(), false};
  if (h_ != memory_h_ || order_ != memory_order_) rescale_memory(h_);
  if (renew_ && renew_jacobian() == Status::stop) return stopped;
  if (mass_ && mass_->evaluate(t1) == Status::stop) return stopped;
  const double c = h * gamma_inverse(order_);
  if (factor(c) != Outcome::ok) return diverged;
  switch (iterate(c, t1)) {
    case Newton::stop: return stopped;
    case Newton::failed: return diverged;
    case Newton::converged: break;
  }
  error_ = norm(d_.data()) * error_constant(order_);
  return {Outcome::ok, error_, candidate_.data()};
}

/// Simplified Newton iteration for d = ∇^{k+1} y₁ of c f(t₁, y₁) = M (ψ + d), y₁ = predictor + d.
Ndf::Newton Ndf::iterate(double c, double t1) {
  const int k = order_;
  const double scale = gamma_inverse(k);
  std::copy(y_.begin(), y_.end(), predictor_.begin());
  std::fill(psi_.begin(), psi_.end(), 0);
  for (int j = 1; j <= k; ++j)
    for (std::size_t i = 0; i < n(); ++i) {
      predictor_[i] += D(j)[i];
      psi_[i] += D(j)[i] * (gamma[static_cast<std::size_t>(j)] * scale);
    }
  std::fill(d_.begin(), d_.end(), 0);
  candidate_ = predictor_;
  weights_.fill(y(), predictor_.data(), weight_.data());
  const double roundoff = 100 * eps * norm(predictor_.data());

  double previous = 0;
  for (int iteration = 1; iteration <= newton_iterations; ++iteration) {
    switch (evaluate(t1, candidate_.data(), f_value_.data())) {
      case Outcome::stop: return Newton::stop;
      case Outcome::not_finite: return Newton::failed;
      case Outcome::ok: break;
    }
    for (std::size_t i = 0; i < n(); ++i) scratch_[i] = psi_[i] + d_[i];
    if (mass_)
      mass_->matrix().multiply(scratch_.data(), residual_.data());
    else
      std::swap(scratch_, residual_);
    for (std::size_t i = 0; i < n(); ++i) residual_[i] = c * f_value_[i] - residual_[i];
    ++work_.solves;
    lu_->solve(residual_.data());
    const double size = norm(residual_.data());
    for (std::size_t i = 0; i < n(); ++i) {
      d_[i] += residual_[i];
      candidate_[i] = predictor_[i] + d_[i];
    }
    if (!std::isfinite(size)) return Newton::failed;
    if (size <= roundoff) return Newton::converged;
    const double goal = newton_goal * weights_.rtol();
    if (iteration == 1) {
      if (rate_known_ && size * rate_ / (1 - rate_) <= newton_first_goal * weights_.rtol()) return Newton::converged;
      if (!rate_known_) rate_ = 0;
    } else {
      if (size > slowest_rate * previous) return Newton::failed;
      rate_ = std::max(rate_memory * rate_, size / previous);
      rate_known_ = true;
      const double left = size * rate_ / (1 - rate_);
      if (left <= goal) return Newton::converged;
      if (left * std::pow(rate_, newton_iterations - iteration) > goal) return Newton::failed;
    }
    previous = size;
  }
  return Newton::failed;
}

/// Whether h invGa_k ‖J‖ is large in the norm of the error test. Where it is not, an old Jacobian does no harm. (With a
/// mass matrix, which would have to be inverted to tell: yes.)
bool Ndf::stiff() {
  if (mass_) return true;
  std::fill(scratch_.begin(), scratch_.end(), 0);
  jacobian_.matrix().for_each(
      [this](std::size_t i, std::size_t j, double value) { scratch_[i] += std::abs(value) * weight_[j]; });
  return norm(scratch_.data()) * h_ * gamma_inverse(order_) > stiffness;
}

double Ndf::optimal_h(int k, double error, double safety) const {
  const double shrink = safety * std::pow(error / weights_.rtol(), 1.0 / (k + 1));
  return shrink > 1 / largest_growth ? h_ / shrink : h_ * largest_growth;
}

bool Ndf::reject(Cause cause, double hmin) {
  if (cause == Cause::newton) {
    if (!jacobian_current_ && jacobian_.kind() != Jacobian::Kind::constant) {
      renew_ = true;
      return true;
    }
    if (h_ <= hmin) return false;
    h_ = std::max(hmin, newton_cut * h_);
    renew_ = work_.undefined_jacobian && jacobian_.kind() != Jacobian::Kind::constant;
    return true;
  }
  if (h_ <= hmin) return false;
  double h = 0.5 * h_;
  if (!failed_ && cause == Cause::error) {
    const auto retry = [this](int k, double error, double safety) {
      return h_ * std::max(smallest_retry, safety * std::pow(weights_.rtol() / error, 1.0 / (k + 1)));
    };
    h = retry(order_, error_, retry_same);
    if (order_ > 1) {
      for (std::size_t i = 0; i < n(); ++i) scratch_[i] = D(order_)[i] + d_[i];
      const double lower = retry(order_ - 1, norm(scratch_.data()) * error_constant(order_ - 1), retry_lower);
      if (lower > h) {
        h = std::min(lower, h_);
        --order_;
      }
    }
  }
  if (cause == Cause::error && options_.renew_on_error && jacobian_age_ >= old_jacobian &&
      jacobian_.kind() != Jacobian::Kind::constant && stiff())
    renew_ = true;
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
  jacobian_current_ = false;
  ++jacobian_age_;
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
  if (k > 1) offer(k - 1, safety_lower);
  if (k < options_.max_order) offer(k + 1, safety_higher);
  if (best > h_) {
    h_ = best;
    order_ = order;
  }
}

Interpolate Ndf::interpolate() const { return newton_backward; }
std::size_t Ndf::extension_size() const { return static_cast<std::size_t>(memory_order_ + 1) * n(); }
std::size_t Ndf::max_extension_size() const { return static_cast<std::size_t>(options_.max_order + 1) * n(); }

Status Ndf::extension(double* data) {
  data = std::copy(y_.begin(), y_.end(), data);
  std::copy(D(1), D(memory_order_ + 1), data);
  return Status::ok;
}

int Ndf::undefined_component() const {
  if (!undefined_) return -1;
  for (std::size_t i = 0; i < n(); ++i)
    if (!std::isfinite(f_value_[i])) return static_cast<int>(i);
  return -1;
}

LinearWork Ndf::linear_work() const {
  LinearWork work = work_;
  work.jacobians = jacobian_.count();
  return work;
}

}  // namespace invariode
