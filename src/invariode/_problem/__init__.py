"""Statement of a problem: f, invariants, events, inputs, breakpoints, bounds; the table of options; the methods."""
