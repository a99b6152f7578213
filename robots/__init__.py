"""Robots as data: one folder each, with its model, its names and the source of every number."""
