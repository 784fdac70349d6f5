#pragma once
// Into the interpreter and out of it: which thread holds it, what becomes of one that asks for it when it has ended,
// and what threads may share.
//
// There is no global state: the registries are constants, and every solve makes a solver of its own, which one thread
// uses at a time. So the binding needs no lock of its own where the interpreter has none (free-threaded CPython, where
// "to hold it" only means that this thread is known to it), with three exceptions, each beside its code: an array is
// used again only if it is certain that no other thread can see it (`is_unique`), the list that a function returned is
// locked while it is read (`ListLock`), and a Stepper is locked during each of its calls.

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

/// Returns whether the caller's reference to an object is the only one, so that no other thread can take another.
inline bool is_unique(PyObject* one) {
#if PY_VERSION_HEX >= 0x030E0000
  return PyUnstable_Object_IsUniquelyReferenced(one) != 0;
#elif defined(Py_GIL_DISABLED)
  // Its two counts cannot be read at once: it has to be this thread's own.
  return _Py_IsOwnedByCurrentThread(one) != 0 && Py_REFCNT(one) == 1;
#else
  return Py_REFCNT(one) == 1;
#endif
}

/// Keeps other threads from changing a list while this one reads its items.
class ListLock {
 public:
#ifdef Py_GIL_DISABLED
  explicit ListLock(PyObject* list) { PyCriticalSection_Begin(&section_, list); }
  ~ListLock() { PyCriticalSection_End(&section_); }
#else
  explicit ListLock(PyObject*) {}
#endif
  ListLock(const ListLock&) = delete;
  ListLock& operator=(const ListLock&) = delete;

#ifdef Py_GIL_DISABLED
 private:
  PyCriticalSection section_;
#endif
};

/// Returns the value of act(), which may run Python code or ask for the interpreter.
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

/// Returns the value of act(), on a thread that does not hold the interpreter and needs it for this.
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
