"""Robots as data: one folder each."""
