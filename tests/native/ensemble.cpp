// Ensembles: each trajectory is the single run from its row, to the last bit, on any number of threads.

#include "run/ensemble.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <deque>
#include <limits>
#include <memory>
#include <stdexcept>
#include <vector>

#include "check.hpp"
#include "methods.hpp"
#include "run_problems.hpp"

namespace invariode::test_run::ensemble_laws {

namespace {

constexpr auto go_on = [](std::uint32_t) { return true; };

/// Oscillators of several energies; two cannot start, in one x is zero three times only after long.
struct Rows {
  static constexpr std::size_t size = 41;
  std::vector<double> y0, p;

  Rows() {
    for (std::size_t i = 0; i < size; ++i) {
      y0.push_back(1 + 0.1 * static_cast<double>(i % 7));
      y0.push_back(0.05 * static_cast<double>(i));
      p.push_back(1);
    }
    y0[2 * 5] = std::numeric_limits<double>::quiet_NaN();
    p[11] = std::numeric_limits<double>::infinity();  // f is not finite there
    p[17] = 1.5;                                      // and here the energy is not conserved
  }
  [[nodiscard]] Ensemble ensemble() const { return {size, y0.data(), p.data(), 2, 1}; }
};

/// As many solvers, each with parameters of its own.
class Solvers {
 public:
  Solvers(const Method& method, std::size_t workers, const Settings& settings, std::int64_t terminal) {
    for (std::size_t w = 0; w < workers; ++w) {
      Oscillator& one = oscillators_.emplace_back();
      one.add_event(terminal);
      solvers_.push_back(
          std::make_unique<Solver>(method, one.problem(), Oscillator::weights(), settings, MethodOptions{}));
      pointers_.push_back(solvers_.back().get());
    }
  }
  std::vector<Solver*>& all() { return pointers_; }

 private:
  std::deque<Oscillator> oscillators_;
  std::vector<std::unique_ptr<Solver>> solvers_;
  std::vector<Solver*> pointers_;
};

Settings at_times() {
  Settings settings = Oscillator::settings();
  settings.output_at_times = true;
  settings.times = Times(std::array{0.5, 3.0, 9.75, 20.0});
  return settings;
}

/// What the ensemble has of trajectory i is what a run of its own gives.
void check_row(const EnsembleResult& all, std::size_t i, const Method& method, const Rows& rows) {
  Oscillator alone;
  alone.p[0] = rows.p[i];
  alone.add_event(0);
  const Solver solver(method, alone.problem(), Oscillator::weights(), at_times(), {});
  Run run(solver);
  std::vector<double> y0(&rows.y0[2 * i], &rows.y0[2 * i] + 2);
  CHECK(run.prepare(0, y0.data()) == Consistency::consistent);
  if (run.integration().start(y0.data()) == State::running) run.integration().run();
  const RunResult one = run.take_result();
  CHECK(all.state[i] == static_cast<std::int8_t>(one.state) && all.t[i] == one.t_end);
  CHECK(same_bits(&all.y_end[2 * i], one.end(), 2));
  CHECK(std::ranges::equal(one.counted(), std::span(&all.count[i * EnsembleResult::counts], one.counted().size())));
  for (std::size_t j = 0; j < one.points.t.size(); ++j)
    for (std::size_t c = 0; c < 2; ++c)
      CHECK(same_bits(&all.y[(2 * i + c) * all.n_t + j], &one.points.y[2 * j + c], 1));
  std::vector<double> found;
  for (std::size_t k = 0; k < all.occurrences[0].trajectory.size(); ++k)
    if (all.occurrences[0].trajectory[k] == static_cast<std::int64_t>(i))
      found.push_back(all.occurrences[0].points.t[k]);
  CHECK(found == one.occurrences[0].t.copy());
}

}  // namespace

TEST(a_trajectory_is_the_single_run_to_the_bit_on_any_number_of_threads) {
  const Rows rows;
  for (const Method& method : general_methods())
    for (const std::size_t workers : {1, 2, 5, 8}) {
      const check::Case label(method.name, ", ", workers, " workers");
      Solvers solvers(method, workers, at_times(), 0);
      const auto all = integrate_all(solvers.all(), rows.ensemble(), go_on);
      CHECK(all != nullptr);
      for (std::size_t i = 0; i < Rows::size; ++i) {
        const check::Case row("row ", i);
        if (i == 5)
          CHECK(all->state[i] == EnsembleResult::not_finite && all->t[i] == 0);
        else
          check_row(*all, i, method, rows);
      }
    }
}

TEST(failures_are_told_and_the_others_are_not_touched) {
  const Rows rows;
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Solvers solvers(method, 3, at_times(), 0);
    const auto all = integrate_all(solvers.all(), rows.ensemble(), go_on);
    CHECK(all->failures.size() == 2);
    for (const EnsembleResult::Failure& failure : all->failures) {
      CHECK(failure.trajectory == 11 || failure.trajectory == 17);
      CHECK(failure.trajectory == 11
                ? failure.state == State::start_undefined
                : failure.state == State::invariant_refused || failure.state == State::invariant_convicted);
    }
    for (std::size_t i = 0; i < Rows::size; ++i)
      if (i != 5 && i != 11 && i != 17) {
        CHECK(all->state[i] == static_cast<std::int8_t>(State::reached_end));
        CHECK_CLOSE(energy(&all->y_end[2 * i]), all->value[i], 1e-3 * all->value[i]);
        CHECK(all->after[i] <= 1e-6);
      }
  }
}

TEST(terminal_events_end_trajectories_where_they_occur) {
  const Rows rows;
  Solvers solvers(*find_method("ode45"), 4, Oscillator::settings(), 3);
  const auto all = integrate_all(solvers.all(), rows.ensemble(), go_on);
  std::array<int, Rows::size> seen{};
  for (const std::int64_t i : all->occurrences[0].trajectory) ++seen[static_cast<std::size_t>(i)];
  for (std::size_t i = 0; i < Rows::size; ++i)
    if (i != 5 && i != 11 && i != 17) {
      CHECK(all->state[i] == static_cast<std::int8_t>(State::terminal_event) && seen[i] == 3);
      CHECK_CLOSE(all->y_end[2 * i], 0, 1e-8);
    }
}

TEST(a_cancelled_ensemble_has_the_trajectories_that_were_solved) {
  Rows rows;
  Settings longer = Oscillator::settings();
  longer.tf = 1e6;
  for (const std::size_t workers : {1, 4}) {
    Solvers solvers(*find_method("ode45"), workers, longer, 0);
    const auto all = integrate_all(solvers.all(), rows.ensemble(), [](std::uint32_t) { return false; });
    CHECK(std::ranges::count(all->state, EnsembleResult::unsolved) > 0);
    for (std::size_t i = 0; i < all->size; ++i)
      CHECK(all->state[i] == EnsembleResult::unsolved || all->t[i] == longer.tf);
  }
}

TEST(what_a_watch_throws_comes_out_when_all_threads_have_ended) {
  Rows rows;
  Settings longer = Oscillator::settings();
  longer.tf = 1e6;
  Solvers solvers(*find_method("ode45"), 4, longer, 0);
  bool thrown = false;
  try {
    (void)integrate_all(solvers.all(), rows.ensemble(),
                        [](std::uint32_t) -> bool { throw std::runtime_error("the watch"); });
  } catch (const std::runtime_error& error) {
    thrown = std::string(error.what()) == "the watch";
  }
  CHECK(thrown);
}

TEST(solvers_that_do_not_fit_the_rows_or_each_other_are_refused) {
  const Rows rows;
  const Method& method = *find_method("ode23");
  Solvers solvers(method, 2, Oscillator::settings(), 0), other(method, 1, at_times(), 0);
  const auto refused = [](const std::vector<Solver*>& solvers, const Ensemble& ensemble) {
    try {
      (void)integrate_all(solvers, ensemble, go_on);
    } catch (const std::invalid_argument&) {
      return true;
    }
    return false;
  };
  Ensemble ensemble = rows.ensemble();
  CHECK(!refused(solvers.all(), ensemble));
  CHECK(refused({}, ensemble));
  CHECK(refused({solvers.all()[0], other.all()[0]}, ensemble));
  CHECK(refused({solvers.all()[0], solvers.all()[0]}, ensemble));  // one block of parameters for two threads
  ensemble.n = 3;
  CHECK(refused(solvers.all(), ensemble));
  ensemble = rows.ensemble();
  ensemble.parameters = 0;
  CHECK(refused(solvers.all(), ensemble));
}

}  // namespace invariode::test_run::ensemble_laws
