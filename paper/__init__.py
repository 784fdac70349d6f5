"""The numerical experiments of the paper, run again: section 6 of L. F. Shampine, Conservation laws and the numerical
solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72.

`run` solves everything and holds each published number against the one computed here; `report` makes the page.
"""

from invariode.problems import lotka_volterra, pendulum, three_body

from .experiments import Results, run
from .report import report
from .rows import Row

__all__ = ["Results", "Row", "lotka_volterra", "pendulum", "report", "run", "three_body"]
