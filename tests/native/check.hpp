#pragma once
// The harness of the native tests: a TEST states one law; CHECK and CHECK_CLOSE tell where and how it fails.

#include <algorithm>
#include <cmath>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

namespace check {

struct Test {
  std::string name;
  void (*run)();
};
inline std::vector<Test> tests;
inline std::vector<std::string> cases;  // what the running test is looking at, outermost first
inline int failures = 0;

/// Names what a test is looking at, in the messages of failures, as long as it lives.
struct Case {
  explicit Case(const auto&... parts) { cases.push_back((std::ostringstream() << ... << parts).str()); }
  Case(const Case&) = delete;
  ~Case() { cases.pop_back(); }
};

inline void fail(const char* file, int line, const auto&... parts) {
  ++failures;
  std::cout << file << ":" << line << ": ";
  (std::cout << ... << parts);
  for (const std::string& c : cases) std::cout << " | " << c;
  std::cout << "\n";
}

inline void close(double a, double b, double tol, const char* file, int line, const char* what) {
  if (!(std::abs(a - b) <= tol)) fail(file, line, what, ": ", a, " and ", b, " differ by ", a - b, ", more than ", tol);
}

}  // namespace check

#define TEST(name)                                                                \
  static void name();                                                             \
  static const bool name##_added = (check::tests.push_back({#name, name}), true); \
  static void name()
#define CHECK(...) ((__VA_ARGS__) ? void() : check::fail(__FILE__, __LINE__, #__VA_ARGS__))
#define CHECK_CLOSE(a, b, tol) check::close(a, b, tol, __FILE__, __LINE__, #a " ~ " #b)

int main(int count, char** names) {
  int passed = 0, failed = 0;
  for (const check::Test& test : check::tests) {
    if (count > 1 && std::find(names + 1, names + count, test.name) == names + count) continue;
    const int before = check::failures;
    const check::Case label(test.name);
    test.run();
    (check::failures == before ? passed : failed) += 1;
  }
  std::cout << passed << " passed, " << failed << " failed" << std::endl;
  return failed > 0 || passed == 0;
}
