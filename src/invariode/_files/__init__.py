"""Checkpoints, and what tells one run from another: by its data, and by the code of its functions."""
