"""Plans: a problem with a method and its options, checked, in the form that the core takes; and runs step by step."""
