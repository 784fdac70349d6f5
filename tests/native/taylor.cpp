// Taylor series, with coefficients written by hand.

#include "methods/taylor.hpp"

#include <cmath>
#include <vector>

#include "check.hpp"
#include "methods.hpp"
#include "run/run.hpp"

using namespace invariode;

namespace {

/// y' = f(t, y) with its Taylor coefficients.
struct System {
  const char* name;
  std::vector<double> y0;
  double tf;
  Callback::Function* f;
  Series::Function* series;
  void (*solution)(double t, double* y);
};

/// Σ_{j ≤ k} a_j b_{k−j} of two columns of coefficients with that stride.
double product(const double* a, const double* b, std::size_t k, std::size_t stride) {
  double sum = 0;
  for (std::size_t j = 0; j <= k; ++j) sum += a[j * stride] * b[(k - j) * stride];
  return sum;
}

int order_of(void* context) { return *static_cast<int*>(context); }

/// x' = v, v' = −x
Status harmonic(void*, double, const double* y, double* out) {
  out[0] = y[1], out[1] = -y[0];
  return Status::ok;
}
Status series_of_harmonic(void* order, double, double unit, const double* y, double* out) {
  out[0] = y[0], out[1] = y[1];
  for (int k = 0; k < order_of(order); ++k, out += 2)
    out[2] = unit * out[1] / (k + 1), out[3] = unit * -out[0] / (k + 1);
  return Status::ok;
}

/// Two bodies, eccentricity e, from the pericentre.
constexpr double e = 0.5;
Status kepler(void*, double, const double* y, double* out) {
  const double r2 = y[0] * y[0] + y[1] * y[1], r3 = r2 * std::sqrt(r2);
  out[0] = y[2], out[1] = y[3], out[2] = -y[0] / r3, out[3] = -y[1] / r3;
  return Status::ok;
}
Status series_of_kepler(void* order, double, double unit, const double* y, double* out) {
  double r2[Taylor::highest_order], u[Taylor::highest_order];  // u = (r²)^{−3/2}
  std::copy(y, y + 4, out);
  for (std::size_t k = 0; k < static_cast<std::size_t>(order_of(order)); ++k) {
    r2[k] = product(out, out, k, 4) + product(out + 1, out + 1, k, 4);
    double sum = 0;
    for (std::size_t j = 1; j <= k; ++j)
      sum += (-1.5 * static_cast<double>(j) - static_cast<double>(k - j)) * r2[j] * u[k - j];
    u[k] = k == 0 ? 1 / (r2[0] * std::sqrt(r2[0])) : sum / (static_cast<double>(k) * r2[0]);
    double* next = out + 4 * (k + 1);
    const double scale = static_cast<double>(k + 1) / unit;
    for (std::size_t i = 0; i < 2; ++i) {
      double force = 0;
      for (std::size_t j = 0; j <= k; ++j) force -= out[4 * j + i] * u[k - j];
      next[i] = out[4 * k + 2 + i] / scale;
      next[2 + i] = force / scale;
    }
  }
  return Status::ok;
}
void solution_of_kepler(double t, double* y) {
  double E = t;  // Kepler's equation E − e sin E = t, by Newton
  for (int k = 0; k < 20; ++k) E -= (E - e * std::sin(E) - t) / (1 - e * std::cos(E));
  const double b = std::sqrt(1 - e * e), rate = 1 / (1 - e * std::cos(E));
  y[0] = std::cos(E) - e, y[1] = b * std::sin(E), y[2] = -std::sin(E) * rate, y[3] = b * std::cos(E) * rate;
}

const System systems[] = {
    {"harmonic",
     {1, 0},
     100,
     harmonic,
     series_of_harmonic,
     [](double t, double* y) { y[0] = std::cos(t), y[1] = -std::sin(t); }},
    {"kepler", {1 - e, 0, 0, std::sqrt((1 + e) / (1 - e))}, 50, kepler, series_of_kepler, solution_of_kepler}};

RunResult solve(const System& system, int order, double rtol) {
  const std::size_t n = system.y0.size();
  Problem problem;
  problem.n = n;
  problem.f = {system.f, nullptr};
  problem.series = Series(system.series, &order, order);
  const Solver solver(*find_method("taylor"), std::move(problem), Weights(rtol, std::vector<double>(n, 1), {}),
                      {.tf = system.tf, .hmax = system.tf / 10, .dense = true}, {});
  Run run(solver);
  if (run.integration().start(system.y0.data()) == State::running) run.integration().run();
  return run.take_result();
}

}  // namespace

TEST(smoke) {
  for (const System& system : systems)
    for (const double rtol : {1e-6, 1e-9, 1e-12, 1e-15}) {
      const int order = static_cast<int>(std::ceil(1 - std::log(rtol) / 2));
      const RunResult result = solve(system, order, rtol);
      CHECK(result.state == State::reached_end);
      std::vector<double> exact(system.y0.size());
      system.solution(system.tf, exact.data());
      double error = 0;
      for (std::size_t i = 0; i < exact.size(); ++i) error = std::max(error, std::abs(exact[i] - result.end()[i]));
      std::cout << system.name << " " << rtol << " p " << order << " steps " << result.counts.steps << " failed "
                << result.counts.failed << " nfev " << result.nfev << " error " << error << "\n";
    }
}
