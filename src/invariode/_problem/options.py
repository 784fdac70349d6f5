"""The options, each defined once: name, type, default, check, meaning, and the functions that take it.

A row of the table is a line of a TypedDict: its name and type are what type checkers read, the `Option` beside the type
holds the rest. The classes say which function takes a row: an entry point takes the rows of its class, and no others.
Checks, signatures and docstrings follow from the rows, so that a new option is one row here and its use.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, Literal, TypedDict, get_args, get_origin, get_type_hints

from numpy.typing import ArrayLike

from .._base.arguments import (
    ATOL,
    RTOL,
    Array,
    choice,
    count,
    flag,
    function,
    positive,
    positive_integer,
    progress_or_function,
    shown,
)
from .._base.types import (
    BreakpointsLike,
    EventsLike,
    Fsal,
    Function,
    Interpolation,
    Keep,
    LargestStep,
    Numbers,
    OnFailure,
    OnInterrupt,
    Progress,
    Span,
)
from .breakpoints import to_breakpoints
from .delays import DelaysLike, HistoryLike
from .grouped import CheckpointLike, Limits, LinearSolver, to_checkpoint, to_limits, to_linear_solver
from .inputs import InputsLike
from .invariants import InvariantsLike
from .methods import find_method
from .sensitivities import SensitivitiesLike

__all__ = [
    "TABLE",
    "TOPICS",
    "AllOptions",
    "DescribingOptions",
    "EnsembleOptions",
    "ExtensionOptions",
    "ManyOptions",
    "Option",
    "Options",
    "ProblemArguments",
    "ProblemEnsembleOptions",
    "RunOptions",
    "SolveOptions",
    "StepperOptions",
    "table_of",
]


def as_given(name: str, value: Any) -> Any:
    """Return the value unchecked: it depends on the problem, and is checked with it."""
    return value


def to_members(name: str, value: Any) -> tuple[str, str]:
    """The names of an explicit and an implicit method."""
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise TypeError(f"{name} must be the names of an explicit and an implicit method, got {shown(value)}")
    explicit_one, implicit_one = (find_method(one)[0] for one in value)
    if "jac" in explicit_one.options or "jac" not in implicit_one.options or "prefer" in implicit_one.options:
        raise ValueError(
            f"{name} must be an explicit method and then an implicit one, as in ('ode45', 'ode15s'); got {shown(value)}"
        )
    if explicit_one.equations != "any":
        raise ValueError(
            f"{name}: {explicit_one.name} does not take any fun, and cannot take turns with another method; use "
            f"'dop853' or 'ode89', or method={explicit_one.name!r} alone"
        )
    return explicit_one.name, implicit_one.name


def _flag_or(name: str, value: object, *, word: str) -> bool | str:
    if isinstance(value, str) and value == word:
        return word
    try:
        return flag(name, value)
    except TypeError:
        raise TypeError(f'{name} must be True, False or "{word}", got {shown(value)}') from None


def _largest_step(name: str, value: object) -> LargestStep:
    if isinstance(value, str):
        if value != "tenth":
            raise ValueError(f"{name} must be a positive number or 'tenth', of the interval; got {shown(value)}")
        return "tenth"
    return positive(name, value)


@dataclass(frozen=True)
class Option:
    """A row of the table, without the name and the type of the option."""

    default: Any
    kind: str  # the type in words
    text: str | None  # the paragraph of the documentation; None: shared with the next row
    check: Callable[[str, Any], Any] = as_given
    every_method: bool = True  # False: only methods whose row in METHODS names it can use it
    command: bool = False  # the command line has a flag of this name
    type: Any = field(default=None, compare=False)  # filled in by `table_of`


class StepSizeOptions(TypedDict, total=False):
    """Options that control the step size."""

    rtol: Annotated[
        Numbers,
        Option(
            RTOL,
            "float or array_like of shape (n,)",
            "The estimated error of component i is kept below ``max(rtol_i |y_i|, atol_i)``. rtol below 100 ε is "
            "raised to 100 ε.",
            command=True,
        ),
    ]
    atol: Annotated[
        Numbers,
        Option(ATOL, "float or array_like of shape (n,)", "See `rtol`; in the units of y.", command=True),
    ]
    first_step: Annotated[
        float | None, Option(None, "float", "Size of the first step. Default: chosen from f(t0, y0).", positive)
    ]
    max_step: Annotated[
        LargestStep,
        Option(
            math.inf,
            "float or 'tenth'",
            "Largest step; one that lands on the end or a breakpoint may be up to a tenth longer. 'tenth' is a tenth "
            "of the interval: the rule of MATLAB's codes, and the default of the functions that have their names, such "
            "as `ode45`.",
            _largest_step,
        ),
    ]


class MethodOptions(TypedDict, total=False):
    """Options of the method."""

    interpolation: Annotated[
        Interpolation,
        Option(
            "projected",
            "{'projected', 'corrected', 'raw'}",
            "Values between steps: continuous and on the manifold of the invariants; continuous only; or the method's "
            "own extension, as in the paper and the suite.",
            partial(choice, known=get_args(Interpolation)),
        ),
    ]
    fsal: Annotated[
        Fsal,
        Option(
            "reuse",
            "{'reuse', 'evaluate'}",
            "After a projection: take the last stage of the step as the first of the next (paper, section 4), or "
            "evaluate f at the projected value, for one more f per step.",
            partial(choice, known=get_args(Fsal)),
            every_method=False,
        ),
    ]
    max_order: Annotated[
        int | None,
        Option(
            None,
            "int",
            "Highest order of the formulas; those of radau have order 5, 9 and 13. The series of taylor have exactly "
            "this order, from 3 to 40, by default ⌈1 − ½ ln rtol⌉, or more for a short f. Default of the others: the "
            "method's highest.",
            positive_integer,
            every_method=False,
        ),
    ]
    bdf: Annotated[
        bool | None,
        Option(
            None,
            "bool",
            "Backward differentiation formulas instead of NDFs: larger errors at the same h, but orders 3 to 5 are "
            "stable in wider sectors. Default: False, except with ``method='BDF'``.",
            flag,
            every_method=False,
        ),
    ]
    prefer: Annotated[
        tuple[str, str] | None,
        Option(
            None,
            "(str, str)",
            "The explicit and the implicit method between which ``method='auto'`` switches. Default: 'ode113' and "
            "'ode15s', which evaluate f least often. With a compiled, cheap f the pairs 'ode45' and 'ode78' are faster "
            "than 'ode113'.",
            to_members,
            every_method=False,
        ),
    ]
    linear_solver: Annotated[
        LinearSolver,
        Option(
            "direct",
            "{'direct', 'gmres'} or GMRES",
            "How the linear systems of Newton's iteration are solved: by LU factors of M - c J, or by `GMRES`, without "
            "a matrix, for systems too large for one; 'gmres' is short for ``GMRES()``.",
            to_linear_solver,
            every_method=False,
        ),
    ]
    calibrate: Annotated[
        bool,
        Option(
            False,
            "bool",
            "Solve with tighter tolerances, so that the error of the solution, not of a step, is about as large as "
            "`rtol` and `atol` on well-behaved problems, and proportional to them.",
            flag,
            every_method=False,
        ),
    ]
    check: Annotated[
        bool | Literal["strict"],
        Option(
            True,
            'bool or "strict"',
            "Test that f conserves the invariants, and that their Jacobians are right; and, at the first run of a "
            "function of `invariode.compile` in a process, that it has the values of the Python function at the "
            'accepted steps 1, 2, 4, 8, ... and near the end. A difference is a warning; with "strict" an error.',
            partial(_flag_or, word="strict"),
        ),
    ]
    min_step: Annotated[
        float | None,
        Option(
            None,
            "float",
            "An option of SciPy's LSODA. No method here uses it: a warning says so.",
            every_method=False,
        ),
    ]


class SteppingOptions(StepSizeOptions, MethodOptions, total=False):
    """The options of every kind of run."""


class ScheduleOptions(TypedDict, total=False):
    """Options of a problem and of its runs, which are merged."""

    breakpoints: Annotated[
        BreakpointsLike | None,
        Option(
            None,
            "list of float or of (float, callable), or dict of callables by time",
            "Times at which `fun`, the invariants or their derivatives may jump: switches, pulses, doses. A step ends "
            "exactly at each, and the method restarts there; between two breakpoints the functions are evaluated only "
            "at times strictly between them. With ``(t, action)``, or in a dict ``{t: action}``, the solution jumps to "
            "``action(t, y, *args)``, of shape (n,); invariants without a prescribed value are held at their new "
            "values, and the output contains both states. Breakpoints beyond the interval take effect if the run is "
            "extended. Conditions of `fun` on t alone, such as ``t % 24 < 2``, need none if it is compiled or calls "
            "nothing but NumPy and `math`: steps end where they change.",
            to_breakpoints,
        ),
    ]


class RunningOptions(ScheduleOptions, total=False):
    """Options for stored output, callbacks and limits of a run, alone or in an ensemble."""

    keep: Annotated[
        Keep | None,
        Option(
            None,
            "{'all', 'outputs', 'end'}",
            "Keep the outputs and a record of each step (``Solution.steps``), only the outputs, or only the final "
            "state; events are always kept. Default: 'outputs' with `t_eval`, else 'all'. With 'end', and with "
            "'outputs' at `t_eval`, memory does not grow with the number of steps, unless `dense_output` is set.",
            partial(choice, known=get_args(Keep)),
        ),
    ]
    callback: Annotated[
        Callable[[float, Array], object] | None,
        Option(
            None,
            "callable",
            "``callback(t, y)`` after each accepted step; returning True stops.",
            partial(function, signature="callback(t, y)"),
        ),
    ]
    max_steps: Annotated[
        int | None,
        Option(
            None,
            "int",
            "Maximum number of accepted steps: short for ``limits=Limits(steps=...)``. Default: no limit.",
            count,
            command=True,
        ),
    ]
    limits: Annotated[
        Limits | None,
        Option(
            None,
            "Limits",
            "Limits of the steps, the time, or the points and bytes kept. A run that reaches one ends with status -3, "
            "a message that says how far it got and how fast, and all results so far; ``Solution.extend`` continues "
            "it. See `Limits`.",
            to_limits,
        ),
    ]
    progress: Annotated[
        Progress,
        Option(
            False,
            "bool or callable",
            "True: a bar shows t, h and the time left, or the trajectories of an ensemble, at most ten times a second: "
            "under the cell in notebooks, else on standard error (with rich). A function ``progress(done, total)`` is "
            "called at most once a second, and at the end: with the part of the interval, or the number of "
            "trajectories, that is done, and the whole, None if that is infinite or unknown.",
            progress_or_function,
        ),
    ]
    on_interrupt: Annotated[
        OnInterrupt,
        Option(
            "raise",
            "{'raise', 'return'}",
            "What Ctrl-C does: raise KeyboardInterrupt, or end the run after the current step and return the results "
            "so far, with status 2; then SIGTERM does so too, unless the process has a handler of its own. A second "
            "Ctrl-C always raises. For an ensemble: return the trajectories that are solved, the "
            "others with status -128; if it raises, the exception has them as its `solution`.",
            partial(choice, known=get_args(OnInterrupt)),
        ),
    ]
    on_failure: Annotated[
        OnFailure | None,
        Option(
            None,
            "{'return', 'warn', 'raise'}, optional",
            "If a run ends with a negative status: return the results so far, return them with a `FailureWarning`, or "
            "raise a `SolveError`, whose `solution` holds them. Default: return them, but raise an `InvariantError` "
            "for status -2, an invariant that f contradicts, as at the start of a run. For an ensemble one warning or "
            "error gives the number of failed trajectories, and why the first one failed.",
            partial(choice, known=get_args(OnFailure)),
        ),
    ]


class RunOptions(SteppingOptions, RunningOptions, total=False):
    """The options of one run that are not parameters of `scipy.integrate.solve_ivp`."""

    refine: Annotated[
        int,
        Option(1, "int", "Points per step in the output; those inside the step are interpolated.", positive_integer),
    ]
    checkpoint: Annotated[
        CheckpointLike | None,
        Option(
            None,
            "str, path-like or Checkpoint",
            "A file from which ``load(path, problem).extend(tf)`` continues the run, bit for bit, if the process dies. "
            "It is replaced every minute, or as often as `Checkpoint` says. An extension continues to write it.",
            to_checkpoint,
            command=True,
        ),
    ]


class OutputOptions(TypedDict, total=False):
    """Options for output computed besides the steps."""

    t_eval: Annotated[
        ArrayLike | None,
        Option(
            None,
            "array_like",
            "Times of the output, sorted in the direction of integration. Default: the ends of the steps. Values "
            "between steps are within the tolerance like those at the steps: with radau, ode23t and ode23tb output may "
            "shorten steps (never lengthen them), with the other methods steps do not depend on it.",
            command=True,
        ),
    ]
    dense_output: Annotated[
        bool, Option(False, "bool", "Whether ``Solution.sol`` is computed; it may shorten steps as `t_eval` may.", flag)
    ]
    adjoint: Annotated[
        bool | Literal["checkpoints"],
        Option(
            False,
            "bool or 'checkpoints'",
            "Keep what ``Solution.gradient`` needs, the gradient of a scalar with respect to many parameters. True: "
            "the continuous solution, as `dense_output` does. 'checkpoints', for less memory: the state of the run at "
            "some of its steps, from which ``gradient`` solves the sections between them again, with the same steps "
            "and the same result bit for bit. For N steps the memory grows as √N; the time is that of one more run.",
            partial(_flag_or, word="checkpoints"),
        ),
    ]


class DescribingOptions(TypedDict, total=False):
    """Options that describe the solution and the equations: arguments of `Problem`, options of its shorter forms."""

    invariants: Annotated[
        InvariantsLike | None,
        Option(
            None,
            "callable, Invariants, or list or dict of these",
            "Quantities that the solution conserves. Each accepted step is projected onto them (paper, sections 3 and "
            "4). The keys of a dict are their names. See `Invariants`.",
        ),
    ]
    jac: Annotated[
        Any,
        Option(
            None,
            "callable, Banded, (n, n) array_like, sparse matrix, 'trace', 'complex-step' or 'differences'",
            "The Jacobian of f: ``jac(t, y, *args)``, or a constant. If it is (or returns) a sparse matrix, the "
            "linear algebra is sparse; with `Banded` it is banded. Or how to compute it: 'trace', from the expressions "
            "of f, which is called once with symbolic values, as by `invariode.compile`: exact, with the exact "
            "sparsity pattern and ∂f/∂t, in machine code, for some milliseconds at the start; it pays with ode23s, in "
            "ensembles and in long runs, and needs the extra `compiled`. By complex steps, Im f(t, y + i h e_j) / h, "
            "exact to roundoff, if f takes complex y; or by differences. Default: 'trace' for functions of "
            "`invariode.compile`, or complex steps for one that only numba compiles; else differences. "
            "``stats.jacobian`` reports which was used.",
            every_method=False,
        ),
    ]
    jac_sparsity: Annotated[
        Any,
        Option(
            None,
            "(n, n) array_like, sparse matrix, 'detect' or 'dense'",
            "Which entries of the Jacobian can differ from zero, for differences, complex steps and sparse linear "
            "algebra. If a test finds that an entry is missing, the pattern is enlarged, with a warning. Default: from "
            "n = 200 on the pattern is detected, by evaluations of f near y0, at most n / 2 of them, and enlarged "
            "when an entry is found missing. 'detect' forces detection for any n; 'dense' disables it.",
            every_method=False,
        ),
    ]
    lband: Annotated[int | None, Option(None, "int", None, every_method=False)]
    uband: Annotated[
        int | None,
        Option(
            None,
            "int",
            "SciPy's form of ``jac=Banded(lband, uband, jac)``: the Jacobian is zero except for "
            "``i - lband <= j <= i + uband``, and `jac`, if given, is or returns its bands. See `Banded`.",
            every_method=False,
        ),
    ]
    mass: Annotated[
        Any,
        Option(
            None,
            "(n, n) array_like or sparse matrix, or callable",
            "M in M y' = f(t, y): constant, or ``mass(t, *args)``. A singular M makes some equations algebraic "
            "(index 1); y0 is then moved to consistent values.",
            every_method=False,
        ),
    ]
    second_order: Annotated[
        bool,
        Option(
            False,
            "bool",
            "Whether y is (q, v) and f returns ``(v, a(t, q))``: the accelerations do not depend on the velocities. "
            "The methods rkn64, rkn86 and rkn1210 need it, and evaluate f with other velocities to test it, at the "
            "start and after the run. `SecondOrder` says so too, and needs no test.",
            flag,
        ),
    ]
    inplace: Annotated[
        bool,
        Option(
            False,
            "bool",
            "True: ``fun(t, y, out, *args)`` writes y' to `out`, an array of the shape of y, and returns nothing, "
            "which saves NumPy an array in each call. Entries that it leaves out are NaN. `compile` has the same "
            "option.",
            flag,
        ),
    ]
    bounds: Annotated[
        Any,
        Option(
            None,
            "(lower, upper) or scipy.optimize.Bounds",
            "Bounds on y: numbers or arrays of shape (n,); infinite or None for no bound. A step that takes a "
            "component beyond one by more than its tolerance is repeated with half the size; by less, the component is "
            "moved to its bound before the method commits the step. Output between steps is within the bounds too, and "
            "f and its Jacobian are never evaluated outside them: stages, Newton iterates and increments are moved "
            "onto the bounds first. With `invariants` the result is the nearest point that satisfies both.",
        ),
    ]
    nonnegative: Annotated[
        bool | int | str | Sequence[int] | Sequence[str] | None,
        Option(
            None,
            "bool, int, str or sequence of int or str",
            "Components that must not become negative, such as concentrations: short for `bounds` of 0 below. True "
            "means all. False: components may be negative, and no AccuracyWarning names one that falls below 0 "
            "although f does not lead it there.",
            command=True,
        ),
    ]

    delays: Annotated[
        DelaysLike | None,
        Option(
            None,
            "number, str, or list of these",
            "Constant delays tau_j > 0: numbers, or names of parameters of f. f is then ``fun(t, y, z, *args)`` with "
            "``z[j]`` = y(t - tau_j), of shape (k, n) for k delays. Steps end where a discontinuity comes back by a "
            "delay. See the how-to on delays.",
        ),
    ]
    history: Annotated[
        HistoryLike | None,
        Option(
            None,
            "callable, array_like of shape (n,), or Solution",
            "With `delays`: y before t0, as a function of t, or of ``(t, *args)``; a constant; or an earlier Solution "
            "with dense output. If it differs from y0 at t0, y jumps there. `breakpoints` before t0 are times at which "
            "the history jumps.",
        ),
    ]
    sensitivities: Annotated[
        SensitivitiesLike | None,
        Option(
            None,
            "bool, str, int, list of these, or Sensitivities",
            "Derivatives of the solution with respect to parameters, computed with it: True for all numbers in `args`, "
            "or names of f's arguments (``'k1'``, ``'p[2]'`` in an array p), indices of arguments, and initial values "
            "(``'y0[prey]'``; ``'y0'`` for all). They are ``Solution.sensitivities``, as accurate as y. See "
            "`Sensitivities`.",
        ),
    ]


class CallingOptions(TypedDict, total=False):
    """The rest of what describes a problem; positional in SciPy's call."""

    events: Annotated[
        EventsLike,
        Option(
            None,
            "callable, Event, or list or dict of these",
            "Functions ``event(t, y, *args)`` whose zeros are located, to a few units in the last place of t. The keys "
            "of a dict are their names. See `Event`.",
        ),
    ]
    args: Annotated[
        Iterable[Any] | None,
        Option(None, "tuple", "Extra arguments for `fun`, `jac`, `mass`, invariants, events and actions."),
    ]


class SolveOptions(RunOptions, DescribingOptions, total=False):
    """Options of `solve_ivp` that its signature does not spell out."""


class Options(RunOptions, OutputOptions, total=False):
    """Options of `Problem.solve`."""


class AllOptions(SolveOptions, OutputOptions, CallingOptions, total=False):
    """Options of the functions of the MATLAB ODE Suite."""

    vectorized: Annotated[
        bool, Option(False, "bool", "Whether `fun` takes y of shape (n, k). It is called with k = 1.", flag)
    ]


class ManyOptions(TypedDict, total=False):
    """Options for the parallel solution of the trajectories of an ensemble."""

    workers: Annotated[
        int | None,
        Option(
            None,
            "int",
            "Threads or processes. Default: the processors that this process may use; functions of Python that only "
            "calculate with numbers, as their code shows, are then called in this process for the first 50 ms, and "
            "other processes are started if rows are left. With an executor: threads that each of its places uses at "
            "once; default: 1.",
        ),
    ]
    lanes: Annotated[
        Literal["auto", 1],
        Option(
            "auto",
            "{'auto', 1}",
            "With 'auto', explicit Runge-Kutta pairs and taylor integrate trajectories of compiled functions side by "
            "side in vector registers where they can, with the same result; 1: one at a time. ``stats.lanes`` says "
            "which it was, and why.",
        ),
    ]
    retry: Annotated[
        Mapping[str, Any] | Sequence[Mapping[str, Any]] | None,
        Option(
            None,
            "dict or list of dict",
            "Options with which trajectories that failed are solved again, ``{'method': 'radau', 'rtol': 1e-9}``, one "
            "after the other until one attempt succeeds; options that it leaves out keep their values.",
        ),
    ]
    executor: Annotated[
        Any,
        Option(
            None,
            "concurrent.futures.Executor or distributed.Client",
            "Where trajectories are solved: an executor that receives `chunk` of them at a time, such as processes of "
            "this machine, or a cluster by way of Dask. Functions travel: compiled ones are compiled again where they "
            "arrive; with cloudpickle, of the extra `cluster`, functions of the script itself travel too.",
        ),
    ]
    chunk: Annotated[
        int | None,
        Option(
            None,
            "int",
            "Trajectories in a part. Default: as many as take a second, judged by the first ones, on executors of more "
            "than 50 places a fiftieth of a second for each of them; at most 32 MiB.",
        ),
    ]
    resume: Annotated[
        bool,
        Option(
            False,
            "bool",
            "True continues a store that exists; trajectories that it holds are not solved again.",
            flag,
        ),
    ]
    seed: Annotated[
        Any,
        Option(
            None,
            "int, list of int or str",
            "Seed of the random rows, recorded in the attributes of the store.",
        ),
    ]


class ProblemEnsembleOptions(SteppingOptions, RunningOptions, ManyOptions, total=False):
    """Options of `Problem.solve_ensemble` that its signature does not spell out."""


class EnsembleOptions(ProblemEnsembleOptions, DescribingOptions, total=False):
    """Options of `solve_ensemble` that its signature does not spell out."""


class StepperOptions(MethodOptions, DescribingOptions, total=False):
    """Options of the classes in `invariode.scipy` that their signature does not spell out."""


class ExtensionOptions(TypedDict, total=False):
    """Options that `Solution.extend` may change. With any other the parts would not belong to one solution."""

    t_eval: ArrayLike | None
    first_step: float | None
    max_step: LargestStep
    callback: Callable[[float, Array], object] | None
    check: bool | Literal["strict"]
    max_steps: int | None
    limits: Limits | None
    on_failure: OnFailure | None
    on_interrupt: OnInterrupt
    progress: Progress


class ProblemArguments(DescribingOptions, CallingOptions, ScheduleOptions, total=False):
    """The arguments of `Problem`."""

    fun: Function
    t_span: Span
    y0: ArrayLike | Callable[..., Any]
    parameters: Mapping[str, float] | None
    inputs: InputsLike | None
    name: str | None
    labels: Sequence[str] | None


def table_of(kind: type) -> dict[str, Option]:
    """The rows of a class, in their order."""
    rows: dict[str, Option] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is Annotated:
            rows[name] = replace(hint.__metadata__[0], type=hint.__origin__)
    return rows


#: The options by topic, in the order in which they are documented.
TOPICS: Mapping[str, tuple[str, ...]] = {
    "the problem": (
        "args",
        "vectorized",
        "events",
        "invariants",
        "bounds",
        "nonnegative",
        "mass",
        "second_order",
        "inplace",
        "breakpoints",
        "delays",
        "history",
    ),
    "the Jacobian": ("jac", "jac_sparsity", "lband", "uband", "linear_solver"),
    "parameters": ("sensitivities",),
    "accuracy and steps": ("rtol", "atol", "first_step", "max_step", "min_step", "calibrate", "check"),
    "the method": ("max_order", "bdf", "prefer", "fsal"),
    "output": ("t_eval", "dense_output", "adjoint", "interpolation", "refine", "keep"),
    "the course of the run": (
        "callback",
        "progress",
        "max_steps",
        "limits",
        "checkpoint",
        "on_interrupt",
        "on_failure",
    ),
    "ensembles": ("workers", "lanes", "retry", "executor", "chunk", "resume", "seed"),
}

_ROWS = {**table_of(AllOptions), **table_of(ManyOptions)}
#: All rows by name.
TABLE: Mapping[str, Option] = {name: _ROWS[name] for topic in TOPICS.values() for name in topic}
