"""Generated from METHODS: `make stubs`."""

from typing import Any, Literal, TypeAlias

OwnName: TypeAlias = Literal["ode23", "ode45", "dop853", "ode78", "ode89", "ode113", "ode15s", "ode23s", "ode23t", "ode23tb", "radau", "taylor", "auto", "rkn64", "rkn86", "rkn1210"]
MethodName: TypeAlias = OwnName | Literal["RK23", "RK45", "DOP853", "BDF", "Radau", "LSODA"] | type[Any]
