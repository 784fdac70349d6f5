"""Machine code of Python functions by numba: the function that it compiles for the arguments of the core."""

from __future__ import annotations

import cmath
import inspect
import math
from collections.abc import Callable
from types import BuiltinFunctionType, FunctionType
from typing import Any

import numpy as np

from .._base.package import extra
from .forms import FirstOrderForm
from .layout import Shape

#: Longer tuples, with values of one type, are stored by a loop, which compiles faster.
_UNROLLED = 32


def _with_complex_math(fun: Callable[..., Any]) -> Callable[..., Any]:
    """The function with cmath in place of math, so that it takes complex numbers. What cmath does not have stays."""
    if not isinstance(fun, FunctionType):
        return fun

    def complex_one(value: Any) -> Any:
        if value is math:
            return cmath
        known = getattr(value, "__module__", None) == "math" and isinstance(value, BuiltinFunctionType)
        return getattr(cmath, value.__name__, value) if known else value

    used = {name: complex_one(fun.__globals__[name]) for name in fun.__code__.co_names if name in fun.__globals__}
    replaced = FunctionType(fun.__code__, {**fun.__globals__, **used}, fun.__name__, fun.__defaults__, fun.__closure__)
    replaced.__kwdefaults__ = fun.__kwdefaults__
    return replaced


def numba_or_say_so() -> Any:
    return extra("numba", "invariode.compile needs", "compiled")


class NumbaCode:
    """A Python function of (t, y, *args) and what numba makes of it.

    - `fun`, `inplace`: the function, and whether it fills an output array
    """

    fun: Callable[..., Any]
    inplace: bool
    __name__: str
    _jitted: Any  # the function as numba compiles it; None: not yet
    _jitted_complex: Any  # for complex numbers

    def _make(self, shape: Shape) -> Any:
        """Compile the function for a shape. Its array arguments are read-only; a function that numba does not compile
        for these, because it writes to them or passes them to a function of a fixed signature, gets copies."""
        refused = numba_or_say_so().core.errors.NumbaError, AttributeError  # of y *= 2, which it has for no such array
        try:
            return self._code(shape, copies=False)
        except refused:
            try:
                return self._code(shape, copies=True)
            except refused as error:
                raise self._cannot_compile(error, shape.parameters.size) from error

    def _code(self, shape: Shape, *, copies: bool) -> Any:
        """numba's code, whose arguments are read-only or copies."""
        from .numba_additions import condition, copied, read_only

        numba = numba_or_say_so()
        jitted = self._jit(shape.is_complex)
        count = shape.parameters.size
        half = shape.size // 2 if isinstance(self.fun, FirstOrderForm) else 0
        names = ["t", *shape.vectors, *(["out"] if self.inplace and not shape.event else [])]
        names += ["p"] if count else []
        self._check_call(names)
        call = f"f({', '.join(f'y[:{half}]' if half and name == 'y' else name for name in names)})"
        body = [*shape.unpacked(), *([f"p = given(carray(p_, ({count},)))"] if count else [])]
        if shape.event:
            head = "def code(t, y_, p_):"
            body += ["try:", f"    return condition({call})", "except Exception:", "    return nan"]
        else:
            head = f"def code({'t_' if shape.complex_time else 't'}, y_, out_, p_):"
            body += [f"out = carray(out_, ({shape.size},))", "out[:] = nan"]  # what is not filled is not evaluated
            body += ["try:", f"    r = {call}", "except Exception:", "    out[:] = nan", "    return"]
            if half:  # not as slices: to say that their lengths differ numba would compile its strings, for seconds
                body += [f"for i in range({half}):", f"    out[i] = y[{half} + i]", f"out = out[{half}:]"]
            body += [] if self.inplace else self._stores(self._result(jitted, shape, copies), shape.size - half)
        text = "\n    ".join([head, *body])
        given = copied if copies else read_only
        namespace: dict[str, Any] = {"f": jitted, "carray": numba.carray, "given": given, "nan": np.nan}
        namespace["condition"] = condition
        exec(text, namespace)
        number = numba.types.complex128 if shape.is_complex else numba.types.double
        double, pointer, numbers = (
            numba.types.double,
            numba.types.CPointer(numba.types.double),
            numba.types.CPointer(number),
        )
        signature = double(double, pointer, pointer) if shape.event else numba.void(double, numbers, numbers, pointer)
        return numba.cfunc(signature, error_model="numpy")(namespace["code"])

    def _jit(self, is_complex: bool) -> Any:
        """Return the function as numba compiles it, with 1/0 = inf and no exceptions; for a first-order form, its
        accelerations.

        An index beyond an array raises an IndexError, which `_code` turns into NaN. Inlined, where the sizes of y and p
        are known, the function loses most of these tests: kepler, 0 %, the heat equation (n = 1000), 0 %, a loop over
        pairs of components (n = 1000), 15 % of a run. NUMBA_BOUNDSCHECK=0 in the environment switches them off."""
        numba = numba_or_say_so()
        fun = self.fun.fun if isinstance(self.fun, FirstOrderForm) else self.fun
        fun = getattr(fun, "py_func", fun)
        # Only the code made of it calls it: without what calls from Python and C need it compiles in half the time.
        options = {"error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        options |= {"boundscheck": True, "forceinline": True}
        if is_complex:
            if self._jitted_complex is None:
                from .numba_additions import ComplexCompiler

                self._jitted_complex = numba.njit(pipeline_class=ComplexCompiler, **options)(_with_complex_math(fun))
            return self._jitted_complex
        if self._jitted is None:
            self._jitted = numba.njit(**options)(fun)
        return self._jitted

    def _check_call(self, names: list[str]) -> None:
        """Raise a TypeError unless the function takes these arguments; numba's message would give only their number."""
        try:
            inspect.signature(self.fun).bind(*names)
        except TypeError as error:
            form = "with args it is" if "p" in names else "without args it is"
            raise TypeError(f"compile({self.__name__}): {error}; {form} f({', '.join(names)})") from None

    def _stores(self, result: Any, size: int) -> list[str]:
        """Lines that store the result r, of numba's type `result`, in `out`."""
        types = numba_or_say_so().types
        if isinstance(result, types.Array) and result.ndim > 1:
            return [
                f"if r.size == {size}:",
                "    k = 0",
                "    for e in r.flat:",
                "        out[k] = e",
                "        k += 1",
            ]
        if isinstance(result, types.BaseTuple) and any(isinstance(row, types.BaseTuple) for row in result):
            return self._stores_of_rows(result, size)
        if isinstance(getattr(result, "dtype", None), (types.Array, types.List, types.ListType, types.BaseTuple)):
            return [
                "k = 0",
                "for row in r:",
                f"    k += len(row) if len(row) == len(r[0]) else {size + 1}",
                f"if k == {size}:",
                "    k = 0",
                "    for row in r:",
                "        for e in row:",
                "            out[k] = e",
                "            k += 1",
            ]
        if isinstance(result, (types.Array, types.List, types.ListType)):
            return [f"if len(r) == {size}:", f"    for i in range({size}):", "        out[i] = r[i]"]
        returned = len(result) if isinstance(result, types.BaseTuple) else 1
        if returned != size or isinstance(result, types.NoneType):
            what = "nothing" if isinstance(result, types.NoneType) else f"{returned} value{'s' * (returned != 1)}"
            raise TypeError(f"compile({self.__name__}): the function returns {what}, expected {size}")
        if not isinstance(result, types.BaseTuple):
            return ["out[0] = r"]
        if isinstance(result, types.UniTuple) and size > _UNROLLED:
            return [f"for i in range({size}):", "    out[i] = r[i]"]
        return [f"out[{i}] = r[{i}]" for i in range(size)]

    def _stores_of_rows(self, result: Any, size: int) -> list[str]:
        """Return the statements that store the entries of a tuple of rows, each a tuple, in the output."""
        lengths = [len(row) if isinstance(row, numba_or_say_so().types.BaseTuple) else 1 for row in result]
        if len(set(lengths)) > 1 or not all(isinstance(row, numba_or_say_so().types.BaseTuple) for row in result):
            raise TypeError(
                f"compile({self.__name__}): the function returns rows of {', '.join(map(str, lengths))} values: "
                "return rows of one length"
            )
        rows, columns = len(lengths), lengths[0]
        if rows * columns != size:
            what = f"{rows} rows of {columns} values"
            raise TypeError(f"compile({self.__name__}): the function returns {what}, expected {size} values")
        return [f"out[{i * columns + j}] = r[{i}][{j}]" for i in range(rows) for j in range(columns)]

    def _result(self, jitted: Any, shape: Shape, copies: bool) -> Any:
        """numba's type of what the function returns."""
        numba = numba_or_say_so()
        number = numba.types.complex128 if shape.is_complex else numba.types.double
        vector, values = (numba.types.Array(kind, 1, "C", readonly=not copies) for kind in (number, numba.types.double))
        time = number if shape.complex_time else numba.types.double
        arguments = (time, *([vector] * len(shape.vectors)), *([values] if shape.parameters.size else []))
        try:
            jitted.compile(arguments)
        except numba.core.errors.NumbaError:
            raise
        except TypeError as error:
            raise self._cannot_compile(error, shape.parameters.size) from error
        return jitted.overloads[arguments].signature.return_type

    def _cannot_compile(self, error: Exception, parameters: int = 0) -> TypeError:
        text = f"compile({self.__name__}): numba cannot compile this function: {error}"
        if parameters > 0:
            text += f"\nWith args a compiled function is f(t, y, p), p an array of {parameters}: p[0] is the first"
        return TypeError(text)
