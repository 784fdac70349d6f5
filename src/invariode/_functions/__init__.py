"""What the users' functions become: native functions, machine code for lanes, derivatives without symbols."""
