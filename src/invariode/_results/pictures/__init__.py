"""Pictures, one module for each kind; the methods of results call them. Needs the extra `plot`."""
