"""Gradients of functions of a solution by the adjoint equations, which are integrated backwards."""
