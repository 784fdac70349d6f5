"""Runs: a plan that is carried out, once or for all problems of a kind."""
