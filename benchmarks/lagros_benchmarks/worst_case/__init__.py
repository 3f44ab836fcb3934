"""The bounded disturbance that a policy stands worst: searched, flown again, kept in files."""
