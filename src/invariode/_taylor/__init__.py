"""Taylor series of a solution, and of events and conditions along it."""
