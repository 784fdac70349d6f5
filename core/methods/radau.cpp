#include "methods/radau.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <utility>

#include "methods/runge_kutta.hpp"

namespace invariode {
namespace {

constexpr std::size_t s = Radau::stages;
using Row = std::array<double, s>;
using Square = std::array<Row, s>;

constexpr double root_6 = 2.4494897427831780982;
constexpr double cube_root_9 = 2.0800838230519041145, cube_root_3 = 3 / cube_root_9;

constexpr Square inverse(const Square& a) {
  Square cofactor{};
  for (std::size_t i = 0; i < s; ++i)
    for (std::size_t j = 0; j < s; ++j)
      cofactor[j][i] = a[(i + 1) % s][(j + 1) % s] * a[(i + 2) % s][(j + 2) % s] -
                       a[(i + 1) % s][(j + 2) % s] * a[(i + 2) % s][(j + 1) % s];
  double determinant = 0;
  for (std::size_t j = 0; j < s; ++j) determinant += a[0][j] * cofactor[j][0];
  for (Row& row : cofactor)
    for (double& entry : row) entry /= determinant;
  return cofactor;
}

constexpr Square product(const Square& a, const Square& b) {
  Square c{};
  for (std::size_t i = 0; i < s; ++i)
    for (std::size_t j = 0; j < s; ++j)
      for (std::size_t k = 0; k < s; ++k) c[i][j] += a[i][k] * b[k][j];
  return c;
}

/// The zeros of d²/dx² x² (x − 1)³, that is of (x² − 4x/5 + 1/10)(x − 1).
constexpr Row c{(4 - root_6) / 10, (4 + root_6) / 10, 1};

/// Z_i = Σ_k a_k c_i^k, k = 1 … 3: the collocation polynomial, 0 at 0, at the stages; and back.
constexpr Square of_polynomial = [] {
  Square P{};
  for (std::size_t i = 0; i < s; ++i) P[i] = {c[i], c[i] * c[i], c[i] * c[i] * c[i]};
  return P;
}();
constexpr Square to_polynomial = inverse(of_polynomial);

/// A⁻¹: h Y'_i = Σ_k k a_k c_i^{k−1}.
constexpr Square A_inverse = [] {
  Square D{};
  for (std::size_t i = 0; i < s; ++i) D[i] = {1, 2 * c[i], 3 * c[i] * c[i]};
  return product(D, to_polynomial);
}();

/// The eigenvalues of A⁻¹, the zeros of μ³ − 9 μ² + 36 μ − 60: mu, and alpha ± i beta.
constexpr double mu = 3 + cube_root_9 - cube_root_3;
constexpr double alpha = 3 + (cube_root_3 - cube_root_9) / 2;
constexpr double beta = std::numbers::sqrt3 * (cube_root_3 + cube_root_9) / 2;

/// The columns of T are the eigenvector of mu and the real and imaginary part of that of alpha + i beta. A polynomial p
/// of degree 3 with p' − μ p = κ M, where M vanishes at the c_i, has p(c_i) = M' μ² + M'' μ + M''' there, but for a
/// factor; p(0) = 0 is the equation of the eigenvalues.
constexpr Square T = [] {
  Square columns{};
  for (std::size_t i = 0; i < s; ++i) {
    const double first = 3 * c[i] * c[i] - 18.0 / 5 * c[i] + 9.0 / 10, second = 6 * c[i] - 18.0 / 5;
    columns[i] = {first * mu * mu + second * mu + 6, first * (alpha * alpha - beta * beta) + second * alpha + 6,
                  first * 2 * alpha * beta + second * beta};
  }
  return columns;
}();
constexpr Square T_inverse = inverse(T);

constexpr double distance(const Square& a, const Square& b) {
  double largest = 0;
  for (std::size_t i = 0; i < s; ++i)
    for (std::size_t j = 0; j < s; ++j) largest = std::max({largest, a[i][j] - b[i][j], b[i][j] - a[i][j]});
  return largest;
}
constexpr double roundoff = 1e-13;  // of what is computed here, of terms up to 60
constexpr Square blocks{{{mu, 0, 0}, {0, alpha, beta}, {0, -beta, alpha}}};
static_assert(distance(product(T_inverse, product(A_inverse, T)), blocks) < roundoff);

/// Σ b_i c_i^k = 1 / (k + 1) for k < 5, where b is the last row of A: with collocation, order 5.
constexpr bool has_order_5() {
  const Square A = inverse(A_inverse);
  Row power{1, 1, 1};
  for (int k = 0; k < Radau::formula_order; ++k) {
    double sum = -1.0 / (k + 1);
    for (std::size_t i = 0; i < s; ++i) {
      sum += A[s - 1][i] * power[i];
      power[i] *= c[i];
    }
    if (sum > roundoff || sum < -roundoff) return false;
  }
  return true;
}
static_assert(has_order_5());

/// The estimate compares with a formula of order 3 that takes f at the start with weight 1/μ: but for the factor
/// (M − c J)⁻¹, c = h/μ, it is c f(t, y) + M Σ e_i Z_i (Hairer & Wanner, eq. IV.8.19).
constexpr Row e{(-13 - 7 * root_6) / (3 * mu), (-13 + 7 * root_6) / (3 * mu), -1 / (3 * mu)};
constexpr double estimate_order = 4;  // it is O(h⁴)

// Hairer & Wanner, section IV.8, and their code RADAU5.
constexpr Convergence::Rules rules{.most_iterations = 7, .goal = 0.03, .first_goal = 0.003};
constexpr double safety = 0.9;
constexpr double smallest_factor = 0.2, largest_factor = 8;
constexpr double kept_from = 0.9, kept_up_to = 1.2;  // such a change of h is not worth two factorisations
constexpr double fast = 1e-2;  // rate of convergence with which J is kept (measured in benchmarks/multistep.py)
constexpr double smallest_error = 1e-2;  // of the last step, that the prediction takes
constexpr double newton_cut = 0.5;       // of h, where a current Jacobian does not help
constexpr double starting_safety = 1.25;
constexpr double roundoff_units = 100;  // of ε: an update of this size relative to y is roundoff

}  // namespace

Radau::Radau(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : Step(f, weights),
      jacobian_(f, weights, linear),
      initial_(f, linear),
      real_lu_(make_factors<double>(jacobian_.jacobian().structure, linear.lapack)),
      complex_lu_(make_factors<Complex>(jacobian_.jacobian().structure, linear.lapack)),
      convergence_(rules),
      increments_(s * weights.size()),
      polynomial_(s * weights.size()),
      residuals_(s * weights.size()),
      complex_residual_(weights.size()) {
  for (std::vector<double>* v : {&f_, &slope_, &last_y_, &candidate_, &weight_, &error_vector_, &gap_, &scratch_})
    v->resize(weights.size());
  if (linear.mass && !linear.mass->constant()) stage_masses_.resize(s);
}

double Radau::norm(const double* v) const {
  return max_norm(n(), [this, v](std::size_t i) { return v[i] / weight_[i]; });
}

/// 1/h is 1.25 rtol^{-1/4} times the larger one of ‖y'‖ and √(‖y''‖ / 2).
Outcome Radau::start(double t, const double* y, const Span& span) {
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  memory_h_ = last_h_ = 0;
  failed_ = false;
  jacobian_.forget();
  convergence_.forget();
  weights_.fill(y, weight_.data());
  if (const Outcome outcome = initial_.first(jacobian_, t, y, weight_.data(), f_.data(), slope_.data());
      outcome != Outcome::ok)
    return outcome;
  const double scale = starting_safety * std::pow(weights_.rtol(), -1 / estimate_order);
  const double first = scale * norm(slope_.data());
  const double h = std::copysign(first_h(first, t, span), span.tf - t);
  if (initial_.second(jacobian_, t, y, h, f_.data(), slope_.data(), gap_.data(), scratch_.data()) == Status::stop)
    return Outcome::stop;
  const double second = scale * std::sqrt(0.5 * norm(scratch_.data()));
  h_ = first_h(std::max(first, second), t, span);
  return Outcome::ok;
}

Step::Attempt Radau::attempt(double h, double t1) {
  signed_h_ = h;
  h_ = std::abs(h);
  t1_ = t1;
  error_ = std::numeric_limits<double>::quiet_NaN();
  jacobian_.forget_undefined();
  const Attempt stopped{Outcome::stop, error_, candidate_.data()};
  const Attempt diverged{Outcome::ok, error_, candidate_.data(), false};
  jacobian_.renew_if_noise(h / mu);
  if (jacobian_.repair(t_, y(), f_.data()) == Status::stop) return stopped;
  switch (factor()) {
    case Outcome::stop: return stopped;
    case Outcome::not_finite: return diverged;
    case Outcome::ok: break;
  }
  if (take_masses() == Status::stop) return stopped;
  predict();
  switch (solve_stages()) {
    case Newton::Result::stop: return stopped;
    case Newton::Result::failed: return diverged;
    case Newton::Result::converged: break;
  }
  for (std::size_t i = 0; i < n(); ++i) candidate_[i] = y_[i] + Z(s - 1)[i];
  if (estimate() == Outcome::stop) return stopped;
  return {Outcome::ok, error_, candidate_.data()};
}

/// M at t₁ and the factors of M − (h/μ) J for both eigenvalues.
Outcome Radau::factor() {
  return jacobian_.prepare(signed_h_ / mu, t1_, [this] {
    convergence_.forget();
    jacobian_.count_factorization();
    jacobian_.count_factorization();
    return factorize();
  });
}

bool Radau::factorize() {
  const Matrix* M = jacobian_.mass_matrix();
  const Matrix& J = jacobian_.jacobian();
  return real_lu_->factor(M, signed_h_ / mu, J) && complex_lu_->factor(M, signed_h_ / Complex(alpha, beta), J);
}

/// M(t) at the stages; the last of them is at hand.
Status Radau::take_masses() {
  if (stage_masses_.empty()) return Status::ok;
  stage_masses_[s - 1] = *jacobian_.mass_matrix();
  for (std::size_t k = 0; k + 1 < s; ++k) {
    if (jacobian_.mass()->evaluate(t_ + c[k] * signed_h_) == Status::stop) return Status::stop;
    stage_masses_[k] = *jacobian_.mass_matrix();
  }
  return Status::ok;
}

/// Increments as the last polynomial, extended, predicts them: its values less the one at its end.
void Radau::predict() {
  weights_.fill(y(), weight_.data());
  if (memory_h_ == 0) {
    std::fill(increments_.begin(), increments_.end(), 0);
    return;
  }
  for (std::size_t stage = 0; stage < s; ++stage) {
    const double x = signed_h_ / memory_h_ * c[stage];
    // (1 + x)^k − 1
    const Row power{x, x * (2 + x), x * (3 + x * (3 + x))};
    for (std::size_t i = 0; i < n(); ++i)
      Z(stage)[i] = power[0] * polynomial_[i] + power[1] * polynomial_[n() + i] + power[2] * polynomial_[2 * n() + i];
  }
}

Newton::Result Radau::solve_stages() {
  convergence_.begin(weights_.rtol(), roundoff_units * eps * norm(y()));
  for (;;) {
    switch (stage_residuals()) {
      case Outcome::stop: return Newton::Result::stop;
      case Outcome::not_finite: return Newton::Result::failed;
      case Outcome::ok: break;
    }
    switch (convergence_.judge(update_stages())) {
      case Convergence::Verdict::converged: return Newton::Result::converged;
      case Convergence::Verdict::diverged: return Newton::Result::failed;
      case Convergence::Verdict::go_on: break;
    }
  }
}

/// In a first step, which nothing predicts, the first update tells the size of components that start at 0.
void Radau::weigh_first_update() {
  if (memory_h_ != 0 || convergence_.iterations() > 0) return;
  for (std::size_t i = 0; i < n(); ++i) weight_[i] = weights_.at(i, y_[i], y_[i] + Z(s - 1)[i]);
}

/// h (f(t_i, Y_i) − M Y'_i), where h Y' = A⁻¹ Z.
Outcome Radau::stage_residuals() {
  for (std::size_t stage = 0; stage < s; ++stage) {
    double* residual = residuals_.data() + stage * n();
    for (std::size_t i = 0; i < n(); ++i) scratch_[i] = y_[i] + Z(stage)[i];
    const double t = stage + 1 == s ? t1_ : t_ + c[stage] * signed_h_;
    if (const Outcome outcome = jacobian_.evaluate(t, scratch_.data(), residual); outcome != Outcome::ok)
      return outcome;
    const Row& a = A_inverse[stage];
    for (std::size_t i = 0; i < n(); ++i) scratch_[i] = a[0] * Z(0)[i] + a[1] * Z(1)[i] + a[2] * Z(2)[i];
    const double* rate = scratch_.data();
    if (const Matrix* M = stage_masses_.empty() ? jacobian_.mass_matrix() : &stage_masses_[stage]) {
      M->multiply(scratch_.data(), gap_.data());
      rate = gap_.data();
    }
    for (std::size_t i = 0; i < n(); ++i) residual[i] = signed_h_ * residual[i] - rate[i];
  }
  return Outcome::ok;
}

/// Z ← Z + T ω, where (M − (h/μ) J) ω = (1/μ) T⁻¹ residual for each eigenvalue μ. The size of the update.
double Radau::update_stages() {
  const Complex mu_2(alpha, beta);
  double *r0 = residuals_.data(), *r1 = r0 + n(), *r2 = r1 + n();
  for (std::size_t i = 0; i < n(); ++i) {
    Row v;
    for (std::size_t k = 0; k < s; ++k)
      v[k] = T_inverse[k][0] * r0[i] + T_inverse[k][1] * r1[i] + T_inverse[k][2] * r2[i];
    r0[i] = v[0] / mu;
    complex_residual_[i] = Complex(v[1], -v[2]) / mu_2;
  }
  jacobian_.count_solve();
  jacobian_.count_solve();
  real_lu_->solve(r0);
  complex_lu_->solve(complex_residual_.data());
  for (std::size_t i = 0; i < n(); ++i) {
    const Row w{r0[i], complex_residual_[i].real(), -complex_residual_[i].imag()};
    for (std::size_t k = 0; k < s; ++k) {
      const double update = T[k][0] * w[0] + T[k][1] * w[1] + T[k][2] * w[2];
      Z(k)[i] += update;
      residuals_[k * n() + i] = update;
    }
  }
  weigh_first_update();
  MaxNorm size;
  for (const double* update : {r0, r1, r2}) size.add(norm(update));
  return size.value();
}

/// The error of the attempt. Where a first look would fail it in a step that starts anew, f is taken once more, at
/// y + error: what remains is what is not damped by the problem itself (Hairer & Wanner, eq. IV.8.20).
Outcome Radau::estimate() {
  weights_.fill(y(), candidate_.data(), weight_.data());
  for (std::size_t i = 0; i < n(); ++i) scratch_[i] = e[0] * Z(0)[i] + e[1] * Z(1)[i] + e[2] * Z(2)[i];
  gap_ = scratch_;
  if (Mass* mass = jacobian_.mass()) {
    if (!mass->constant() && mass->evaluate(t_) == Status::stop) return Outcome::stop;
    mass->matrix().multiply(scratch_.data(), gap_.data());
  }
  solve_for_error(f_.data());
  if (error_ <= weights_.rtol() || (memory_h_ != 0 && !failed_)) return Outcome::ok;
  for (std::size_t i = 0; i < n(); ++i) scratch_[i] = y_[i] + error_vector_[i];
  switch (jacobian_.evaluate(t_, scratch_.data(), residuals_.data())) {
    case Outcome::stop: return Outcome::stop;
    case Outcome::not_finite: jacobian_.forget_undefined(); break;  // the first look has to do
    case Outcome::ok: solve_for_error(residuals_.data()); break;
  }
  return Outcome::ok;
}

void Radau::solve_for_error(const double* f) {
  const double c_real = signed_h_ / mu;
  for (std::size_t i = 0; i < n(); ++i) error_vector_[i] = c_real * f[i] + gap_[i];
  jacobian_.count_solve();
  real_lu_->solve(error_vector_.data());
  error_ = norm(error_vector_.data());
}

bool Radau::errors(double* out) const {
  std::copy(error_vector_.begin(), error_vector_.end(), out);
  return true;
}

std::size_t Radau::directions(const double** vectors) const {
  for (std::size_t i = 0; i < stages; ++i) vectors[i] = increments_.data() + i * n();
  return stages;
}

/// By which h is to be multiplied; less where Newton's iteration was long.
double Radau::factor_of_error() const {
  const double most = 2 * rules.most_iterations + 1;
  const double slack = safety * most / (most - 1 + convergence_.iterations());
  const double factor = slack * std::pow(weights_.rtol() / error_, 1 / estimate_order);
  return std::clamp(factor, smallest_factor, largest_factor);
}

bool Radau::reject(Cause cause, double hmin) {
  failed_ = true;
  const bool renewed = (cause == Cause::newton || cause == Cause::error) && jacobian_.renew_if_old();
  if (cause == Cause::newton && renewed) return true;
  if (h_ <= hmin) return false;
  if (cause == Cause::newton) jacobian_.renew_if_undefined();
  h_ = std::max(hmin, h_ * (cause == Cause::error ? factor_of_error() : newton_cut));
  return true;
}

/// The step that the last two errors ask for (Gustafsson; Hairer & Wanner, section IV.8), and no more than the last
/// one alone does.
double Radau::next_h() const {
  double factor = factor_of_error();
  const double error = std::max(error_, smallest_error * weights_.rtol());
  if (last_h_ > 0) {
    const double trend = h_ / last_h_ * std::pow(last_error_ / error, 1 / estimate_order);
    factor = std::min(factor, std::max(smallest_factor, factor * trend));
  }
  if (failed_) factor = std::min(factor, 1.0);
  if (factor >= kept_from && factor <= kept_up_to && !jacobian_.renewal_due()) factor = 1;
  return factor * h_;
}

Outcome Radau::accept(const double* y1) {
  if (const Outcome outcome = jacobian_.evaluate(t1_, y1, scratch_.data()); outcome != Outcome::ok) return outcome;
  std::swap(f_, scratch_);
  for (std::size_t i = 0; i < n(); ++i) {
    for (std::size_t k = 0; k < s; ++k)
      polynomial_[k * n() + i] =
          to_polynomial[k][0] * Z(0)[i] + to_polynomial[k][1] * Z(1)[i] + to_polynomial[k][2] * Z(2)[i];
    if (jacobian_.mass())
      slope_[i] = (polynomial_[i] + 2 * polynomial_[n() + i] + 3 * polynomial_[2 * n() + i]) / signed_h_;
  }
  if (!jacobian_.mass()) slope_ = f_;
  last_y_.swap(y_);
  std::copy(y1, y1 + n(), y_.begin());
  t_ = t1_;
  jacobian_.step_accepted();
  if (convergence_.rate() > fast) jacobian_.renew();
  const double h = next_h();
  last_h_ = h_;
  last_error_ = std::max(error_, smallest_error * weights_.rtol());
  memory_h_ = signed_h_;
  failed_ = false;
  h_ = h;
  return Outcome::ok;
}

void Radau::state(Archive& archive) {
  Step::state(archive);
  archive(polynomial_, f_, slope_, signed_h_, memory_h_, last_h_, last_error_, failed_);
  convergence_.state(archive);
  jacobian_.state(archive, [this](double) { return factorize(); });
}

Interpolate Radau::interpolate() const { return runge_kutta::nested_polynomial; }

/// y + Σ a_k θ^k = y + θ (Z_3 + (1 − θ) (−(a_2 + a_3) − θ a_3))
Status Radau::extension(double* data) {
  const double *a1 = polynomial_.data(), *a2 = a1 + n(), *a3 = a2 + n();
  data = std::copy(last_y_.begin(), last_y_.end(), data);
  for (std::size_t i = 0; i < n(); ++i) {
    data[i] = Z(s - 1)[i];
    data[n() + i] = -(a2[i] + a3[i]);
    data[2 * n() + i] = -a3[i];
  }
  return Status::ok;
}

}  // namespace invariode
