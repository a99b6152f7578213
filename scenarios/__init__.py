"""Recipes: one file per object; each declares a scene, a stack and a trial, and runs them."""
