"""Scenes made of several runs."""

from voronerf.editing.edits import cut, join, place
from voronerf.editing.geometry import Similarity, Solid
from voronerf.editing.run import open_run

__all__ = ["Similarity", "Solid", "cut", "join", "open_run", "place"]
