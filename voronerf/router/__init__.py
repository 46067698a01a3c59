"""VoronoiRouter: any module as one network per Voronoi cell; several of them in one scene."""

from voronerf.router.grouped import register
from voronerf.router.parts import Part, Parts, Similarity, Solid
from voronerf.router.router import VoronoiRouter
from voronerf.router.table import LayeredField

__all__ = ["LayeredField", "Part", "Parts", "Similarity", "Solid", "VoronoiRouter", "register"]
