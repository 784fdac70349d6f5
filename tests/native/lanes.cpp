// Trajectories side by side: each is the single run to the last bit, in every instruction set, whoever its neighbours.

#include "run/lanes/lanes.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <deque>
#include <initializer_list>
#include <limits>
#include <memory>
#include <numeric>
#include <random>
#include <string>
#include <vector>

#include "check.hpp"
#include "methods.hpp"
#include "methods/controller.hpp"
#include "run/ensemble.hpp"
#include "run/lanes/worker.hpp"

#define INVARIODE_LANES tested
#include "run/lanes/power.hpp"

namespace invariode::test::lanes_laws {

namespace {

constexpr auto go_on = [](std::uint32_t) { return true; };
constexpr std::size_t parameters = 3;

/// x' = v, v' = −p₀ x − p₁ x³ + cos t, and a third component whose derivative ends at t = p₂.
void law(double t, const double* y, double* out, const double* p, std::size_t stride) {
  const double x = y[0], v = y[stride], z = y[2 * stride];
  out[0] = v;
  out[stride] = -p[0] * x - p[stride] * x * x * x + std::cos(t);
  out[2 * stride] = std::sqrt(p[2 * stride] - t) - z;
}

/// The same without the cosine, which keeps p₀ x²/2 + p₁ x⁴/4 + v²/2: its gradient is a law too.
void free_law(double t, const double* y, double* out, const double* p, std::size_t stride) {
  const double x = y[0], z = y[2 * stride];
  out[0] = y[stride];
  out[stride] = -p[0] * x - p[stride] * x * x * x;
  out[2 * stride] = std::sqrt(p[2 * stride] - t) - z;
}

/// The same with z' = −z, and its Taylor coefficients (docs/algorithms.md, 'Taylor series').
void smooth_law(double, const double* y, double* out, const double* p, std::size_t stride) {
  const double x = y[0];
  out[0] = y[stride];
  out[stride] = -p[0] * x - p[stride] * x * x * x;
  out[2 * stride] = -y[2 * stride];
}

constexpr int order = 9;

void coefficients(double unit, const double* y, double* out, const double* p, std::size_t stride) {
  double square[order];
  const auto c = [&](int k, std::size_t i) -> double& { return out[(3 * static_cast<std::size_t>(k) + i) * stride]; };
  for (std::size_t i = 0; i < 3; ++i) c(0, i) = y[i * stride];
  for (int k = 0; k < order; ++k) {
    double cube = square[k] = 0;
    for (int j = 0; j <= k; ++j) square[k] += c(j, 0) * c(k - j, 0);
    for (int j = 0; j <= k; ++j) cube += square[j] * c(k - j, 0);
    c(k + 1, 0) = unit * c(k, 1) / (k + 1);
    c(k + 1, 1) = unit * (-p[0] * c(k, 0) - p[stride] * cube) / (k + 1);
    c(k + 1, 2) = -unit * c(k, 2) / (k + 1);
  }
}

constexpr double changing = 900;  // p₂ above which g is something that changes, or changes with t

void energy(double t, const double* y, double* out, const double* p, std::size_t stride) {
  const double x = y[0], v = y[stride], last = p[2 * stride];
  out[0] = p[0] * x * x / 2 + p[stride] * x * x * x * x / 4 + v * v / 2;
  if (last > changing) out[0] += last > 2 * changing ? 1e-3 * std::sin(t) : 1e-3 * v;
}

void slope_of_energy(double, const double* y, double* out, const double* p, std::size_t stride) {
  const double x = y[0], last = p[2 * stride];
  out[0] = p[0] * x + p[stride] * x * x * x;
  out[stride] = y[stride] + (last > changing && last <= 2 * changing ? 1e-3 : 0);
  out[2 * stride] = 0;
}

constexpr std::size_t varied = 2;  // sensitivities, to p₀ and to an initial value

/// Those of the first two laws.
void slope_of_sensitivities(double, const double* y, double* out, const double* p, std::size_t stride) {
  const double x = y[0];
  for (std::size_t j = 0; j < varied; ++j) {
    const double* S = y + 3 * (1 + j) * stride;
    double* slope = out + 3 * j * stride;
    slope[0] = S[stride];
    slope[stride] = -(p[0] + 3 * p[stride] * x * x) * S[0] - (j == 0 ? x : 0);
    slope[2 * stride] = -S[2 * stride];
  }
}

void tangent_of_energy(double t, const double* y, double* out, const double* p, std::size_t stride) {
  std::vector<double> gradient(3 * stride);
  slope_of_energy(t, y, gradient.data(), p, stride);
  for (std::size_t j = 0; j < varied; ++j) {
    out[j * stride] = j == 0 ? y[0] * y[0] / 2 : 0;
    for (std::size_t i = 0; i < 3; ++i) out[j * stride] += gradient[i * stride] * y[(3 * (1 + j) + i) * stride];
  }
}

void position(double, const double* y, double* out, const double*, std::size_t) { out[0] = y[0]; }

/// Undefined for some after a while, as the third component is.
void speed(double t, const double* y, double* out, const double* p, std::size_t stride) {
  out[0] = y[stride] * y[stride] - 0.3 + (p[2 * stride] < 2 ? std::sqrt(0.9 * p[2 * stride] - t) : 0);
}

using Law = void(double t, const double* y, double* out, const double* p, std::size_t stride);

template <Law& one>
Status evaluated_alone(void* context, double t, const double* y, double* out) {
  one(t, y, out, static_cast<const double*>(context), 1);
  return Status::ok;
}

Status expanded_alone(void* context, double, double unit, const double* y, double* out) {
  coefficients(unit, y, out, static_cast<const double*>(context), 1);
  return Status::ok;
}

/// What runs have beside f: an invariant; events, which may be terminal; sensitivities, which may count in the error
/// test.
struct Beside {
  bool invariant = false;
  bool series = false;
  bool events = false;
  std::int64_t terminal[2] = {0, 0};
  bool sensitivities = false;
  bool counts = true;
};

struct InLanes {
  std::size_t lanes;
  std::atomic<bool> finite = true;  // all points at which any thread asked it

  [[nodiscard]] LaneForm form(const lanes::Instructions* instructions, const Beside& beside = {}) {
    LaneForm form;
    form.instructions = instructions;
    form.f = {beside.series ? called<smooth_law> : beside.invariant ? called<free_law> : called<law>, this};
    if (beside.series) form.series = {expanded, this};
    if (beside.invariant) form.g = {called<energy>, this};
    if (beside.invariant) form.jacobian = {called<slope_of_energy>, this};
    if (beside.events) form.events = {{called<position>, this}, {called<speed>, this}};
    if (beside.sensitivities) form.slope = {called<slope_of_sensitivities, 3 * (1 + varied)>, this};
    if (beside.sensitivities) form.tangent = {called<tangent_of_energy, 3 * (1 + varied)>, this};
    return form;
  }

  template <Law& one, std::size_t n = 3>
  static void called(void* context, const double* t, const double* y, double* out, const double* p) {
    auto& me = *static_cast<InLanes*>(context);
    if (!all_finite(y, n * me.lanes) || !all_finite(t, me.lanes)) me.finite = false;
    for (std::size_t l = 0; l < me.lanes; ++l) one(t[l], y + l, out + l, p + l, me.lanes);
  }
  static void expanded(void* context, const double*, const double* unit, const double* y, double* out,
                       const double* p) {
    auto& me = *static_cast<InLanes*>(context);
    if (!all_finite(y, 3 * me.lanes) || !all_finite(unit, me.lanes)) me.finite = false;
    for (std::size_t l = 0; l < me.lanes; ++l) coefficients(unit[l], y + l, out + l, p + l, me.lanes);
  }
};

struct Rows {
  std::vector<double> y0, p;
  std::vector<double> all, tolerances;  // y0 with sensitivities, and tolerances of these

  Rows(std::size_t size, std::mt19937_64& random, double far = 1e3) {
    std::uniform_real_distribution<double> uniform(-1, 1);
    for (std::size_t i = 0; i < size; ++i) {
      for (int c = 0; c < 3; ++c) y0.push_back(2 * uniform(random));
      p.push_back(std::exp(4 * uniform(random)));  // costs differ by 50
      p.push_back(std::exp(2 * uniform(random)));
      p.push_back(uniform(random) > -0.8 ? far : 1);  // which some reach
    }
    if (size > 4) y0[3 * 4] = std::numeric_limits<double>::quiet_NaN();
    if (size > 7) p[3 * 7] = std::numeric_limits<double>::infinity();
  }
  void vary(std::mt19937_64& random) {
    std::uniform_real_distribution<double> uniform(-6, 0);
    for (std::size_t i = 0; i < y0.size(); i += 3) {
      all.insert(all.end(), &y0[i], &y0[i] + 3);
      all.insert(all.end(), {0, 0, 0, 1, 0, 0});
      for (std::size_t j = 0; j < 3 * varied; ++j) tolerances.push_back(std::exp(uniform(random)));
    }
  }
  [[nodiscard]] Ensemble ensemble() const {
    if (all.empty()) return {y0.size() / 3, y0.data(), p.data(), 3, parameters};
    return {y0.size() / 3, all.data(), p.data(), 3 * (1 + varied), parameters, tolerances.data()};
  }
};

/// As many solvers, each with parameters of its own.
class Solvers {
 public:
  Solvers(const Method& method, std::size_t workers, const Weights& weights, const Settings& settings,
          const Beside& beside = {}) {
    for (std::size_t w = 0; w < workers; ++w) {
      auto& place = places_.emplace_back(parameters, 1.0);
      Problem problem;
      problem.n = 3;
      problem.f = {beside.series      ? evaluated_alone<smooth_law>
                   : beside.invariant ? evaluated_alone<free_law>
                                      : evaluated_alone<law>,
                   place.data()};
      if (beside.series) problem.series = {.solution = Series(expanded_alone, place.data(), order)};
      if (beside.invariant) {
        InvariantBlock block;
        block.g = {evaluated_alone<energy>, place.data()};
        block.jacobian = {evaluated_alone<slope_of_energy>, place.data()};
        block.m = 1;
        block.held = true;
        if (beside.sensitivities) block.tangent = {evaluated_alone<tangent_of_energy>, place.data()};
        problem.invariants.push_back(block);
        problem.value.push_back(0);
      }
      if (beside.events) {
        problem.events.resize(2);
        problem.events[0] = {.function = {evaluated_alone<position>, place.data()}, .terminal = beside.terminal[0]};
        problem.events[1] = {
            .function = {evaluated_alone<speed>, place.data()}, .terminal = beside.terminal[1], .direction = 1};
      }
      if (beside.sensitivities)
        problem.variations = {.k = varied,
                              .slope = {evaluated_alone<slope_of_sensitivities>, place.data()},
                              .tolerance = std::vector<double>(3 * varied, 1),
                              .error_test = beside.counts};
      problem.parameters = place;
      solvers_.push_back(std::make_unique<Solver>(method, problem, weights, settings, MethodOptions{}));
      pointers_.push_back(solvers_.back().get());
    }
  }
  std::vector<Solver*>& all() { return pointers_; }

 private:
  std::deque<std::vector<double>> places_;
  std::vector<std::unique_ptr<Solver>> solvers_;
  std::vector<Solver*> pointers_;
};

bool same_numbers(const std::vector<double>& a, const std::vector<double>& b) {
  return std::ranges::equal(a, b, [](double x, double y) { return x == y || (std::isnan(x) && std::isnan(y)); });
}

/// (trajectory, t, y) of an event, in the order of trajectories.
std::vector<std::vector<double>> in_order(const EnsembleResult::Occurrences& event) {
  std::vector<std::vector<double>> rows;
  for (std::size_t k = 0; k < event.trajectory.size(); ++k) {
    std::vector<double>& row = rows.emplace_back();
    row = {static_cast<double>(event.trajectory[k]), event.points.t[k]};
    for (std::size_t c = 0; c < 3; ++c) row.push_back(event.points.y[3 * k + c]);
  }
  std::ranges::sort(rows);
  return rows;
}

void check_same(const EnsembleResult& a, const EnsembleResult& b) {
  CHECK(same_numbers(a.t, b.t));
  CHECK(same_numbers(a.y_end, b.y_end) && same_numbers(a.y, b.y));
  CHECK(a.state == b.state);
  CHECK(a.count == b.count);
  CHECK(same_numbers(a.value, b.value) && same_numbers(a.before, b.before));
  CHECK(same_numbers(a.after, b.after) && same_numbers(a.correction, b.correction));
  CHECK(a.failures.size() == b.failures.size());
  for (std::size_t e = 0; e < a.occurrences.size(); ++e)
    CHECK(in_order(a.occurrences[e]) == in_order(b.occurrences[e]));
}

struct Case {
  std::size_t size;
  Settings settings;
  Weights weights;
  Beside beside;
};

/// Output times, among them the ends, two in a row, and any interpolation.
std::vector<double> random_times(Settings& settings, std::mt19937_64& random) {
  std::uniform_real_distribution<double> uniform(0, 1);
  constexpr Interpolation modes[] = {Interpolation::projected, Interpolation::corrected, Interpolation::raw};
  settings.interpolation = modes[random() % 3];
  std::vector<double> parts{0, 1};
  for (int i = 0; i < 20; ++i) parts.push_back(uniform(random));
  parts.push_back(std::nextafter(parts.back(), 1));
  std::ranges::sort(parts);
  if (uniform(random) < 0.5) parts.erase(parts.begin());
  std::vector<double> times;
  for (const double part : parts)
    times.push_back(part == 1 ? settings.tf : settings.t0 + part * (settings.tf - settings.t0));
  return times;
}

std::vector<Case> random_cases(std::mt19937_64& random) {
  const auto between = [&](double a, double b) { return std::uniform_real_distribution<double>(a, b)(random); };
  std::vector<Case> cases;
  for (const std::size_t size : {1, 2, 3, 9, 17, 40, 100}) {
    const double rtol = std::exp(between(std::log(1e-6), std::log(1e-3))), t0 = between(-3, 3), span = between(1, 4);
    const bool backwards = between(0, 1) < 0.3, vector = between(0, 1) < 0.5, starts = between(0, 1) < 0.3;
    Settings settings{.t0 = t0, .tf = backwards ? t0 - span : t0 + span, .hmax = between(0.05, 1) * span};
    if (starts) settings.first_step = 1e-2;
    settings.save_all = settings.output_at_times = between(0, 1) < 0.5;
    settings.record = false;
    if (settings.output_at_times) settings.times = Times(random_times(settings, random));
    if (between(0, 1) < 0.3) settings.max_steps = 40;
    const std::vector<double> scale = vector ? std::vector{1.0, 10.0, 3.0} : std::vector<double>{};
    Beside beside{.events = between(0, 1) < 0.5};
    if (between(0, 1) < 0.5) beside.terminal[random() % 2] = 1 + static_cast<std::int64_t>(random() % 3);
    cases.push_back({size, settings, Weights(rtol, {1e-3, 1e-3, 1.0}, scale), beside});
  }
  return cases;
}

/// How many trajectories were solved beside others, and how many failed.
struct Compared {
  std::size_t beside_others = 0, refused = 0;

  void operator+=(const Compared& more) {
    beside_others += more.beside_others;
    refused += more.refused;
  }
};

/// In lanes of every instruction set, on each of these numbers of threads, the results are those of single runs.
Compared compare_with_single_runs(const Method& method, const Case& one, const Rows& rows,
                                  std::initializer_list<std::size_t> threads) {
  Solvers solvers(method, 1, one.weights, one.settings, one.beside);
  CHECK(obstacle_to_lanes(*solvers.all()[0]) == nullptr);
  const auto alone = integrate_all(solvers.all(), rows.ensemble(), go_on);
  Compared compared{.refused = alone->failures.size()};
  for (const lanes::Instructions* instructions : lanes::instructions())
    for (const std::size_t workers : threads) {
      const check::Case label(method.name, ", ", instructions->name, ", ", one.size, " rows, ", workers, " workers");
      Solvers crew(method, workers, one.weights, one.settings, one.beside);
      InLanes form{instructions->kernel(method.name)->lanes};
      const auto found = integrate_all(crew.all(), rows.ensemble(), go_on, form.form(instructions, one.beside));
      check_same(*found, *alone);
      CHECK(form.finite);
      compared.beside_others += one.size - std::accumulate(found->alone.begin(), found->alone.end(), std::size_t{0});
    }
  return compared;
}

}  // namespace

TEST(lanes_are_the_single_runs_to_the_bit_in_every_instruction_set) {
  std::mt19937_64 random(17);
  Compared compared;
  for (const Method& method : general_methods()) {
    if (lanes::instructions().back()->kernel(method.name) == nullptr) continue;
    for (const Case& one : random_cases(random)) {
      const Rows rows(one.size, random);
      compared += compare_with_single_runs(method, one, rows, {1, 3});
    }
  }
  CHECK(compared.beside_others > 1000);
}

TEST(an_invariant_is_held_in_lanes_as_in_single_runs) {
  std::mt19937_64 random(3);
  Compared compared;
  for (const Method& method : general_methods()) {
    if (lanes::instructions().back()->kernel(method.name) == nullptr) continue;
    for (Case& one : random_cases(random)) {
      // Of some the energy is told with a mistake, of others it changes with time.
      const double far = one.size % 3 == 0 ? 1000 : one.size % 3 == 1 ? 500 : 2000;
      const Rows rows(one.size, random, far);
      one.beside.invariant = true;
      one.settings.iterations = method.iterations;
      one.settings.check = one.size != 17;
      compared += compare_with_single_runs(method, one, rows, {2});
    }
  }
  CHECK(compared.beside_others > 500);
  CHECK(compared.refused > 100);
}

TEST(sensitivities_in_lanes_are_those_of_single_runs) {
  std::mt19937_64 random(29);
  Compared compared;
  for (const Method& method : general_methods()) {
    if (lanes::instructions().back()->kernel(method.name) == nullptr) continue;
    for (Case& one : random_cases(random)) {
      Rows rows(one.size, random, 500);
      rows.vary(random);
      one.beside = {.invariant = random() % 2 == 0, .sensitivities = true, .counts = random() % 4 != 0};
      one.settings.iterations = method.iterations;
      compared += compare_with_single_runs(method, one, rows, {2});
    }
  }
  CHECK(compared.beside_others > 500);
}

TEST(series_in_lanes_are_those_of_single_runs) {
  std::mt19937_64 random(23);
  const Method& method = *find_method("taylor");
  Compared compared;
  for (const bool invariant : {false, true})
    for (Case& one : random_cases(random)) {
      const Rows rows(one.size, random, 500);
      one.beside = {.invariant = invariant, .series = true};
      compared += compare_with_single_runs(method, one, rows, {1, 3});
    }
  CHECK(compared.beside_others > 500);
}

TEST(a_cancelled_ensemble_in_lanes_leaves_its_trajectories_unsolved) {
  std::mt19937_64 random(1);
  const Rows rows(100, random);
  Settings settings{.tf = 1e7, .hmax = 1};
  settings.save_all = false;
  for (const lanes::Instructions* instructions : lanes::instructions()) {
    Solvers solvers(*find_method("ode45"), 2, Weights(1e-6, {1, 1, 1}, {}), settings);
    InLanes form{instructions->lanes};
    const auto all =
        integrate_all(solvers.all(), rows.ensemble(), [](std::uint32_t) { return false; }, form.form(instructions));
    CHECK(std::ranges::count(all->state, EnsembleResult::unsolved) > 0);
    for (std::size_t i = 0; i < all->size; ++i) {  // the others have ended at their p₂
      const bool began = all->state[i] >= static_cast<std::int8_t>(State::reached_end);
      CHECK(!began || all->state[i] == static_cast<std::int8_t>(State::step_failed) ||
            all->state[i] == static_cast<std::int8_t>(State::start_undefined));
    }
  }
}

TEST(what_only_some_runs_have_keeps_them_out_of_lanes) {
  Settings settings{.tf = 1, .hmax = 1};
  const Weights weights(1e-6, {1, 1, 1}, {});
  const auto obstacle = [&](const char* method, const Settings& s) {
    Solvers solvers(*find_method(method), 1, weights, s);
    return std::string(obstacle_to_lanes(*solvers.all()[0]));
  };
  CHECK(obstacle("ode113", settings).find("method") != std::string::npos);
  Settings other = settings;
  other.output_at_times = true;
  CHECK(obstacle("ode45", other).find("recorded") != std::string::npos);
  other = settings;
  other.time_limit = 5;
  CHECK(obstacle("ode45", other).find("limited") != std::string::npos);
  other = settings;
  other.tf = std::numeric_limits<double>::infinity();
  CHECK(obstacle("ode45", other).find("infinite") != std::string::npos);
}

namespace {

/// Of x^(1/Q) for random x: the largest error before rounding in units of the last place; and how many results are not
/// those of std::pow, or were left to it.
template <int Q>
void check_roots(std::mt19937_64& random) {
  using namespace lanes::tested;
  constexpr int W = 4, many = 100000;
  std::uniform_real_distribution<double> exponent(-28, 0);
  double worst = 0;
  int different = 0, doubtful = 0;
  for (int i = 0; i < many; ++i) {
    Pack<W> x, y, rest;
    for (int l = 0; l < W; ++l) x.lanes()[l] = std::exp2(exponent(random));
    if (i == 0) x = runge_kutta::smallest_ratio;
    if (i == 1) x = 1;
    Mask<W> doubt;
    split_root<Q>(x, y, rest);
    rounded_root<Q>(x, doubt);
    const Pack<W> root = root_by_pow<Q>(x);
    for (int l = 0; l < W; ++l) {
      const double pow = std::pow(x.lanes()[l], 1.0 / Q);
      const long double exact = std::pow(static_cast<long double>(x.lanes()[l]), static_cast<long double>(1.0 / Q));
      const long double error = y.lanes()[l] - exact + rest.lanes()[l];
      worst = std::max(worst, std::abs(static_cast<double>(error)) / ulp(std::nextafter(pow, 0)));
      different += root.lanes()[l] != pow ? 1 : 0;
      doubtful += doubt.lanes()[l] != 0 ? 1 : 0;
    }
  }
  const check::Case label("q = ", Q, ", error ", worst, " ulp, ", doubtful, " doubtful");
  CHECK(different == 0);
  CHECK(worst < 0.005 + (std::numeric_limits<long double>::digits > 60 ? 0 : 1));  // without them nobody knows
  CHECK(doubtful < 0.05 * W * many);
}

}  // namespace

TEST(roots_are_those_of_pow_and_hardly_ever_need_it) {
  std::mt19937_64 random(5);
  check_roots<3>(random);
  check_roots<5>(random);
  check_roots<8>(random);
  check_roots<9>(random);
}

}  // namespace invariode::test::lanes_laws
