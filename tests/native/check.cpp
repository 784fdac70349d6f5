// Runs the native tests: all of them, or those of the families or with the names on the command line.

#include "check.hpp"

int main(int count, char** names) {
  const auto named = [&](const std::string& name) {
    return std::find(names + 1, names + count, name) != names + count;
  };
  int passed = 0, failed = 0;
  for (const check::Test& test : check::tests) {
    if (count > 1 && !named(test.family) && !named(test.name)) continue;
    const int before = check::failures;
    const check::Case label(test.name);
    test.run();
    (check::failures == before ? passed : failed) += 1;
  }
  std::cout << passed << " passed, " << failed << " failed" << std::endl;
  return failed > 0 || passed == 0;
}
