"""Grasping by touch, with control laws in strict order and within a robot's limits."""
