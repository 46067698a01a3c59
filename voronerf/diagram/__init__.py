"""Voronoi diagrams of space: nested look-up, balancing, subdivision, and a reservoir of samples."""

from voronerf.diagram.balance import Balance, balance, imbalance, uniform_centres
from voronerf.diagram.reservoir import SampleReservoir
from voronerf.diagram.subdivision import Split, split_diagram
from voronerf.diagram.voronoi import VoronoiDiagram

__all__ = [
    "Balance",
    "SampleReservoir",
    "Split",
    "VoronoiDiagram",
    "balance",
    "imbalance",
    "split_diagram",
    "uniform_centres",
]
