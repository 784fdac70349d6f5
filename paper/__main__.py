"""`python -m paper` runs the experiments of the paper. Needs the extra `paper`."""

from .command import app

app(prog_name="paper")
