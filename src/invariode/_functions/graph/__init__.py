"""Expression graphs: nodes, their derivatives, and the same graph as Python's code and as machine code."""
