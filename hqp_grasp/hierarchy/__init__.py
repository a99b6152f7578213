"""Strict hierarchies of least-squares problems: algebra that knows no robot."""

from hqp_grasp.hierarchy.compiled import announce

announce()
