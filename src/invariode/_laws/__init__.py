"""Invariants bound to a problem, and points imposed on them."""
