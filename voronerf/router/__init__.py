"""VoronoiRouter: any module as one network per Voronoi cell."""

from voronerf.router.grouped import register
from voronerf.router.router import VoronoiRouter
from voronerf.router.table import LayeredField

__all__ = ["LayeredField", "VoronoiRouter", "register"]
