// Every index is worked on once, whoever does it.

#include "run/threads.hpp"

#include <cmath>
#include <stdexcept>
#include <vector>

#include "check.hpp"

namespace invariode::test::threads_laws {

namespace {

constexpr std::chrono::milliseconds soon(1);
constexpr auto go_on = [](std::uint32_t) { return true; };

/// Takes so long that others have to help.
void toil(int rounds) {
  volatile double x = 1;
  for (int i = 0; i < rounds; ++i) x = std::sqrt(x + i);
}

/// Calls work(worker, index, cancelled) for each index.
template <class Work, class Watch>
bool for_each_index(std::uint32_t count, std::size_t workers, std::chrono::milliseconds interval, Work work,
                    Watch watch) {
  const auto one_by_one = [&](std::size_t worker, Queue& queue) {
    for (std::uint32_t index; queue.next(index); queue.finish_one()) work(worker, index, queue.cancelled());
  };
  return on_workers(count, workers, interval, one_by_one, watch);
}

}  // namespace

TEST(each_index_is_worked_on_once_with_any_number_of_workers_and_unequal_costs) {
  for (const std::size_t workers : {1, 2, 3, 7})
    for (const std::uint32_t count : {0u, 1u, 2u, 5u, 1000u}) {
      const check::Case label(workers, " workers, ", count, " indices");
      std::vector<std::atomic<int>> seen(count);
      const auto work = [&](std::size_t worker, std::uint32_t i, const std::atomic<bool>&) {
        CHECK(worker < workers);
        toil(i < 20 ? 20000 : 10);  // the first worker's share is the slow one
        ++seen[i];
      };
      CHECK(for_each_index(count, workers, soon, work, go_on));
      for (const std::atomic<int>& times : seen) CHECK(times == 1);
    }
}

TEST(the_watch_is_told_of_the_progress_and_cancels_the_rest) {
  std::atomic<std::uint32_t> worked = 0;
  std::uint32_t last = 0;
  const auto work = [&](std::size_t, std::uint32_t, const std::atomic<bool>&) {
    toil(20000);
    ++worked;
  };
  const auto watch = [&](std::uint32_t done) {
    CHECK(done >= last && done <= 100000);
    last = done;
    return done < 10;
  };
  CHECK(!for_each_index(100000, 2, soon, work, watch));
  CHECK(last >= 10 && last == worked && worked < 100000);
}

TEST(what_work_throws_cancels_the_rest_and_is_thrown_again) {
  std::atomic<std::uint32_t> worked = 0;
  const auto work = [&](std::size_t, std::uint32_t i, const std::atomic<bool>&) {
    toil(2000);
    ++worked;
    if (i == 7) throw std::runtime_error("seven");
  };
  bool thrown = false;
  try {
    (void)for_each_index(1000000, 3, soon, work, go_on);
  } catch (const std::runtime_error& error) {
    thrown = std::string(error.what()) == "seven";
  }
  CHECK(thrown && worked < 1000000);
}

TEST(the_first_of_several_exceptions_is_the_one_that_is_thrown) {
  std::atomic<bool> second_at_work = false;
  const auto work = [&](std::size_t, std::uint32_t i, const std::atomic<bool>& cancelled) {
    if (i == 0) {
      while (!second_at_work) std::this_thread::yield();
      throw std::runtime_error("first");
    }
    second_at_work = true;
    while (!cancelled) std::this_thread::yield();
    throw std::runtime_error("second");
  };
  std::string thrown;
  try {
    (void)for_each_index(2, 2, soon, work, go_on);
  } catch (const std::runtime_error& error) {
    thrown = error.what();
  }
  CHECK(thrown == "first");
}

TEST(what_watch_throws_is_thrown_again_when_the_threads_have_ended) {
  std::atomic<int> at_work = 0;
  const auto work = [&](std::size_t, std::uint32_t, const std::atomic<bool>& cancelled) {
    ++at_work;
    while (!cancelled) std::this_thread::yield();
    --at_work;
  };
  std::string thrown;
  try {
    (void)for_each_index(1000, 3, soon, work, [](std::uint32_t) -> bool { throw std::runtime_error("watch"); });
  } catch (const std::runtime_error& error) {
    thrown = error.what();
  }
  CHECK(thrown == "watch" && at_work == 0);
}

}  // namespace invariode::test::threads_laws
