#include "methods/adams.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>

#include "methods/initial_step.hpp"
#include "output/polynomial.hpp"

namespace invariode {
namespace {

/// γ*_1, γ*_2, …: coefficients of the error of the Adams-Moulton formulas, as the book rounds them. (Exact ones change
/// the course of sensitive runs.)
constexpr double gamma_star[] = {0,      0.5,     0.0833,  0.0417,  0.0264,  0.0188,  0.0143,
                                 0.0114, 0.00936, 0.00789, 0.00679, 0.00592, 0.00524, 0.00468};

/// The limits of stability of the formulas of order k on the negative real axis, at equal steps
/// (tests/test_stiffness.py).
constexpr double stable_up_to[] = {0, 2.0, 2.4, 1.93, 1.41, 1.04, 0.77, 0.58, 0.44, 0.34, 0.26, 0.21, 0.16};
constexpr double indistinct = 1000 * eps;  // y₁ − p, in the weights: below, f tells nothing about λ but roundoff

constexpr double starting_fraction = 0.25;  // of √rtol: what the first step may change y by

}  // namespace

Adams::Adams(Callback& f, const Weights& weights, int max_order, double parts_seen)
    : Step(f, weights),
      max_order_(max_order),
      parts_seen_(parts_seen),
      phi_(static_cast<std::size_t>(max_order + 2) * weights.size()),
      values_(5 * weights.size()) {
  double* next = values_.data();
  for (double** v : {&weight_, &candidate_, &defect_, &slope_, &next_slope_}) *v = std::exchange(next, next + n());
}

Outcome Adams::start(double t, const double* y, const Span& span) {
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  std::fill(phi_.begin(), phi_.end(), 0);
  order_ = previous_order_ = 1;
  previous_h_ = 0;
  steps_at_h_ = 0;
  phase1_ = true;
  predicted_ = false;
  failures_ = 0;
  g_[1] = 1;
  g_[2] = 0.5;
  sigma_[1] = 1;
  if (const Outcome outcome = evaluate(t, y, slope_); outcome != Outcome::ok) return outcome;
  std::copy(slope_, slope_ + n(), phi(1));
  weights_.fill(y, weight_);
  const double reciprocal = norm(slope_) / (starting_fraction * std::sqrt(weights_.rtol()));
  h_ = initial_step(reciprocal, t, span);
  rest_.begin(reciprocal, t, span);
  return Outcome::ok;
}

/// Calls work(begin, end) for the components in blocks of which several vectors fit into the cache.
template <class Work>
void Adams::for_each_block(Work work) {
  constexpr std::size_t block = 512;
  for (std::size_t begin = 0; begin < n(); begin += block) work(begin, std::min(begin + block, n()));
}

Outcome Adams::evaluate(double t, const double* y, double* out) {
  evaluated_ = out;
  if (!all_finite(y, n())) return Outcome::not_finite;
  if (f_(t, y, out) == Status::stop) return Outcome::stop;
  return all_finite(out, n()) ? Outcome::ok : Outcome::not_finite;
}

double Adams::norm(const double* v) const {
  return max_norm(n(), [v, w = weight_](std::size_t i) { return v[i] / w[i]; });
}

Step::Attempt Adams::attempt(double h, double t1) {
  signed_h_ = h;
  h_ = std::abs(h);
  t1_ = t1;
  if (predicted_) {  // the attempt is repeated: back to p
    const double weight = g_[static_cast<std::size_t>(order_) + 1];
    for (std::size_t i = 0; i < n(); ++i) candidate_[i] -= h * (weight * defect_[i]);
  } else {
    weights_.fill(y(), weight_);
    update_coefficients();
    predict();
  }
  const Outcome outcome = evaluate(t1, candidate_, defect_);
  if (outcome != Outcome::ok) {
    lower_ = order_;
    return {outcome, std::numeric_limits<double>::quiet_NaN(), candidate_};
  }
  const double size = compare_orders();
  const auto k = static_cast<std::size_t>(order_);
  for (std::size_t i = 0; i < n(); ++i) candidate_[i] += h * (g_[k + 1] * defect_[i]);
  double error = h_ * size * (g_[k] - g_[k + 1]);
  const auto start_norm = [this](const double* v) { return norm(v); };  // the weights are those of the step's start
  const Outcome judged = rest_.judge(f_, t_, y(), slope_, h, weights_.rtol(), n(), error, start_norm);
  return {judged, error, candidate_};
}

bool Adams::errors(double* out) const {
  const auto k = static_cast<std::size_t>(order_);
  for (std::size_t i = 0; i < n(); ++i) out[i] = h_ * (g_[k] - g_[k + 1]) * defect_[i];
  return true;
}

/// The predicted differences and the defect, of which y* − y is a combination.
std::size_t Adams::directions(const double** vectors) const {
  for (int i = 1; i <= order_; ++i) *vectors++ = phi(i);
  *vectors = defect_;
  return static_cast<std::size_t>(order_) + 1;
}

/// ψ, α, β, σ and g of the step to come ([SG], chapter 5). While h stays the same, the first ns of them do too.
void Adams::update_coefficients() {
  const double h = signed_h_;
  assert(h != 0 && order_ >= 1 && order_ <= max_order_);
  const auto k = static_cast<std::size_t>(order_);
  if (h != previous_h_) steps_at_h_ = 0;
  if (steps_at_h_ <= previous_order_) ++steps_at_h_;
  const auto ns = static_cast<std::size_t>(steps_at_h_);
  if (k < ns) return;

  beta_[ns] = 1;
  alpha_[ns] = 1 / static_cast<double>(ns);
  sigma_[ns + 1] = 1;
  double sum = h * static_cast<double>(ns);
  for (std::size_t i = ns + 1; i <= k; ++i) {
    const double before = std::exchange(psi_[i - 1], sum);
    beta_[i] = beta_[i - 1] * psi_[i - 1] / before;
    sum = before + h;
    alpha_[i] = h / sum;
    sigma_[i + 1] = static_cast<double>(i) * alpha_[i] * sigma_[i];
  }
  psi_[k] = sum;

  const auto diagonal = [](std::size_t i) { return 1 / static_cast<double>(i * (i + 1)); };
  if (ns == 1) {
    for (std::size_t i = 1; i <= k; ++i) v_[i] = w_[i] = diagonal(i);
  } else {
    if (order_ > previous_order_) {  // v has no entry k yet, and those before lack what it would have given them
      v_[k] = diagonal(k);
      for (std::size_t j = 1; j + 2 <= ns; ++j) v_[k - j] -= alpha_[j + 1] * v_[k - j + 1];
    }
    for (std::size_t i = 1; i <= k + 1 - ns; ++i) w_[i] = v_[i] -= alpha_[ns] * v_[i + 1];
    g_[ns + 1] = w_[1];
  }
  for (std::size_t i = ns + 2; i <= k + 1; ++i) {
    for (std::size_t l = 1; l <= k + 2 - i; ++l) w_[l] -= alpha_[i - 1] * w_[l + 1];
    g_[i] = w_[1];
  }
}

/// φ becomes the predicted differences at t₁; p = y + h Σ g_i φ_i.
void Adams::predict() {
  const int k = order_;
  std::copy(phi(k + 1), phi(k + 1) + n(), phi(k + 2));
  for_each_block([&](std::size_t begin, std::size_t end) {
    for (int i = k; i >= 1; --i) {
      const double g = g_[static_cast<std::size_t>(i)];
      const double beta = i > steps_at_h_ ? beta_[static_cast<std::size_t>(i)] : 1;
      double* here = phi(i);
      const double* above = phi(i + 1);
      if (i == k) {
        for (std::size_t c = begin; c < end; ++c) candidate_[c] = g * (here[c] *= beta);
        continue;
      }
      for (std::size_t c = begin; c < end; ++c) {
        const double scaled = beta * here[c];
        candidate_[c] += g * scaled;
        here[c] = scaled + above[c];
      }
    }
    for (std::size_t c = begin; c < end; ++c) candidate_[c] = y_[c] + signed_h_ * candidate_[c];
  });
  predicted_ = true;
}

/// Takes the prediction back.
void Adams::restore() {
  if (!std::exchange(predicted_, false)) return;
  std::fill(phi(order_ + 1), phi(order_ + 1) + n(), 0);
  for (int i = 1; i <= order_; ++i) {
    const double beta = beta_[static_cast<std::size_t>(i)];
    for (std::size_t c = 0; c < n(); ++c) phi(i)[c] = (phi(i)[c] - phi(i + 1)[c]) / beta;
  }
  for (std::size_t i = 2; i <= static_cast<std::size_t>(order_); ++i) psi_[i - 1] = psi_[i] - signed_h_;
}

/// d becomes f(t₁, p) − φ₁. Errors that the orders k, k − 1 and k − 2 would make, and whether they ask for a lower
/// order. Returns the norm of d.
double Adams::compare_orders() {
  const auto k = static_cast<std::size_t>(order_);
  const double* first = phi(1);
  for (std::size_t c = 0; c < n(); ++c) defect_[c] -= first[c];
  const double size = norm(defect_);
  const auto error = [&](std::size_t order, double norm) { return h_ * sigma_[order + 1] * gamma_star[order] * norm; };
  const auto with_d = [&](int order) {
    return max_norm(n(), [a = phi(order), d = defect_, w = weight_](std::size_t c) { return (a[c] + d[c]) / w[c]; });
  };
  erk_ = error(k, size);
  lower_ = order_;
  if (k == 1) return size;
  erkm1_ = error(k - 1, with_d(order_));
  if (k == 2 ? erkm1_ <= 0.5 * erk_ : std::max(erkm1_, error(k - 2, with_d(order_ - 1))) <= erk_) lower_ = order_ - 1;
  return size;
}

bool Adams::reject(Cause, double hmin) {
  restore();
  previous_h_ = 0;
  const double limit = rest_.reject();
  phase1_ = phase1_ && limit > 0;  // which is a start with another h
  if (h_ <= hmin) return false;
  ++failures_;
  order_ = failures_ >= 3 ? 1 : lower_;
  const double goal = 0.5 * weights_.rtol();
  const double factor = failures_ > 3 && goal < 0.25 * erk_ ? std::sqrt(goal / erk_) : 0.5;
  h_ = std::max(hmin, limit > 0 ? limit : h_ * factor);
  return true;
}

Outcome Adams::accept(const double* y1) {
  if (const Outcome outcome = evaluate(t1_, y1, next_slope_); outcome != Outcome::ok) return outcome;
  std::swap(slope_, next_slope_);
  t_ = t1_;
  std::copy(y1, y1 + n(), y_.begin());
  for_each_block([&](std::size_t begin, std::size_t end) {
    const double* first = phi(1);
    double *correction = phi(order_ + 1), *change = phi(order_ + 2);
    for (std::size_t c = begin; c < end; ++c) {
      correction[c] = slope_[c] - first[c];
      change[c] = correction[c] - change[c];
    }
    for (int i = 1; i <= order_; ++i) {
      double* here = phi(i);
      for (std::size_t c = begin; c < end; ++c) here[c] += correction[c];
    }
  });
  previous_order_ = order_;
  previous_h_ = signed_h_;
  predicted_ = false;
  failures_ = 0;
  rest_.accept();
  choose_order_and_step();
  return Outcome::ok;
}

void Adams::choose_order_and_step() {
  const int k = previous_order_;
  if (lower_ < k || k == max_order_) phase1_ = false;
  if (phase1_) {
    order_ = k + 1;
    h_ *= 2;
    return;
  }
  double error = erk_;  // that the chosen order would have made
  const auto choose = [&](int order, double its_error) {
    order_ = order;
    error = its_error;
  };
  if (lower_ < k) {
    choose(k - 1, erkm1_);
  } else if (k + 1 <= steps_at_h_) {
    const double erkp1 = h_ * gamma_star[k + 1] * norm(phi(k + 2));
    if (k > 1 && erkm1_ <= std::min(erk_, erkp1))
      choose(k - 1, erkm1_);
    else if (k < max_order_ && erkp1 < (k > 1 ? 1 : 0.5) * erk_)
      choose(k + 1, erkp1);
  }
  const double goal = 0.5 * weights_.rtol();
  if (goal >= std::ldexp(error, order_ + 1))
    h_ *= 2;
  else if (goal < error)
    h_ *= std::max(0.5, std::min(0.9, std::pow(goal / error, 1.0 / (order_ + 1))));
}

void Adams::state(Archive& archive) {
  Step::state(archive);
  archive(order_, previous_order_, previous_h_, steps_at_h_, phase1_, lower_, erk_, erkm1_, failures_);
  rest_.state(archive);
  archive(phi_);
  for (Coefficients* one : {&psi_, &alpha_, &beta_, &sigma_, &g_, &v_, &w_}) archive.values(one->data(), one->size());
  archive.values(slope_, n());
  if (!archive.reading()) return;
  for (const int k : {order_, previous_order_, lower_}) archive.require(k >= 1 && k <= max_order_);
  archive.require(steps_at_h_ <= highest_order + 1);
  predicted_ = false;
}

Interpolate Adams::interpolate() const { return power_series; }

std::size_t Adams::extension_size() const { return (static_cast<std::size_t>(previous_order_) + 2) * n(); }
std::size_t Adams::max_extension_size() const { return (static_cast<std::size_t>(max_order_) + 2) * n(); }

/// The polynomial through (t₁, y) and with the slope Σ_j φ_{j+1} c_j(θ), j < terms, in powers of θ = (t − t₀)/h:
/// c₀ = 1 and c_j = c_{j−1} (h/ψ_j) (θ + ψ_{j−1}/h − 1), ψ₀ = 0. Since ψ_j grows with j, the sizes of the coefficients
/// of each c_j sum to at most 2: sums of powers lose no digits. `data`: holds y (n,), and becomes the coefficients.
/// `difference(j)`: φ_{j+1}.
template <class Difference>
void Adams::integrate_differences(std::size_t terms, double h, Difference difference, double* data) const {
  double c[highest_order + 2] = {1};  // coefficients of c_j
  std::fill(data + n(), data + (terms + 1) * n(), 0);
  for (std::size_t j = 0; j < terms; ++j) {
    if (j > 0) {
      const double shift = (j > 1 ? psi_[j - 1] / h : 0) - 1, scale = h / psi_[j];
      for (std::size_t m = j + 1; m-- > 0;) c[m] = scale * ((m > 0 ? c[m - 1] : 0) + shift * c[m]);
    }
    const double* phi = difference(j);
    for (std::size_t m = 0; m <= j; ++m) {
      const double weight = h * c[m] / static_cast<double>(m + 1);
      double* coefficient = data + (m + 1) * n();
      for (std::size_t i = 0; i < n(); ++i) coefficient[i] += weight * phi[i];
    }
  }
  for (std::size_t m = 1; m <= terms; ++m)
    for (std::size_t i = 0; i < n(); ++i) data[i] -= data[m * n() + i];
}

Status Adams::extension(double* data) {
  std::copy(y(), y() + n(), data);
  integrate_differences(
      static_cast<std::size_t>(previous_order_) + 1, previous_h_,
      [this](std::size_t j) { return phi(static_cast<int>(j) + 1); }, data);
  return Status::ok;
}

/// The polynomial of the attempt, through (t₁, y*), with the differences that the step would leave if f were at y* what
/// it is at p. `difference`: room for n numbers.
void Adams::extend_attempt(double* difference, double* data) const {
  const auto k = static_cast<std::size_t>(order_);
  std::copy(candidate_, candidate_ + n(), data);
  integrate_differences(
      k + 1, signed_h_,
      [&](std::size_t j) -> const double* {
        if (j == k) return defect_;
        for (std::size_t i = 0; i < n(); ++i) difference[i] = phi(static_cast<int>(j) + 1)[i] + defect_[i];
        return difference;
      },
      data);
}

Status Adams::extension_of_attempt(double* data, std::size_t& size) {
  size = (static_cast<std::size_t>(order_) + 2) * n();
  inside_.resize(static_cast<std::size_t>(max_degree() + 4) * n());
  extend_attempt(inside_.data(), data);
  return Status::ok;
}

/// The attempt's polynomial has f(t₁, p) and the k values of f before it as slopes. The slope that f has at a point of
/// it, less its own, is d of a step that ends there: the same test.
Step::Attempt Adams::inspect_inside(const Attempt& attempt, double gap) {
  const auto k = static_cast<std::size_t>(order_), terms = k + 1;
  inside_.resize(static_cast<std::size_t>(max_degree() + 4) * n());
  double *difference = inside_.data(), *point = difference + n(), *slope = point + n(), *powers = slope + n();
  extend_attempt(difference, powers);
  const int pieces = static_cast<int>(std::ceil(h_ / gap));
  double error = attempt.error;
  for (int piece = 1; piece < pieces; ++piece) {
    const double theta = static_cast<double>(piece) / pieces;
    power_series(powers, (terms + 1) * n(), n(), theta, point);
    const Outcome outcome = evaluate(t_ + theta * signed_h_, point, slope);
    if (outcome != Outcome::ok) return {outcome, std::numeric_limits<double>::quiet_NaN(), candidate_};
    for (std::size_t i = 0; i < n(); ++i) {
      double own = 0;  // h P'
      for (std::size_t m = terms; m >= 1; --m) own = own * theta + static_cast<double>(m) * powers[m * n() + i];
      slope[i] -= own / signed_h_;
    }
    error = std::max(error, h_ * norm(slope) * (g_[k] - g_[k + 1]));
  }
  return {attempt.outcome, error, attempt.y};
}

/// From p and y₁, both at t₁: f(t₁, y₁) − f(t₁, p) is φ_{k+1} − d, and y₁ − p is h g_{k+1} d and the correction.
double Adams::stability() const {
  const auto k = static_cast<std::size_t>(previous_order_);
  const double* change = phi(previous_order_ + 1);
  MaxNorm slopes, arguments;
  for (std::size_t i = 0; i < n(); ++i) {
    slopes.add((change[i] - defect_[i]) / weight_[i]);
    arguments.add((previous_h_ * g_[k + 1] * defect_[i] + (y_[i] - candidate_[i])) / weight_[i]);
  }
  return arguments.value() > indistinct ? std::abs(previous_h_) * slopes.value() / arguments.value() / real_limit() : 0;
}

double Adams::real_limit() const { return stable_up_to[previous_order_]; }

int Adams::undefined_component() const {
  for (std::size_t i = 0; i < n(); ++i)
    if (!std::isfinite(evaluated_[i])) return static_cast<int>(i);
  return -1;
}

}  // namespace invariode
