"""VoronoiRouter: any module as one network per Voronoi cell."""

from voronerf.router.router import LayeredField, VoronoiRouter

__all__ = ["LayeredField", "VoronoiRouter"]
