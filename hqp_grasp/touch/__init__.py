"""The door that a hand fits, and the probes behind it."""
