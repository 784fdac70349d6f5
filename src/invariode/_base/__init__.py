"""Helpers for every room: checks of arguments, their types, failures, files and locks, progress, notebooks, colours."""
