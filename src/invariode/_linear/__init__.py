"""Jacobians and mass matrices in the form the core takes: patterns, null spaces, Krylov methods, complex steps."""
