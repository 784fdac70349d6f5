"""A plan, and how it is carried out: the run itself, its checkpoints, what tells one run from another."""
