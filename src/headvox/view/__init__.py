"""A run seen in rerun, from a process of its own: the loop hands frames over and never waits."""
