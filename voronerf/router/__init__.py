"""VoronoiRouter: any module as one network per Voronoi cell."""

from voronerf.router.fused import LayeredField
from voronerf.router.grouped import register
from voronerf.router.router import VoronoiRouter

__all__ = ["LayeredField", "VoronoiRouter", "register"]
