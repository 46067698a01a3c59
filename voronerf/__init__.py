"""Many small networks, one per Voronoi cell of space, as cheap to run and to train as one."""

# Some functions have the name of their module.
# mypy: disable-error-code="no-redef"

__version__ = "0.1.0"

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from voronerf.diagram import (
        Balance,
        SampleReservoir,
        Split,
        VoronoiDiagram,
        balance,
        imbalance,
        split_diagram,
        uniform_centres,
    )
    from voronerf.nerf import OccupancyGrid
    from voronerf.nerf.fields import HashGridField, NeRF
    from voronerf.ops import (
        Composite,
        cell_sort,
        composite,
        frequency_encode,
        grouped_linear,
        grouped_mlp,
        hash_encode,
        integrated_encode,
        locate_cell,
        march_rays,
        nearest_centre,
        resample,
        routed_mlp,
        spherical_harmonics,
    )
    from voronerf.ops._core.backends import BackendUnavailable
    from voronerf.ops._core.grids import HashGrid
    from voronerf.ops._core.layers import MLP, Layer
    from voronerf.router import VoronoiRouter

__all__ = [
    "MLP",
    "BackendUnavailable",
    "Balance",
    "Composite",
    "HashGrid",
    "HashGridField",
    "Layer",
    "NeRF",
    "OccupancyGrid",
    "SampleReservoir",
    "Split",
    "VoronoiDiagram",
    "VoronoiRouter",
    "balance",
    "cell_sort",
    "composite",
    "frequency_encode",
    "grouped_linear",
    "grouped_mlp",
    "hash_encode",
    "imbalance",
    "integrated_encode",
    "locate_cell",
    "march_rays",
    "nearest_centre",
    "resample",
    "routed_mlp",
    "spherical_harmonics",
    "split_diagram",
    "uniform_centres",
]

_PARTS = ("diagram", "nerf", "ops", "router")
_PLACES = (*_PARTS, "nerf.fields", "ops._core.backends", "ops._core.grids", "ops._core.layers")


def __getattr__(name: str) -> Any:
    """Imports a public name at its first use, so that the program can set the OpenMP wait policy before torch loads."""
    if name not in __all__ and name not in _PARTS:
        raise AttributeError(f"module 'voronerf' has no attribute {name!r}")
    try:
        import torch  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise ImportError("voronerf needs PyTorch 2.9 or newer, which is not installed: pip install torch") from None
    if name in _PARTS:
        return import_module(f"voronerf.{name}")
    modules = (import_module(f"voronerf.{place}") for place in _PLACES)
    globals()[name] = value = next(vars(module)[name] for module in modules if name in vars(module))
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_PARTS})
