// Between the first accepted step and the end the loop allocates nothing but stored output.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <new>
#include <optional>
#include <vector>

#include "check.hpp"
#include "linear/solve.hpp"
#include "linear/sparse_saddle.hpp"
#include "problems.hpp"

// Every malloc is counted, Eigen's and those of operator new: by AddressSanitizer's hooks, or by standing in front of
// glibc's functions. Elsewhere operator new alone is seen.
static std::atomic<std::int64_t> allocations{0};
/// The number of the allocation that fails; glibc's only.
static std::atomic<std::int64_t> failing{-1};

#if defined(__SANITIZE_ADDRESS__)
extern "C" int __sanitizer_install_malloc_and_free_hooks(void (*on_malloc)(const volatile void*, std::size_t),
                                                         void (*on_free)(const volatile void*));
static const int hooked = __sanitizer_install_malloc_and_free_hooks(
    [](const volatile void*, std::size_t) { ++allocations; }, [](const volatile void*) {});
#elif defined(__GLIBC__)
extern "C" {
void* __libc_malloc(std::size_t size);
void* __libc_calloc(std::size_t count, std::size_t size);
void* __libc_realloc(void* old, std::size_t size);
void* __libc_memalign(std::size_t alignment, std::size_t size);
void* malloc(std::size_t size) { return ++allocations == failing ? nullptr : __libc_malloc(size); }
void* calloc(std::size_t count, std::size_t size) { return ++allocations, __libc_calloc(count, size); }
void* realloc(void* old, std::size_t size) { return ++allocations, __libc_realloc(old, size); }
void* memalign(std::size_t alignment, std::size_t size) { return ++allocations, __libc_memalign(alignment, size); }
void* aligned_alloc(std::size_t alignment, std::size_t size) { return ++allocations, __libc_memalign(alignment, size); }
}
#else
void* operator new(std::size_t size) {
  ++allocations;
  if (void* p = std::malloc(size > 0 ? size : 1)) return p;
  throw std::bad_alloc();
}
void operator delete(void* p) noexcept { std::free(p); }
void operator delete(void* p, std::size_t) noexcept { std::free(p); }
#endif

using namespace invariode;
using namespace invariode::test;

namespace {

/// The search for jumps of f makes these vectors once, when attempts first fail one after the other: two points of the
/// series, weights and three points with f there, a point ahead and f, and the nine ends of eight parts with f there.
constexpr std::int64_t room_of_search = 2 + 1 + 3 * 2 + 2 + 1 + 9 * 2;
/// The judge of components that fall below 0 makes a point with f there, when the first one falls.
constexpr std::int64_t room_of_falls = 1;
/// radau makes its polynomial once, when a step is first looked at inside, and the two systems of each other order,
/// with matrix, factors and pivots of each, when it first takes one.
constexpr std::int64_t room_of_radau = 1 + 4 * 3;

/// The projector of values between steps allocates a point, its weights and J with the first value.
constexpr std::int64_t room_of_output = 3;

/// Events make room for points of a step as they are projected, and for a step that is scanned closely: its times and
/// values, and eight vectors of the separation of roots.
constexpr std::int64_t room_of_events = 1 + 2 + 8;

/// Allocations from the end of the first step to the end of the run, without that room.
std::int64_t allocations_of(Run& run) {
  CHECK(run.start() == State::running);
  CHECK(run->advance() == State::running);
  const std::int64_t before = allocations;
  CHECK(run->run() == State::reached_end);
  const std::int64_t after = allocations;
  CHECK(run->counts().steps > 20);
  return std::max(std::int64_t{0}, after - before - (run->counts().failed > 0 ? room_of_search : 0) -
                                       (run->evaluations_of_checks() > 0 ? room_of_falls : 0) -
                                       (run->step().parts_seen() > 0 ? room_of_radau : 0));
}

const Problem problems[] = {without_invariants(kepler(0.5)), lotka_volterra(), moving(), kepler(0.5),
                            with_redundant_invariant(rigid_body())};

template <class Look>
void for_runs(Look look) {
  for (const Method& method : methods_of_second_order())
    for (const Fsal fsal : {Fsal::reuse, Fsal::evaluate})
      for (const bool user_jacobian : {true, false})
        for (const Problem& problem : problems) {
          if (method.equations == Equations::second_order && problem.y0.size() != 4) continue;  // not one of these
          const check::Case label(method.name, ", ", problem.name, ", m = ", problem.m);
          look(method, problem, Options{.fsal = fsal, .user_jacobian = user_jacobian, .settings = {.save_all = false}});
        }
}

}  // namespace

TEST(allocations_are_counted) {
  const std::int64_t before = allocations;
  const std::vector<double> by_new(10);
  const Eigen::VectorXd by_eigen(10);
  CHECK(by_new.data() != by_eigen.data());
#if defined(__SANITIZE_ADDRESS__) || defined(__GLIBC__)
  CHECK(allocations == before + 2);
#else
  CHECK(allocations >= before + 1);
#endif
}

TEST(a_run_that_stores_nothing_allocates_nothing) {
  for_runs([](const Method& method, const Problem& problem, const Options& options) {
    Run run(method, problem, options);
    CHECK(allocations_of(run) == 0);
  });
}

#if !defined(__SANITIZE_ADDRESS__) && defined(__GLIBC__)
/// Makes each allocation by malloc in `work` fail in turn, and calls `after` each time. Returns how many there are of
/// all kinds.
template <class Work, class After>
std::int64_t with_failures(Work work, After after) {
  std::int64_t count = 0;
  for (bool reached = true; reached; count += reached ? 1 : 0) {
    failing = allocations + count + 1;
    (void)work();
    reached = allocations >= failing;
    failing = -1;
    after();
  }
  return count;
}

/// Whichever allocation fails, analysis or factorisation throws, and the same factors are right when they are made
/// again.
TEST(sparse_factors_outlive_a_failed_allocation) {
  constexpr int side = 8, n = side * side;
  Matrix J({.kind = Structure::Kind::sparse, .n = n});
  for (int j = 0; j < n; ++j) {
    for (int i = 0; i < n; ++i)
      if (std::abs(i / side - j / side) + std::abs(i % side - j % side) <= 1) J.rows.push_back(i);
    J.starts[static_cast<std::size_t>(j) + 1] = static_cast<int>(J.rows.size());
  }
  J.provide();
  J.for_each([](std::size_t i, std::size_t j, double& a) { a = i == j ? -4 : 1; });
  auto lu = make_factorization(J.structure, nullptr);
  const auto factored = [&] {
    try {
      return lu->factor(nullptr, 1, J);
    } catch (const std::bad_alloc&) {
      return false;
    }
  };
  const auto serves = [&] {
    CHECK(lu->factor(nullptr, 1, J));
    std::vector<double> x(n, 1), b(n);
    J.multiply(x.data(), b.data());
    for (int i = 0; i < n; ++i) b[static_cast<std::size_t>(i)] = 1 - b[static_cast<std::size_t>(i)];
    lu->solve(b.data());
    for (const double one : b) CHECK_CLOSE(one, 1, 1e-13);
    lu = make_factorization(J.structure, nullptr);
  };
  CHECK(with_failures(factored, serves) > 20);
}

/// A chain whose bodies turn each other: M is not diagonal, so that the whole is factored.
TEST(sparse_systems_of_mechanics_outlive_a_failed_allocation) {
  constexpr int n = 60, k = 20;
  std::vector<Eigen::Triplet<double>> mass, rows;
  for (int i = 0; i < n; ++i) {
    mass.emplace_back(i, i, 3.0);
    if (i > 0) mass.emplace_back(i, i - 1, 1.0), mass.emplace_back(i - 1, i, 1.0);
  }
  for (int i = 0; i < k; ++i) rows.emplace_back(i, 3 * i, 1.0), rows.emplace_back(i, (3 * i + 3) % n, -2.0);
  Eigen::SparseMatrix<double> M(n, n), A(k, n);
  M.setFromTriplets(mass.begin(), mass.end());
  A.setFromTriplets(rows.begin(), rows.end());
  const Eigen::VectorXd Q = Eigen::VectorXd::LinSpaced(n, 1, 2), gamma = Eigen::VectorXd::LinSpaced(k, -1, 1);
  std::optional<SparseSaddle> saddle(std::in_place);
  ConstrainedSolution found;
  const auto solved = [&] {
    try {
      return saddle->solve(M, A, Q, gamma, found);
    } catch (const std::bad_alloc&) {
      return false;
    }
  };
  const auto serves = [&] {
    CHECK(saddle->solve(M, A, Q, gamma, found));
    CHECK_CLOSE((M * found.a - A.transpose() * found.lambda - Q).cwiseAbs().maxCoeff(), 0, 1e-13);
    CHECK_CLOSE((A * found.a - gamma).cwiseAbs().maxCoeff(), 0, 1e-13);
    saddle.emplace();
    found = {};
  };
  CHECK(with_failures(solved, serves) > 50);
}

/// Equations in another order than their unknowns, (4, −1) x = 3 in each. Where there is no memory X is NaN. A thread
/// keeps factors of some patterns, so that each system has another than those before it.
TEST(traced_systems_outlive_a_failed_allocation) {
  constexpr std::int64_t k = 40;
  std::int64_t shift = 0, entries = 0;
  std::vector<std::int64_t> places;
  std::vector<double> numbers;
  const auto state = [&](bool another) {
    if (another) ++shift;
    places.clear();
    numbers.clear();
    for (std::int64_t i = 0; i < k; ++i) {
      const std::int64_t j = (i + shift) % k, other = (j + 3) % k;
      for (const std::int64_t column : {std::min(j, other), std::max(j, other)}) {
        places.push_back(i * k + column);
        numbers.push_back(column == j ? 4 : -1);
      }
    }
    entries = static_cast<std::int64_t>(places.size());
    numbers.resize(numbers.size() + static_cast<std::size_t>(k), 3);
  };
  const auto solved = [&] {
    solve_sparse_in_place(k, 1, entries, places.data(), numbers.data());
    return !std::isnan(numbers.back());
  };
  const auto serves = [&] {
    state(false);
    CHECK(solved());
    for (auto x = numbers.begin() + entries; x != numbers.end(); ++x) CHECK_CLOSE(*x, 1, 1e-13);
    state(true);
  };
  state(true);
  CHECK(with_failures(solved, serves) > 20);
}
#endif

TEST(watching_events_allocates_nothing) {
  // One event that happens and is stored, in room that is there, and one that does not.
  Function crosses = [](double t, const double*, double* e) { e[0] = std::cos(t); };
  Function never = [](double, const double*, double* e) { e[0] = 1; };
  for_runs([&](const Method& method, const Problem& problem, Options options) {
    options.events = {{as_callback(crosses)}, {as_callback(never), 1}};
    Run run(method, problem, options);
    run->output().occurrences[0].t.reserve(100);
    run->output().occurrences[0].y.reserve(400);
    CHECK(allocations_of(run) <= room_of_events + (problem.m > 0 ? room_of_output : 0));
    CHECK(run->output().occurrences[0].t.size() == 16);
  });
}

TEST(failed_attempts_allocate_nothing) {
  for_runs([](const Method& method, Problem problem, Options options) {
    const Function f = problem.f;
    int calls = 0;
    problem.f = [f, n = problem.y0.size(), &calls](double t, const double* y, double* out) {
      f(t, y, out);
      if (++calls % 100 == 0) out[n - 1] = NaN;
    };
    options.settings.check = false;  // as it would confirm with such an f
    Run run(method, problem, options);
    CHECK(allocations_of(run) == 0);
    CHECK(run->counts().failed > 3);
  });
}
