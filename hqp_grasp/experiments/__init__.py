"""Trials, studies, scenarios, and what they leave to look at."""
