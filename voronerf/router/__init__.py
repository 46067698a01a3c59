"""VoronoiRouter, which makes one network per Voronoi cell from any module."""

from voronerf.router.grouped import register
from voronerf.router.program import CellProgram, layered_program
from voronerf.router.router import VoronoiRouter

__all__ = ["CellProgram", "VoronoiRouter", "layered_program", "register"]
