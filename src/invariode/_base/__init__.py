"""What every room uses: checks of arguments, their types, failures, files and locks, progress, notebooks, colours."""
