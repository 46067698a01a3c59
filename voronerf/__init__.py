"""Many small networks, one per Voronoi cell of space, as cheap to run and to train as one."""

__version__ = "0.1.0"
