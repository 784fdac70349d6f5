#pragma once
// Into the interpreter and out of it: which thread holds it, and what becomes of one that asks for it when it has
// ended.

#include <nanobind/nanobind.h>

#include <cassert>

#if defined(__GLIBCXX__) && defined(__GLIBC__)
#include <cxxabi.h>

#include <chrono>
#include <thread>
#define INVARIODE_THREADS_UNWIND
#endif

namespace nb = nanobind;

namespace invariode::binding {

/// What act() gives, which may run Python code or ask for the interpreter.
///
/// When the interpreter ends, Python up to 3.13 ends each daemon thread that asks for it, by pthread_exit. With glibc
/// that unwinds the stack like an exception, through the core, where nothing may throw: the process would abort. Such a
/// thread stays here until the process is gone, as in Python from 3.14 on.
template <class Act>
auto in_python(Act act) {
#ifdef INVARIODE_THREADS_UNWIND
  try {
    return act();
  } catch (abi::__forced_unwind&) {
    for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
  }
#else
  return act();
#endif
}

/// What act() gives, on a thread that does not hold the interpreter and needs it for this.
template <class Act>
auto holding_interpreter(Act act) {
  struct Held {  // nanobind's is declared not to throw
    PyGILState_STATE state = PyGILState_Ensure();
    Held() = default;
    Held(const Held&) = delete;
    Held& operator=(const Held&) = delete;
    ~Held() { PyGILState_Release(state); }
  };
  return in_python([&] {
    const Held held;
    return act();
  });
}

/// Lets other threads run the interpreter where nothing here needs it.
class Unlocked {
 public:
  explicit Unlocked(bool possible = true) : state_(possible ? PyEval_SaveThread() : nullptr) {}
  Unlocked(const Unlocked&) = delete;
  Unlocked& operator=(const Unlocked&) = delete;
  ~Unlocked() {
    assert(state_ == nullptr || PyGILState_Check() == 0);
    if (state_ != nullptr) in_python([&] { PyEval_RestoreThread(state_); });
  }

 private:
  PyThreadState* state_;
};

}  // namespace invariode::binding
