#pragma once
// The harness of the native tests (check.cpp has its main): a TEST states one law; CHECK and CHECK_CLOSE tell where and
// how it fails.

#include <algorithm>
#include <cmath>
#include <iostream>
#include <sstream>
#include <string>
#include <string_view>
#include <vector>

namespace check {

struct Test {
  std::string family;  // the file that states it
  std::string name;
  void (*run)();
};
inline std::vector<Test> tests;
inline std::vector<std::string> cases;  // what the running test is looking at, outermost first
inline int failures = 0;

inline std::string stem(std::string_view file) {
  file.remove_prefix(file.find_last_of("/\\") + 1);
  return std::string(file.substr(0, file.rfind('.')));
}

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

#define TEST(name)                                                                                       \
  static void name();                                                                                    \
  static const bool name##_added = (check::tests.push_back({check::stem(__FILE__), #name, name}), true); \
  static void name()
#define CHECK(...) ((__VA_ARGS__) ? void() : check::fail(__FILE__, __LINE__, #__VA_ARGS__))
#define CHECK_CLOSE(a, b, tol) check::close(a, b, tol, __FILE__, __LINE__, #a " ~ " #b)
