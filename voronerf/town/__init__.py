"""Scenes made of several runs, and distributed training in territories."""

from voronerf.town.editing import cut, join, place
from voronerf.town.geometry import Similarity, Solid
from voronerf.town.run import open_run

__all__ = ["Similarity", "Solid", "cut", "join", "open_run", "place"]
