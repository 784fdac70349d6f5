// Where the Jacobian was taken, when it is renewed, and which factors serve; when an iteration has converged.

#include "methods/jacobian_age.hpp"

#include "check.hpp"
#include "methods/factor_cache.hpp"
#include "methods/newton.hpp"

namespace invariode::test::jacobian_age_laws {

using Taken = JacobianAge::Taken;

TEST(a_jacobian_of_an_earlier_step_is_renewed_after_a_failure_and_one_of_this_point_is_not) {
  JacobianAge age;
  age.take();
  CHECK(age.taken() == Taken::here && age.current() && !age.plain());
  CHECK(!age.fail(true, true) && !age.renewal_due());
  for (int steps = 1; steps <= 3; ++steps) {
    age.accept_step();
    CHECK(!age.current() && age.steps() == steps);
  }
  CHECK(!age.fail(false, false) && !age.renewal_due());  // a constant one
  CHECK(age.fail(true, false) && age.renewal_due());
  age.take();
  CHECK(!age.renewal_due() && age.steps() == 0);
}

TEST(one_that_is_much_too_large_is_taken_plainly_once_if_its_increments_were_adapted) {
  for (const bool adapted : {false, true}) {
    const check::Case label("adapted = ", adapted);
    JacobianAge age;
    age.take();
    CHECK(!age.fail(true, adapted));
    age.note_too_large();
    CHECK(age.fail(true, adapted) == adapted && age.plain() == adapted);
    if (!age.plain()) continue;
    age.take();
    CHECK(age.taken() == Taken::plainly);
    age.note_too_large();
    CHECK(!age.fail(true, adapted));  // it will not be better
    age.accept_step();
    age.take();
    CHECK(age.taken() == Taken::here);
  }
}

TEST(a_step_has_one_jacobian_of_an_iterate_which_is_renewed_with_shorter_steps) {
  JacobianAge age;
  age.begin_at_iterate();
  age.take();
  CHECK(age.taken() == Taken::at_iterate && age.plain());
  age.take();
  CHECK(age.taken() == Taken::at_iterate);
  CHECK(!age.fail(true, false) && age.renewal_due());
  CHECK(age.taken() == Taken::plainly);
  age.accept_step();
  CHECK(age.taken() == Taken::earlier && age.renewal_due());  // asked for all the same
  age.start();
  CHECK(!age.renewal_due());
}

TEST(factors_serve_for_a_c_within_the_tolerated_part) {
  FactorCache cache;
  CHECK(!cache.serves(2, 0) && cache.first_c() == 2);
  cache.made(-2, 1);
  CHECK(cache.serves(-2, 0) && cache.t() == 1);
  CHECK(cache.serves(-2.5, 0.3));
  CHECK(!cache.serves(-3, 0.3) && !cache.holds() && cache.first_c() == 2);
  cache.forget_jacobian();
  CHECK(!cache.first_c());
}

TEST(an_update_below_the_goal_of_jumps_that_has_not_shrunk_goes_on_and_a_larger_one_diverges) {
  using Verdict = Convergence::Verdict;
  for (const double jump_goal : {0.0, 0.1}) {
    const check::Case label("jump_goal = ", jump_goal);
    Convergence convergence({.most_iterations = 7, .goal = 0.01, .first_goal = 0.1, .jump_goal = jump_goal});
    convergence.begin(1);
    CHECK(convergence.judge(0.05, 0) == Verdict::go_on);
    CHECK(convergence.judge(0.06, 0) == (jump_goal > 0 ? Verdict::go_on : Verdict::diverged));
    CHECK(!convergence.rate_known());  // f may jump between the iterates: their updates say nothing of the rate
    convergence.begin(1);
    CHECK(convergence.judge(0.5, 0) == Verdict::go_on);
    CHECK(convergence.judge(0.6, 0) == Verdict::diverged);
  }
}

}  // namespace invariode::test::jacobian_age_laws
