#pragma once
// Mechanical systems as Python describes them, and the core's equations of motion made of them.

#include <nanobind/nanobind.h>

#include <cstddef>
#include <memory>
#include <string>
#include <vector>

#include "callables.hpp"
#include "mechanics/motion.hpp"

namespace nb = nanobind;

namespace invariode::binding {

/// One of the functions of (t, y) that a mechanical system has.
struct MotionPart {
  nb::object mechanics;  // a MechanicsTerms
  Motion::Part part;

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, mechanics); }
};

/// A motion in the keeping of the functions that it calls.
class OwnedMotion final : public Callable {
 public:
  OwnedMotion(nb::object mechanics, Functions& functions);

  [[nodiscard]] bool is_of(nb::handle mechanics) const { return mechanics_.is(mechanics); }
  [[nodiscard]] Motion& motion() { return *motion_; }
  int visit(visitproc visit, void* arg) const override { return visit_all(visit, arg, mechanics_); }

 private:
  nb::object mechanics_;
  std::unique_ptr<Motion> motion_;
};

/// The calls and factorisations of a motion, by name.
nb::dict to_dict(const MotionWork& work);

void define_mechanics(nb::module_& module);

}  // namespace invariode::binding
