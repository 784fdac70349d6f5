"""Sensitivities: what is integrated beside y, and what happens to it where y or f jumps."""
