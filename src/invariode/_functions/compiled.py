"""Native functions: pointers to machine code wherever a Python function is accepted, and `compile`, which makes them.

The signatures (all numbers are doubles, matrices are row-major, p points to the arguments or is NULL):

=================  ====================================================================================
f, g, Jacobians    ``void (double t, const double* y, double* out, const double* p)``
event              ``double (double t, const double* y, const double* p)``
=================  ====================================================================================

NaN in the output means 'cannot be evaluated here'. The code must not raise, and must be thread-safe. `compile` turns
functions that do raise into such code: their values are NaN there.
"""

from __future__ import annotations

import ctypes
import math
import sys
from _ctypes import CFuncPtr
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from types import FunctionType, MappingProxyType, MethodType
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from .._base.arguments import Array, call_name, shown
from .._base.forks import compiling
from .._base.latest import Latest
from .contents import Captured
from .forms import Filling
from .layout import NO_ARGUMENTS, TRUTHS, ArgumentLayout, Constant, Numbers, Shape, layout_of
from .numba_code import NumbaCode, numba_or_say_so

Callback: TypeAlias = Callable[[float, Array], object] | None
"""The user's ``callback(t, y)``, which stops a run by returning True."""

_VECTOR = "void (double t, const double* y, double* out, const double* p)"
_EVENT = "double (double t, const double* y, const double* p)"


#: Makes of (f, t, y, args) ∂f/∂y as a function of t, y and the numbers of args, or None without a graph; and ∂f/∂y
#: itself whatever f is. `derivatives`, which imports this module, puts them here.
_jacobians: list[tuple[Callable[..., Any], Callable[..., Array]]] = []


def form_jacobians_by(exact: Callable[..., Any], whole: Callable[..., Array]) -> None:
    """State how ``jacobian`` of compiled functions is formed: see `_jacobians`."""
    _jacobians[:] = [(exact, whole)]


class Watch(Protocol):
    """Observer of the accepted steps of a run, used as its callback; it may stop the run for reasons that the run does
    not see.

    - `objection`: objection to the solution, in words; None if the solution is accepted
    """

    objection: str | None

    def __call__(self, t: float, y: Array) -> bool:
        """Return whether the run must stop."""


class Part(NamedTuple):
    """A user's function of (t, x, *args), or of (t, q, v, *args) with x = (q, v), that another function is made of."""

    function: Any
    n: int  # components of x
    second: int  # components of v; 0: it takes x
    size: int  # number of its values


class CoreFunction:
    """A function of (t, y, *args) that the core itself evaluates: callable from Python; the core takes `for_core`."""

    #: Whether it calls the user's machine code, which takes the arguments as numbers.
    native = False
    #: How its derivatives are formed, by the name of the function.
    derivatives: Mapping[str, str] = MappingProxyType({})
    #: The user's functions that it calls.
    functions: Sequence[Any] = ()
    #: Those of them that Python can call and on which its values depend.
    parts: Sequence[Part] = ()
    #: The number of leading components of y that are positions, whose velocities follow; 0 if y has no positions.
    positions = 0

    def watch(
        self, t0: float, y0: Array, args: tuple[Any, ...], rtol: ArrayLike, atol: ArrayLike, callback: Callback
    ) -> Watch | None:
        """The watch on a run of y' = this function from (t0, y0), which calls the user's callback; or None."""
        return None

    def undefined_near(self, t: float, y: Array, h: float, args: tuple[Any, ...]) -> str | None:
        """Return the name of a function of the user's that is not finite at a state, or a few steps h beyond, or
        None."""
        return None

    def on_graph(self) -> CompiledFunction | None:
        """Return an equivalent function that can be traced for its derivatives, or None."""
        return None

    def for_core(self, n: int, size: int, parameters: ArgumentLayout) -> Any:
        """Return the form that the core calls, for n components and `size` values."""
        raise NotImplementedError


class CompiledFunction(NumbaCode):
    """A Python function that `compile` turns into machine code for the problem it is used in.

    Called from Python, ``f(t, y, *args)`` runs its machine code, and ``f.jacobian(t, y, *args)`` returns ∂f/∂y.

    Attributes
    ----------
    fun : callable
        The Python function.
    inplace : bool
        The function fills an output array.
    elementary : {"own", "libm"}
        Whose elementary functions it calls: numba the mathematical library's.
    how : str
        Way of compilation: "trace" or "numba", and why not the other; "numba" until it is compiled.
    """

    #: Whether its further arguments may be anything, not only numbers.
    _takes_any = False

    def __init__(self, fun: Callable[..., Any], inplace: bool) -> None:
        self.fun = fun
        self.inplace = inplace
        self.elementary = "libm"
        self.__name__ = call_name(fun, "compiled")
        self.__module__ = getattr(fun, "__module__", __name__)
        self.__qualname__ = getattr(fun, "__qualname__", self.__name__)
        self.how = "numba"
        self.is_complex = False  # whether the Python function takes complex y
        self._forget()

    def _forget(self) -> None:
        """Start without any code, and note what the function has captured."""
        self._captured = Captured(getattr(self.fun, "fun", self.fun))  # of the form of first order, the accelerations
        self._made: dict[Shape, _core.Native] = {}
        self.lane_forms: dict[tuple[Any, ...], Any] = {}  # of `lanes`
        self.delayed_forms: dict[tuple[int, int, bool], CompiledFunction] = {}  # with delays: of one vector
        self.prepared = Latest[Any, Any]()  # plans with this code, by the kinds of their problems
        self._jitted = self._jitted_complex = None
        self._calls: dict[Any, Any] = {}  # what Python calls, by sizes
        self._derivatives: dict[Any, Any] = {}

    @property
    def version(self) -> object:
        """An object that stands for the code: there is another one when the code is forgotten."""
        return self._captured

    def renew(self) -> None:
        """Forget all code if the closure, the globals or the defaults of the function are other ones than when the code
        was made: machine code holds their values as constants."""
        if (self._made or self._calls or self._derivatives) and self._captured.changed():
            with compiling:
                self._forget()

    def __call__(self, *args: Any) -> Any:
        """Return the values for (t, y, *args), or (t, y, out, *args) with `inplace`: those of the machine code if
        arguments and values are real numbers, otherwise those of the Python function."""
        found = self._by_machine(args)
        return self.fun(*args) if found is None else found

    def _by_machine(self, args: tuple[Any, ...]) -> Any:
        """Return the values that the machine code computes, after filling an output array with them; None if these
        arguments have no machine code."""
        if len(args) < 2 + self.inplace or self.is_complex or not _is_real(args[0]):
            return None
        t, y, *rest = args
        state = _real_vector(y)
        if state is None:
            return None
        self.renew()
        given, shape = (rest[1:], np.shape(rest[0])) if self.inplace else (rest, ())
        try:
            made, p = self._known(
                self._calls, given, (len(state), shape), lambda p: self._prepared_call(t, state, p, args)
            )
        except (TypeError, ValueError):  # it can be neither traced nor compiled for these arguments
            return None
        if made is None:
            return None
        size, call = made
        values = call(float(t), state, p)
        if self.inplace:
            rest[0][...] = values.reshape(size)
            return rest[0]
        return values.reshape(size) if size else float(values[0])

    def _prepared_call(self, t: float, y: Array, p: ArgumentLayout, args: tuple[Any, ...]) -> Any:
        """Return the shape of the values for these arguments, which the Python function tells, and the machine code;
        None: the values are no floats, or there is no code for these arguments."""
        if self.inplace:
            out = _real_vector(args[2])
            shape = None if out is None else out.shape
        else:
            value = np.asarray(self.fun(*args))
            shape = value.shape if value.dtype == float and value.size else None
        if shape is None:
            return None
        size = math.prod(shape)
        return shape, as_python(to_native(self.__name__, self, len(y), size, p), size)

    def _known(
        self, known: dict[Any, Any], args: Sequence[Any], sizes: Any, make: Callable[[ArgumentLayout], Any]
    ) -> tuple[Any, Array]:
        """Return what was made for arguments of these sizes, and their numbers: one for all floats and arrays of
        floats, unless the values of some are constants of the code."""
        numbers = _floats(args)
        key = sizes, tuple(map(np.shape, args))
        if numbers is not None and key in known:
            return known[key], numbers
        p = layout_of(args)
        exact = sizes, p.fixed(constants([self], p))
        if exact not in known:
            made = make(p)  # which finds out what the constants are
            exact = sizes, p.fixed(constants([self], p))
            known[exact] = made
        if numbers is not None and p.may_vary(constants([self], p)):
            known[key] = known[exact]
        return known[exact], p.numbers

    def jacobian(self, t: float, y: ArrayLike, *args: Any) -> Array:
        """Return ∂f/∂y of shape (m, n): exactly, by machine code, where the function can be traced; else by complex
        steps or differences.

        Parameters
        ----------
        t : float
            The time.
        y : array_like of shape (n,)
            The state.
        *args
            The further arguments of the function.

        Raises
        ------
        TypeError
            The function fills an output array, so that the number of its values is not known.
        """
        if self.inplace:
            raise TypeError(
                f"{self!r} fills an array, and does not say how many values it has: compile it without inplace"
            )
        self.renew()
        state = np.array(y, dtype=float)
        if state.ndim != 1:
            raise ValueError(f"y must have shape (n,), got {state.shape}")
        exact, whole = _jacobians[0]
        found, p = self._known(self._derivatives, args, len(state), lambda _: exact(self, float(t), state, args))
        if found is not None:
            J: Array = found(float(t), state, p)
            if np.isfinite(J).all():
                return J
        return whole(self, float(t), state, args)

    def at(self, t: float, *vectors: Array, parameters: ArgumentLayout) -> Any:
        """Call the Python function with all numbers of the arguments in one array, if there are any."""
        return self.fun(t, *vectors, *([parameters.numbers.copy()] if parameters.size else []))

    def value_at(self, t: float, y: Array, parameters: ArgumentLayout) -> Any:
        """Return the value of the Python function, or the output array that it fills. `y` has the type of the problem's
        y and is copied."""
        y = y.copy() if self.is_complex else y.copy().view(float)
        if not self.inplace:
            return self.at(t, y, parameters=parameters)
        out = np.empty(max((shape.size for shape in self._made), default=0), y.dtype)
        self.at(t, y, out, parameters=parameters)
        return out

    def index_error(self, name: str, t: float, y: Array, parameters: ArgumentLayout) -> IndexError | None:
        """The IndexError that the Python function raises, where the machine code is NaN: with the `name` that the
        function has in its problem."""
        try:
            self.value_at(t, y, parameters)
        except IndexError as error:
            sizes = f"y has size {len(y)}" + (f", args together {parameters.size}" if parameters.size else "")
            found = IndexError(f"{name}, {self!r}, at t = {t}: {error}. {sizes}: correct the index")
            found.__cause__ = error
            return found
        except Exception:  # whatever else the user's code raises: there NaN is right
            return None
        return None

    def __repr__(self) -> str:
        return f"compile({self.__name__})"

    def __reduce__(self) -> str | tuple[Any, ...]:
        """Pickle by name if `compile` was the decorator of a function, else by function and options; never with the
        machine code."""
        try:
            named: Any = reduce(getattr, self.__qualname__.split("."), sys.modules[self.__module__])
        except (AttributeError, KeyError):
            named = None
        return self.__qualname__ if named is self else self.made_again()

    def made_again(self) -> tuple[Any, ...]:
        """Return the callable and the arguments that recreate this object from its function."""
        return CompiledFunction, (self.fun, self.inplace)

    def native(
        self, n: int, size: int, parameters: ArgumentLayout = NO_ARGUMENTS, event: bool = False, second: int = 0
    ) -> _core.Native:
        """Return the machine code for n components, `size` values and these arguments. With `second` the
        function takes two vectors, of n - second and second components, which follow each other in y."""
        return self._machine_code(Shape(n, size, parameters.whole(), event, second))

    def complex_native(
        self, n: int, size: int, parameters: ArgumentLayout, second: int = 0, *, real_time: bool = False
    ) -> _core.Native:
        """Return machine code of the function for complex y with complex values; t is complex and precedes y, or with
        `real_time` real and separate.

        Raises
        ------
        TypeError
            numba cannot compile it for complex numbers.
        """
        try:
            return self._machine_code(Shape(n, size, parameters, False, second, is_complex=True, real_time=real_time))
        except (AttributeError, NotImplementedError) as error:  # what cmath lacks; a comparison, which is found late
            raise self._cannot_compile(error) from error

    def _machine_code(self, shape: Shape) -> _core.Native:
        made = self._made.get(shape)
        if made is not None:  # without waiting for other functions
            return made
        with compiling:
            made = self._made.get(shape)
            if made is None:
                code = self._make(shape)
                made = self._made[shape] = _Native(code.address, shape.event, code, (self, shape))
        return made


def is_native(fun: object) -> bool:
    """Return whether `fun` is machine code of an accepted kind."""
    if type(fun) in _PLAIN:  # the common cases
        return False
    if isinstance(fun, CompiledFunction):
        return True
    if isinstance(fun, CoreFunction):
        return fun.native
    return isinstance(fun, _POINTERS) or _is_cfunc(fun) or _is_low_level(fun)


def is_plain_function(fun: object) -> bool:
    """Return whether Python calls `fun` as it is: it is neither machine code nor of a class of this package."""
    if type(fun) in _PLAIN:
        return True
    if isinstance(fun, CompiledFunction):
        return False
    of_ours = any(one.__module__.partition(".")[0] == "invariode" for one in type(fun).__mro__)
    return not of_ours and not is_native(fun)


class NativeWithInputs(NamedTuple):
    """Machine code whose parameters begin with the values at t of inputs, of these shapes."""

    fun: Any
    inputs: list[_core.PiecewisePolynomial]
    shapes: list[tuple[int, ...]]

    def arguments(self, parameters: ArgumentLayout) -> ArgumentLayout:
        """Return the arguments that the native function takes: the values of the inputs, then these."""
        entries = (Numbers(np.ones(shape) if shape else 1.0, varying=True) for shape in self.shapes)
        return ArgumentLayout((*entries, *parameters.entries))


_PLAIN = (FunctionType, MethodType, _core.StateFirst, Filling)
_POINTERS = (CompiledFunction, CFuncPtr, NativeWithInputs)


def _is_cfunc(fun: object) -> bool:
    return type(fun).__name__ == "CFunc" and hasattr(fun, "address")


def _is_low_level(fun: object) -> bool:
    return type(fun).__name__ == "LowLevelCallable" and isinstance(fun, tuple)


def to_native(
    name: str, fun: Any, n: int, size: int, args: ArgumentLayout, event: bool = False, second: int = 0
) -> Any:
    """The form for the core: the address of a native `fun`, with what keeps the code alive. Python functions pass
    unchanged. `second`: as in `CompiledFunction.native`.

    Raises TypeError: The object states a signature, and it is the wrong one.
    """
    if isinstance(fun, CoreFunction):
        return fun.for_core(n, size, args)
    if isinstance(fun, NativeWithInputs):
        taken = fun.arguments(args)
        compiled = isinstance(fun.fun, CompiledFunction)
        code = fun.fun.native(n, size, taken, event) if compiled else to_native(name, fun.fun, n, size, args, event)
        return _core.Native(address=code.address, event=event, owner=code, inputs=fun.inputs)
    if isinstance(fun, CompiledFunction):
        return fun.native(n, size, args, event, second)
    if not is_native(fun):
        return fun
    wanted = _EVENT if event else _VECTOR
    if _is_cfunc(fun):
        numba = numba_or_say_so()
        pointer, double = numba.types.CPointer(numba.types.double), numba.types.double
        expected = (double, (double, pointer, pointer)) if event else (numba.void, (double, pointer, pointer, pointer))
        if (fun._sig.return_type, tuple(fun._sig.args)) != expected:
            raise TypeError(f"{name} has the signature {fun._sig}, expected {wanted}")
        address = int(fun.address)
    elif _is_low_level(fun):
        given = "".join(fun.signature.replace("const", "").split())
        plain = "double(double,double*,double*)" if event else "void(double,double*,double*,double*)"
        if given != plain:
            raise TypeError(f"{name} has the signature {fun.signature}, expected {wanted}")
        capsule, _, user_data = fun
        if user_data is not None:
            raise TypeError(f"{name}: user_data of a LowLevelCallable is not passed on; use args")
        address = _core.capsule_address(capsule)
    else:
        kinds = fun.argtypes
        count = 3 if event else 4
        if kinds is not None and (len(kinds) != count or kinds[0] is not ctypes.c_double):
            raise TypeError(f"{name} takes {len(kinds)} arguments of the types {kinds}, expected {wanted}")
        if kinds is not None and fun.restype is not (ctypes.c_double if event else None):
            raise TypeError(f"{name} returns {fun.restype}, expected {wanted}")
        address = ctypes.cast(fun, ctypes.c_void_p).value or 0
    if address == 0:
        raise ValueError(f"{name} is a null pointer")
    return _Native(address, event, fun)


class _Native(_core.Native):
    """Machine code that is shared by copies, and made again from a pickle where `compile` made it."""

    def __init__(self, address: int, event: bool, owner: object, made_of: tuple[Any, ...] | None = None) -> None:
        super().__init__(address=address, event=event, owner=owner)
        self.made_of = made_of

    def __reduce__(self) -> tuple[Callable[..., _core.Native], tuple[Any, ...]]:
        if self.made_of is None:
            raise TypeError("native functions cannot be pickled, except those that invariode.compile makes")
        return CompiledFunction._machine_code, self.made_of

    def __deepcopy__(self, memo: dict[int, Any]) -> _Native:
        return self


class Compiled(NamedTuple):
    """Compiled function as `compile` made it for the core: for n components and arguments, with `size` values."""

    function: CompiledFunction
    n: int
    size: int
    parameters: ArgumentLayout
    event: bool = False


def made_by_compile(fun: Any) -> Compiled | None:
    """Return the compiled function of (t, y, p) from which `to_native` made `fun` for the core; None if `fun` is
    anything else."""
    if not isinstance(fun, _Native) or fun.made_of is None:
        return None
    compiled, shape = fun.made_of
    known = Shape(shape.n, shape.size, shape.parameters, shape.event)
    return Compiled(compiled, known.n, known.size, known.parameters, known.event) if shape == known else None


def complex_form(fun: Any) -> _core.Native | None:
    """Machine code that `compile` made, for complex y and real t. None: it has not made it, or cannot."""
    if not isinstance(fun, _Native) or fun.made_of is None:
        return None
    compiled, shape = fun.made_of
    try:
        made: _core.Native = compiled.complex_native(shape.n, shape.size, shape.parameters, real_time=True)
    except Exception:  # whatever numba meets there: it has compiled the function for real numbers
        return None
    return made


def _floats(args: Sequence[Any]) -> Array | None:
    """Return floats and arrays of floats one after the other; None if there are other arguments, which may be constants
    of the code."""
    if not all(type(one) is float or (type(one) is np.ndarray and one.dtype == float) for one in args):
        return None
    return np.concatenate([np.ravel(one) for one in args]) if args else NO_ARGUMENTS.numbers


def _is_real(value: Any) -> bool:
    return isinstance(value, (float, int, np.floating, np.integer)) and not isinstance(value, bool)


def _real_vector(value: Any) -> Array | None:
    """Return real numbers as a vector, or None."""
    if isinstance(value, np.ndarray):
        real = value.ndim == 1 and value.dtype.kind in "fiu"
        return np.ascontiguousarray(value, dtype=float) if real and value.dtype != np.longdouble else None
    if isinstance(value, (list, tuple)) and value and all(map(_is_real, value)):
        return np.array(value, dtype=float)
    return None


def as_python(fun: _core.Native, size: int, at_complex: _core.Native | None = None) -> Callable[..., Array]:
    """Machine code as a Python function of (t, y, p) with `size` values; with other code for complex y."""
    kind = ctypes.CFUNCTYPE(None, ctypes.c_double, *[ctypes.c_void_p] * 3)
    codes = {"f": kind(fun.address)} if at_complex is None else {"f": kind(fun.address), "c": kind(at_complex.address)}

    def evaluate(t: float, y: Array, p: Array) -> Array:
        values = np.empty(size, y.dtype)
        y = np.ascontiguousarray(y)
        codes[y.dtype.kind](t, y.ctypes.data, values.ctypes.data, p.ctypes.data if len(p) else None)
        return values

    return evaluate


def condition_value(value: Any) -> Any:
    """The value of an event: a truth value, also in an array, is 1 or -1."""
    return np.where(value, 1.0, -1.0) if np.asarray(value).dtype == bool else value


def event_value(fun: Any, t: float, y: Array, p: Array) -> float:
    """The value of a native event, as `to_native` made it for the core, at one point."""
    call = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p)(fun.address)
    value: float = call(t, y.ctypes.data, p.ctypes.data if len(p) else None)
    return value


def renew(functions: Iterable[Any]) -> None:
    """Let compiled functions forget code that is older than what the functions have captured."""
    for one in functions:
        inside = one.fun if isinstance(one, NativeWithInputs) else one
        for function in (inside, *getattr(inside, "functions", ())):
            if isinstance(function, CompiledFunction):
                function.renew()


def native_parameters(args: tuple[Any, ...], functions: Iterable[Any]) -> ArgumentLayout:
    """Return the arguments of native functions, whose numbers they take; none if no function is native.

    Raises TypeError: They are not real numbers, and a function takes nothing else.
    """
    natives = [one for one in functions if is_native(one)] if args else []
    if not natives:
        return NO_ARGUMENTS
    found = layout_of(args)
    if any(isinstance(one, Constant) for one in found.entries) and not all(map(_takes_any, natives)):
        raise TypeError(f"args of native functions must be real numbers, got {shown(args)}") from None
    return found


def constants(functions: Iterable[Any], parameters: ArgumentLayout) -> int:
    """Up to which rank the numbers of the arguments are constants of the code of these functions."""
    traced = [one.fun if isinstance(one, NativeWithInputs) else one for one in functions]
    return max((one.constants(parameters) for one in traced if _takes_any(one)), default=TRUTHS)


def _takes_any(fun: Any) -> bool:
    return _takes_any(fun.fun) if isinstance(fun, NativeWithInputs) else getattr(fun, "_takes_any", False)
