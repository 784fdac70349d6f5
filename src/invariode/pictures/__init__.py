"""Pictures, a room for each kind of them; the methods of results call them. Needs the extra `plot`."""
