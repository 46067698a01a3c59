"""VoronoiRouter: any module as one network per Voronoi cell."""

from voronerf.router.grouped import GroupedRun, PerCell, register
from voronerf.router.layered import LayeredField
from voronerf.router.router import VoronoiRouter

__all__ = ["GroupedRun", "LayeredField", "PerCell", "VoronoiRouter", "register"]
