"""Results of runs: solutions, messages, files, pictures and films."""
