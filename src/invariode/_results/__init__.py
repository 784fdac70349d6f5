"""What comes back from a run: solutions, messages, files, pictures and films."""
