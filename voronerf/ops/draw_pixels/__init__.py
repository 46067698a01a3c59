"""Pixels of a step, drawn by a hash of its number."""
