"""Forms of the users' functions: native functions, machine code for lanes, derivatives without symbols."""
