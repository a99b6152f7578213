"""Strict hierarchies of least-squares problems: algebra that knows no robot."""
