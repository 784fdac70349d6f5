"""The command in a process of tests, and the problem files that it reads."""

from __future__ import annotations

from typer.testing import CliRunner

import invariode as iv
from invariode.cli.app import app

FILES = {
    "pendulum.py": """
import invariode as iv

def pendulum(t, y):
    x, z, u, v = y
    tension = (u * u + v * v - z) / (x * x + z * z)
    return [u, v, -tension * x, -tension * z - 1]

def rod(t, y):
    x, z, u, v = y
    return [x * x + z * z - 1, x * u + z * v]

problem = iv.Problem(pendulum, (0, 10), [1, 0, 0, 0], name="pendulum",
                     invariants=iv.Invariants(rod, value=0, names=["length", "tangent"]))
""",
    "prey.py": """
import numpy as np
import invariode as iv

def prey(t, y):
    return [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])]

def orbit(t, y):
    return y[0] - np.log(y[0]) + 2 * (y[1] - np.log(y[1]))

def sum_of_both(t, y):
    return y[0] + y[1]

closed = iv.Problem(prey, (0, 10), [1, 3], invariants=orbit, name="Lotka-Volterra")
free = iv.Problem(prey, (0, 10), [1, 3], name="free")
wrong = iv.Problem(prey, (0, 10), [1, 3], invariants=[orbit, sum_of_both])
twice = iv.Problem(prey, (0, 10), [1, 3], invariants=[orbit, lambda t, y: 2 * orbit(t, y)])
""",
    "only.py": """
import invariode as iv
oscillator = iv.Problem(lambda t, y: [y[1], -y[0]], (0, 1), [1, 0], name="oscillator")
same = oscillator
if __name__ == "__main__":
    raise AssertionError("it is not run as a script")
""",
    "sink.py": """
import invariode as iv

def decay(t, y):
    return [-abs(y[0]), abs(y[0])]

sink = iv.Problem(decay, (0, 30), [1, 0], labels=["A", "B"], invariants=lambda t, y: y[0] + y[1])
swing = iv.Problem(lambda t, y: [y[1], -y[0]], (0, 10), [1, 0], invariants=lambda t, y: y @ y)
""",
    "broken.py": "import invariode\n\ndef helper():\n    raise RuntimeError('no data')\n\nhelper()\n",
    "syntax.py": "def f(:\n",
    "exits.py": "raise SystemExit(3)\n",
    "nothing.py": "import numpy as np\nstep = 3\ndef f(t, y):\n    return y\n",
    "stiff.py": """
import numpy as np
import invariode as iv

def rates(t, y):
    a, b, c = y
    return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b * b, 3e7 * b * b]

def dae(t, y):
    return [*rates(t, y)[:2], y.sum() - 1]

problem = iv.Problem(rates, (0, 4e6), [1, 0, 0], invariants=lambda t, y: y[0] + y[1] + y[2], name="Robertson")
algebraic = iv.Problem(dae, (0, 40), [1, 0, 0], mass=np.diag([1, 1, 0]), name="DAE")
""",
    "faulty.py": """
import time
import numpy as np
import invariode as iv

def raises(t, y):
    if t > 3:
        raise ZeroDivisionError("boom")
    return [y[1], -y[0]]

def stops(t, y):
    if t > 3:
        raise KeyboardInterrupt
    return [y[1], -y[0]]

def fall(t, y):
    return [y[1], -1]

def slow(t, y):
    print("f", flush=True)
    time.sleep(0.01)
    return [-y[0]]

raising = iv.Problem(raises, (0, 10), [1, 0])
interrupted = iv.Problem(stops, (0, 10), [1, 0])
blowing_up = iv.Problem(lambda t, y: y**2, (0, 2), [1], name="y' = y²")
endless = iv.Problem(fall, (0, np.inf), [1, 0], events=iv.Event(lambda t, y: y[0], terminal=True), name="fall")
slow = iv.Problem(slow, (0, 1000), [1])
""",
}


def invariode(*arguments: str, width: int = 80):
    return CliRunner().invoke(app, [str(one) for one in arguments], env={"COLUMNS": str(width)})


def flat(text: str) -> str:
    """Without line breaks and the frame around error messages."""
    return " ".join(text.replace("│", " ").split())


def problem(name: str = "pendulum.py", of: str = "problem") -> iv.Problem:
    namespace: dict[str, object] = {"__name__": "test"}
    exec(FILES[name], namespace)
    return namespace[of]
