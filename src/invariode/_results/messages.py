"""Messages about how a run ended: the cause, at which t and h, and what to try."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from .._base.arguments import EPS
from .._core import Run
from .._problem.bounds import Bounds
from .._problem.core_problem import LinearTerms

#: The most times that a message lists.
_TIMES = 4

#: Runs that do not fail: status and message, SciPy's if it has them.
MESSAGES = {
    "reached_end": (0, "The solver successfully reached the end of the integration interval."),
    "terminal_event": (1, "A termination event occurred."),
    "running": (-3, "This is a checkpoint of an unfinished run. Continue it with Solution.extend."),
    "stopped_by_callback": (2, "The callback stopped the integration."),
}

_LIMITS = {
    "steps": ("max_steps = {0} is reached", "give a larger max_steps, or looser tolerances"),
    "time": ("The limit of {0:g} s is over", "give a larger Limits(time=), or looser tolerances"),
    "points": (
        "{0} points are kept, the most that the limits allow",
        "give a larger Limits(points=), or keep fewer: t_eval or keep='end'",
    ),
    "memory": (
        "What is kept fills {0} bytes, the most that the limits allow",
        "give a larger Limits(bytes=), or keep less: t_eval or keep='end'",
    ),
    "sticking": (
        "The solution sticks where fun jumps, and steps are so short that a run without limits ends here",
        "make the jump a steep but continuous function, or set max_steps, up to which a run goes on in any case",
    ),
}


class LawNames(NamedTuple):
    """The invariants of a run: names, whether values were demanded, and which may only fall (-1) or rise (1)."""

    names: list[str]
    demanded: list[bool]
    senses: list[int]


class Stated(NamedTuple):
    """Properties of the problem that the user has stated: messages advise to change only these."""

    events: list[str]  # names
    labels: Sequence[str] | None  # of components
    jac: bool  # a function or a matrix
    pattern: bool  # jac_sparsity, or the bands
    mass: bool
    pairs: bool  # whether states are complex: pairs of reals for the core


def status_and_message(run: Run, laws: LawNames, stated: Stated) -> tuple[int, str]:
    """Return the status of the Solution and its message."""
    status, message = MESSAGES.get(run.state) or _ended(run, laws, stated)
    return status, remarked(message, run, stated.events)


def remarked(message: str, run: Run, events: Sequence[str]) -> str:
    """Return the message with remarks on stiffness, discontinuities and accumulating events added."""
    if run.stiff:
        message += f" {_sentence(limited_by_stability(run.stiff_since))}"
    texts = [about_jumps_of_fun(run)]
    if run.accumulation is not None:
        event, t, interval, count = run.accumulation
        texts.append(accumulating(events[event], t, interval, count))
    for text in [text for text in texts if text]:
        message += f" {_sentence(text)}"
    return message


def about_jumps_of_fun(run: Run) -> str:
    """Return the warning about jumps of f: the solution sticks where f jumps, or they make attempts fail. Empty: none
    does."""
    if (since := run.sticks_since) is not None:
        return sticking(since)
    return discontinuous(run.discontinuities) if run.discontinuities else ""


def limited_by_stability(since: float) -> str:
    """Return the warning about an explicit method on a stiff problem."""
    return f"since t = {since:.6g} most steps are limited by stability, not by accuracy; try ode15s"


def discontinuous(times: Sequence[float]) -> str:
    """Return the warning about a right-hand side that jumps."""
    listed = ", ".join(repr(t).removesuffix(".0") for t in times[:_TIMES])  # as they work in breakpoints=
    more = f" and at {len(times) - _TIMES} or more other times (stats.discontinuities)" * (len(times) > _TIMES)
    return (
        f"fun looks discontinuous at t = {listed}{more}, where steps were rejected; pass breakpoints=[{listed}"
        f"{', ...' * (len(times) > _TIMES)}], or, if the time of the jump depends on y, an event with an action"
    )


def sticking(since: float) -> str:
    """Return the warning about a solution that stays where the right-hand side jumps."""
    return (
        f"from t = {since:.6g} on the solution sticks where fun jumps, as with dry friction, and steps become tiny; "
        "make the jump a steep but continuous function, such as tanh(v / v_s) for sign(v), or describe sticking as a "
        "state of its own that events with actions begin and end"
    )


def accumulating(event: str, t: float, interval: float, count: int) -> str:
    """Return the warning about an event whose actions accumulate."""
    return (
        f"{event}: its actions came closer and closer, {count} of them until t = {t:.12g} with {interval:.2g} between "
        f"the last two, and then the solution passed it without one: infinitely many would follow (Zeno), and what "
        f"comes after that t is wrong; {_INSTEAD_OF_ACCUMULATING}"
    )


def accumulating_in(trajectories: int) -> str:
    """Return the warning about events whose actions accumulate, for so many trajectories of an ensemble."""
    return (
        f"in {trajectories} trajectories the actions of an event came closer and closer, and then the solution passed "
        "it without one: infinitely many would follow (Zeno), and what comes after stats['accumulation'], the time of "
        f"the last action, is wrong; {_INSTEAD_OF_ACCUMULATING}"
    )


#: What to do about events that accumulate.
_INSTEAD_OF_ACCUMULATING = (
    "end the run there with a terminal event, or let the action put the system to rest, with a fun that keeps it there"
)


#: What is said of a singularity of an f without a mass matrix, and of a mechanism instead.
_ALGEBRAIC = " If an entry of fun is an algebraic equation, 0 = g(t, y), pass mass=."
OF_MECHANISM = (
    " If constraints become dependent there, this is a dead or locking position, beyond which the mechanism cannot "
    "move as its constraints prescribe."
)


def blamed_on(name: str, message: str, singular: str = "") -> str:
    """Return a message about fun as one about the function from which fun was made, which has no mass=. `singular`:
    what is said of a singularity instead."""
    message = message.replace(_ALGEBRAIC, singular)
    return re.sub(r"\bfun\b", name, re.sub(r" of fun\b", f" of y' (by {name})", message))


def _capitalized(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"


def _sentence(text: str) -> str:
    return f"{_capitalized(text)}."


def _ended(run: Run, laws: LawNames, stated: Stated) -> tuple[int, str]:
    pairs, labels = stated.pairs, stated.labels
    if run.state == "stopped_by_request":
        return 2, f"Ctrl-C stopped the integration at t = {run.t!r}."
    if run.state == "invariant_convicted":
        return -2, _convicted(run, laws, pairs)
    if run.state == "start_undefined" and run.singular:
        return -1, (
            f"The mass matrix is singular at the start, t = {run.t}: there is no unique slope y'. Try a mass matrix "
            "that is regular there, or differentiate the constraints until the slopes are determined."
        )
    if run.state == "start_undefined" and run.coefficient is not None:
        return -1, f"{_without_series(run, pairs)} at the start, t = {run.t}. {_OTHER_METHODS}"
    if run.state == "start_undefined":
        return -1, (
            f"fun is not finite at the start, t = {run.t}: {_component(run, pairs, labels)} is NaN or infinite. "
            "Correct fun or y0."
        )
    if run.state == "action_out_of_bounds":
        return -1, (
            f"After the action at t = {run.t:.6g} {_component(run, pairs, labels)} is outside its bounds by "
            "more than the tolerance. Let the action return a point within them."
        )
    if run.state == "restart_inconsistent":
        return -1, (
            f"No consistent values of the algebraic variables were found after the breakpoint or action at t = "
            f"{run.t!r}. Give it an action that returns a state near the consistent one."
        )
    if run.state == "marks_endless":
        return -3, (
            f"Delays bring discontinuities of derivatives to more than 10000 times after t = {run.t!r}: a method of "
            "lower order follows fewer of them."
        )
    return -1, _step_failed(run, laws.names, stated)


def out_of_bounds(what: str, component: int, bounds: Bounds | None, labels: Sequence[str] | None = None) -> str:
    """Return the text of the ValueError for a start that is outside its bounds."""
    within = "" if bounds is None else f", {bounds.lower[component]} to {bounds.upper[component]},"
    name = component if labels is None else labels[component]
    return f"{what}[{name}] is outside its bounds{within} by more than the tolerance: correct it, or the bounds"


def limit_reached(run: Run, limit: float | None, t0: float, tf: float) -> str:
    """Return the message about a limit of this value: where it was reached, how fast the run was, and what to try."""
    what, advice = _LIMITS[run.limit]
    text = f"{what.format(limit)} at t = {run.t!r}: "
    if math.isfinite(tf):
        text += f"{(run.t - t0) / (tf - t0):.2%} of the interval, "
    text += f"after {run.steps_to_limit} steps and {run.seconds_to_limit:.3g} s. The next step is of size {run.h:.3g}"
    if math.isfinite(tf) and run.h > 0:
        text += f"; the rest takes {abs(tf - run.t) / run.h:.2g} steps of this size"
    return f"{text}. All results so far are kept. To get further, {advice}; or extend the solution from here."


def _component(run: Run, pairs: bool, labels: Sequence[str] | None = None) -> str:
    """Return the component that a run names, with its label if the problem has labels."""
    i = run.component // 2 if pairs else run.component
    return f"component {i} ({labels[i]})" if labels is not None and 0 <= i < len(labels) else f"component {i}"


#: What to do where there is no Taylor series.
_OTHER_METHODS = "Use a method that evaluates fun only, dop853 or ode89, there, or all along."


def _without_series(run: Run, pairs: bool) -> str:
    return (
        f"{_component(run, pairs).capitalize()} of y has no Taylor series: its coefficient {run.coefficient} is NaN or "
        "infinite, although fun is finite (as √y and y**1.5 are at y = 0),"
    )


#: What is said of a step longer than a delay.
_OVERLAP = (
    "The step does not agree with its own delayed values, however short it is: try radau, or a max_step below the "
    "shortest delay"
)


def _step_failed(run: Run, names: list[str], stated: Stated) -> str:
    pairs, labels = stated.pairs, stated.labels
    if run.cause == "spacing":
        return (
            f"fun changes within {abs(run.h):.2g} of t = {run.t!r}, but times near {run.t:.6g} are "
            f"{math.ulp(run.t):.2g} apart: measure t from {run.t:.6g}, so that the start is at t = 0. If fun should "
            "not change so fast, check its units and y0."
        )
    if run.cause == "overlap":
        return f"{_OVERLAP} (t = {run.t!r})."
    where = f"at t = {run.t!r}, where the smallest step allowed is {abs(run.h):.6e}"
    if run.cause == "not_finite" and run.coefficient is not None:
        return f"{_without_series(run, pairs)} {where}. {_OTHER_METHODS}"
    if run.cause == "not_finite":
        what = _component(run, pairs, labels) + " of fun is" if run.component >= 0 else "the solution becomes"
        advice = _singular(run, stated) or (
            "If the exact solution does not go there, reduce rtol and atol; if it does, stop the run earlier with a "
            "terminal event."
        )
        return f"{what} NaN or infinite even with the smallest step, {where}. {advice}"
    if run.cause == "newton" and run.unsolved in _UNDEFINED:
        return f"{_UNDEFINED[run.unsolved].format(run.unsolved_t)} The run ends at t = {run.t!r}."
    jumps = run.sticks_since is not None or any((t - run.t) * run.h > 0 for t in run.discontinuities)
    if run.cause == "newton":
        what = _newton_failed(run, pairs)
        if what == _NEWTON_DIVERGED and jumps:  # what comes after the message says why
            return f"{what}, {where}."
        doubt = f" {_IN_DOUBT[stated.jac]}" if stated.jac or stated.pattern else ""
        advice = _singular(run, stated) or "Try a smaller rtol, or stop the solution earlier with a terminal event."
        return f"{what}, {where}.{doubt} {advice}"
    if run.cause == "bounds":
        return (
            f"{_capitalized(_component(run, pairs, labels))} of y leaves its bounds by more than the tolerance even "
            f"with the smallest step, {where}: fun drives it out. Check the equations at the bound, or give it an "
            "atol > 0."
        )
    if run.cause == "projection":
        return _projection_failed(run, names, where)
    text = f"Unable to meet the tolerances without reducing the step below its smallest size, {where}."
    if jumps:
        return text
    if run.pure_relative:
        return (
            f"{text} {_capitalized(_component(run, pairs, labels))} of y is 0 and its atol is 0: pure relative error "
            "control is impossible there. Give an atol > 0."
        )
    advice = _singular(run, stated) or (
        "The solution may have a singularity there, or fun may jump: try another rtol, stop earlier with a terminal "
        "event, or give the jumps of fun as breakpoints."
    )
    return f"{text} {advice}"


def _projection_failed(run: Run, names: list[str], where: str) -> str:
    if run.finding == "undefined":
        return (
            f"Invariant {names[run.finding_invariant]}, or its Jacobian, is not defined where the solution goes, even "
            f"with the smallest step, {where}. If the solution should not get there, try a smaller atol for the "
            "components that come close (or a smaller rtol); if it should, stop it earlier with a terminal event."
        )
    return (
        f"The projection onto the invariants fails even with the smallest step, {where}: "
        "the tolerance is too loose, or the invariants are nearly singular here. Try a smaller rtol, or fewer "
        "invariants; at a singular position, as where bars line up, another method or a larger rtol, whose steps "
        "pass over it."
    )


def _singular(run: Run, stated: Stated) -> str:
    """Return where the solution goes that the smallest step fails, as far as it is known, and what to do; else ''."""
    if run.undefined_below_zero is not None and not stated.pairs:
        i, y, _ = run.undefined_below_zero
        return (
            f"y[{i}], {y:.3g} there, passes 0, and fun is not finite for y[{i}] < 0. If the exact solution stays "
            f"nonnegative, pass nonnegative=[{i}]; if it does not, stop it before that with a terminal event."
        )
    if run.fastest is None:
        return ""
    i, y, slope = run.fastest
    algebraic = "" if stated.mass else _ALGEBRAIC
    i = i // 2 if stated.pairs else i
    label = "" if stated.labels is None else f" ({stated.labels[i]})"
    return (
        f"y[{i}]{label}, {y:.3g} there, changes at the rate {slope:.3g}: the solution seems to "
        f"have a singularity. Stop it earlier with a terminal event, or check signs, units and parameters of "
        f"fun.{algebraic}"
    )


#: What users' functions return to GMRES that it cannot use, and what to try; with the t of these functions.
_UNDEFINED = {
    "product": (
        "The product of the Jacobian of fun with a vector, by jac_product or jac, is NaN or infinite at t = {0!r}, and "
        "with shorter steps too. Correct that function, or leave it out: products are then differences of fun."
    ),
    "difference": (
        "Differences of fun for products of its Jacobian with vectors are NaN or infinite at t = {0!r}, and with "
        "shorter steps too: fun is not defined all around the solution. Give GMRES(jac_product=), or jac."
    ),
    "preconditioner": (
        "The preconditioner set up at t = {0!r} returns NaN or infinity, and with shorter steps too. Correct it, or "
        "leave it out."
    ),
    "preconditioner_zero": (
        "The preconditioner set up at t = {0!r} returns 0 for a b that is not 0, so GMRES cannot solve the linear "
        "systems. It has to return x of (M - c J) x = b, approximately: correct it, or leave it out."
    ),
}

#: What may be wrong if Newton's iteration fails: the Jacobian or its pattern, by whether the user gave a Jacobian.
_IN_DOUBT = {
    True: "A wrong jac may be the cause: check it, or leave it out.",
    False: "A jac_sparsity or band that misses entries may be the cause: check it, or leave it out.",
}

_NEWTON_DIVERGED = "Newton's iteration does not converge even with the smallest step"


def _newton_failed(run: Run, pairs: bool) -> str:
    if run.undefined_mass:
        return "The mass matrix becomes NaN or infinite, even with the smallest step"
    if run.undefined_jacobian:
        return "The Jacobian of fun is NaN or infinite, even with the smallest step"
    if run.singular:
        return "The iteration matrix M - h c J is singular even with the smallest step"
    if run.unsolved == "slow":
        return (
            "GMRES does not solve the linear systems of Newton's iteration even with the smallest step (give a better "
            "preconditioner, or a larger GMRES(dimension=))"
        )
    if run.component >= 0:
        return f"{_component(run, pairs)} of fun is NaN or infinite in Newton's iteration even with the smallest step"
    return _NEWTON_DIVERGED


def inconsistent_start(verdict: str, t0: float) -> str:
    """Return the text of the ValueError for a start that does not satisfy the algebraic equations."""
    if verdict == "index_too_high":
        return (
            f"the equations with this mass matrix do not form a differential-algebraic system of index 1 at t = {t0}: "
            "the algebraic equations do not determine the components that mass leaves free. solve_dae, which takes the "
            "equations as F(t, y, y') = 0, differentiates constraints until they do"
        )
    if verdict == "undetermined":
        return (
            f"at t = {t0} the algebraic equations of the singular mass matrix do not seem to determine the components "
            "that mass leaves free: no change of them that was tried changes these equations as it should. Differences "
            "of fun do not prove that: pass jac=, a function or 'trace', with which index and start are certain"
        )
    return (
        f"y0 does not satisfy the algebraic equations of the singular mass matrix at t = {t0}, and no consistent "
        "values were found near it: give a y0 for which the algebraic components of fun are zero"
    )


def _convicted(run: Run, laws: LawNames, pairs: bool) -> str:
    names = laws.names
    if run.finding == "off_value" and laws.senses[run.finding_invariant]:
        return (
            f"The action at t = {run.finding_t:.6g} takes {names[run.finding_invariant]} back by "
            f"{abs(run.finding_size):.6g}, {run.finding_distance:.3g} times the tolerance, which Dissipated does "
            "not allow. "
            "Correct the action, or give the event rehold=True."
        )
    if run.finding == "off_value":
        return (
            f"After the action at t = {run.finding_t:.6g} the solution violates invariant "
            f"{names[run.finding_invariant]}: g - value = {run.finding_size:.6g}, a distance of "
            f"{run.finding_distance:.3g} times the tolerance. Let the action return a point of the manifold, or give "
            "the event rehold=True."
        )
    if run.finding == "jumps_off":
        return (
            f"At the breakpoint t = {run.finding_t:.6g} invariant {names[run.finding_invariant]} jumps, and the "
            f"solution violates it: g - value = {run.finding_size:.6g}, a distance of {run.finding_distance:.3g} times "
            "the tolerance. Give the breakpoint an action that returns a point of the manifold, (t, action), or leave "
            "out value= to hold the invariant at what it is from there on."
        )
    if run.finding == "undefined":
        return (
            f"Invariant {names[run.finding_invariant]} is not finite after the action at t = {run.finding_t:.6g}. Let "
            "the action return a point where it is finite."
        )
    if run.finding == "wrong_jacobian":
        text = _wrong_jacobian_of(run, names, pairs)
        return text[0].upper() + text[1:]
    if run.finding == "held":
        return (
            f"Invariant {names[run.finding_invariant]} is contradicted by the bound of y[{run.finding_component}]: at "
            f"t = {run.finding_t:.6g} fun leads that component out of its bound, where it is held, and the invariant "
            f"changes at the rate {run.finding_size:.6g} because of that; projection has taken "
            f"{run.finding_distance:.3g} tolerances from other components instead. Correct fun, so that "
            "it does not lead there from the bound, or leave out the bound or the invariant; check=False "
            "switches this test off."
        )
    return _not_conserved(run, laws)


def _not_conserved(run: Run, laws: LawNames) -> str:
    names, demanded = laws.names, laws.demanded
    if sense := laws.senses[run.finding_invariant]:
        return (
            f"{names[run.finding_invariant]} is not dissipated by fun: at t = {run.finding_t:.6g} it "
            f"{'rises' if sense < 0 else 'falls'} at the rate {abs(run.finding_size):.6g} "
            f"({run.finding_distance:.1e} of the size of its terms), and Dissipated(rises={sense > 0}) excludes that. "
            "Check its formula, its sign and the parameters; a system with external driving need not satisfy this. "
            "check=False switches this test off."
        )
    text = (
        f"Invariant {names[run.finding_invariant]} is not conserved by fun: at t = {run.finding_t:.6g}, on the "
        f"manifold, it changes at the rate {run.finding_size:.6g}, {run.finding_distance:.1e} of the size of its "
        "terms; the terms of a conserved quantity cancel to about 1e-16. "
    )
    if demanded[run.finding_invariant]:
        text += (
            "A hidden constraint is missing: impose the derivative of this constraint with respect to t "
            "with it; or the formula is wrong, or not smooth there, like abs at 0. "
        )
    else:
        text += (
            "Check its formula and the parameters; a quantity that friction diminishes is a Dissipated one, and an "
            "applied force or a source changes its own share. "
        )
    return text + "check=False switches this test off."


def _wrong_jacobian_of(run: Run, names: list[str], pairs: bool) -> str:
    name, component = names[run.finding_invariant], run.finding_component
    text = wrong_jacobian(name, run.finding_t, component, run.finding_size, run.finding_distance, pairs)
    return text + " check=False switches this test off."


def wrong_jacobian(name: str, t: float, component: int, entry: float, quotient: float, pairs: bool) -> str:
    """Return the message about a wrong Jacobian of an invariant. `component`: an index into the reals that make up
    y."""
    part = (" (real part)", " (imaginary part)")[component % 2] if pairs else ""
    column = component // 2 if pairs else component
    return (
        f"the Jacobian of invariant {name} is wrong at t = {t:.6g}: its entry for y[{column}]{part} is {entry:.9g}, "
        f"differences of the invariant give {quotient:.9g} (good to about {EPS ** (2 / 3):.0e})."
    )


def refusal(run: Run, laws: LawNames, rtol: float, pairs: bool) -> str:
    """Return the message of the InvariantError raised at the start of a run."""
    names = laws.names
    name = names[run.finding_invariant]
    if run.finding == "off_value":
        return (
            f"y0 is not on the manifold: it violates invariant {name}, g(t0, y0) - value = {run.finding_size:.6g}, a "
            f"distance of {run.finding_distance:.3g} times the tolerance (rtol = {rtol:.3g}). Correct y0, or project "
            "it first: y0 = invariode.impose(invariants, t0, y0).y, or for a MechanicalSystem problem(..., "
            'consistent="project")'
        )
    if run.finding == "wrong_jacobian":
        return _wrong_jacobian_of(run, names, pairs)
    if run.finding == "undefined":
        return f"invariant {name}, or its Jacobian, is not finite at the start, t = {run.finding_t:.6g}"
    return _not_conserved(run, laws)


_FORMED = {"function": "given", "derived": "traced", "complex-step": "complex step"}


def formed(linear: LinearTerms | None, run: Run) -> str | None:
    """Return how the Jacobian of f was computed, in words; None if the method uses no Jacobian."""
    if linear is None:
        return None
    text = _FORMED.get(linear.kind, linear.kind)
    if not math.isnan(run.left_complex_steps):
        text += f", differences from t = {run.left_complex_steps:.6g} on"
    if linear.found_pattern:
        entries, groups = run.pattern
        text += f"; detected pattern: {entries} entries, {groups} evaluations of f each"
        text += f" ({linear.found_pattern} found it{f', enlarged {run.enlargements} times' * (run.enlargements > 0)})"
    return text


def complex_steps_left(t: float) -> str:
    """Return the text of a warning: complex steps were chosen, and f did not take them."""
    return (
        f'jac="complex-step": at t = {t:.6g} fun is not finite for complex y, or drops its imaginary part; differences '
        "are used from there on. Write fun without abs, real, conj, norms and rounding of y, or use "
        'jac="differences"'
    )


def misfit(found: tuple[str, float, int, int, int, int, float, float], pairs: bool) -> str:
    """Return the text of a warning: what was said about the Jacobian contradicts fun."""
    kind, t, row, column, lower, upper, change, predicted = found
    reals = 2 if pairs else 1
    i, j = row // reals, column // reals
    if kind == "matrix":
        return (
            f"jac does not fit fun at t = {t:.6g}: within the tolerances of y component {i} of fun changes by "
            f"{change:.3g}, and jac says {predicted:.3g}. Steps are short then, and ode23s is inaccurate. "
            'Correct jac (jac="differences" does without it)'
        )
    entry = f"at t = {t:.6g} component {i} of fun changes with y[{j}]"
    if kind == "pattern":
        return f"jac_sparsity misses the entry ({i}, {j}): {entry}. It is used with what was found; add the entry"
    bands = f"give jac=Banded({-(-lower // reals)}, {-(-upper // reals)}), or these as lband and uband"
    cure = bands if lower or upper else "fun mixes nearly all components, so leave the bands out"
    return (
        f"the bands of the Jacobian miss the entry ({i}, {j}): {entry}. The entries in the bands are right, but take "
        f"more evaluations of fun, and steps may be short; {cure}"
    )


def below_zero(components: str, indices: Sequence[int], where: str) -> str:
    """Return the text of an AccuracyWarning: these components are below 0 where f did not lead them. `where`: how far,
    or in how many trajectories."""
    listed = ", ".join(map(str, indices))
    return (
        f"{components} fell below 0 {where}, although fun does not lead there from 0: the exact solution stays "
        f"nonnegative, and what comes after may be wrong. Pass nonnegative=[{listed}], a smaller atol, or "
        "nonnegative=False if that is meant"
    )


def harmful_projection(components: str, distance: str) -> str:
    """Return the text of an AccuracyWarning: which components projections move, and how far."""
    return (
        f"projection moved {components} by {distance}: it corrects other components at the cost of "
        f"{'these' if ',' in components else 'this one'}, and the solution may then be less accurate than without "
        "invariants. Try an atol for each component, larger for fast ones (for velocities that of the positions times "
        "the highest frequency), direction='stages' of Invariants, level= for constraints and their rates, or a "
        "smaller rtol"
    )
