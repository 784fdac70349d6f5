"""Constrained mechanical systems: their equations of motion and consistent starts."""
