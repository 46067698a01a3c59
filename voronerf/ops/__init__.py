"""The operations: each one validates its arguments, chooses a backend and calls it.

Letters used throughout: n samples or points, k cells, d features, r rays, s samples of a ray, m packed samples, L
octaves. Index tensors are int32. ``offsets`` is always [k + 1]: cell c owns rows ``offsets[c]`` to ``offsets[c + 1]``
of arrays sorted by cell.

Each operation raises ValueError for wrong shapes or devices, numbers out of range and unknown backends, TypeError for
wrong dtypes, and `BackendUnavailable` if the named backend cannot run. Further errors are documented for each
operation.
"""

import sys
from types import ModuleType

from voronerf.ops._core.grids import HashGrid
from voronerf.ops._core.layers import MLP, Layer
from voronerf.ops.adam import Guard, UpdateRule, adam, average
from voronerf.ops.balance_centres import balance_centres
from voronerf.ops.cell_sort import cell_sort
from voronerf.ops.composite import Composite, composite
from voronerf.ops.draw_pixels import draw_pixels
from voronerf.ops.draw_pixels.reference import KnownPixels, PixelRuns
from voronerf.ops.draw_points import draw_points
from voronerf.ops.frequency_encode import frequency_encode
from voronerf.ops.grouped_linear import grouped_linear
from voronerf.ops.grouped_mlp import grouped_mlp
from voronerf.ops.grouped_program import grouped_program
from voronerf.ops.hash_encode import hash_encode
from voronerf.ops.integrated_encode import integrated_encode
from voronerf.ops.keep_heaviest import keep_heaviest
from voronerf.ops.locate_cell import locate_cell
from voronerf.ops.march_rays import March, march_rays
from voronerf.ops.nearest_centre import index_centres, nearest_centre
from voronerf.ops.network import Cells, Network, Tape
from voronerf.ops.observe_occupancy import observe_occupancy
from voronerf.ops.pixel_rays import PixelRays, pixel_rays
from voronerf.ops.ray_losses import smooth_depth_loss, sparse_depth_loss, surface_loss
from voronerf.ops.render_loss import RenderLoss, render_loss
from voronerf.ops.render_opaque import RenderedRays, render_opaque
from voronerf.ops.rendered_gradient import rendered_gradient
from voronerf.ops.resample import resample
from voronerf.ops.routed_mlp import routed_mlp
from voronerf.ops.routed_program import routed_program
from voronerf.ops.spherical_harmonics import spherical_harmonics
from voronerf.ops.unseen_rays import unseen_rays

__all__ = [
    "MLP",
    "Cells",
    "Composite",
    "Guard",
    "HashGrid",
    "KnownPixels",
    "Layer",
    "March",
    "Network",
    "PixelRays",
    "PixelRuns",
    "RenderLoss",
    "RenderedRays",
    "Tape",
    "UpdateRule",
    "adam",
    "average",
    "balance_centres",
    "cell_sort",
    "composite",
    "draw_pixels",
    "draw_points",
    "frequency_encode",
    "grouped_linear",
    "grouped_mlp",
    "grouped_program",
    "hash_encode",
    "index_centres",
    "integrated_encode",
    "keep_heaviest",
    "locate_cell",
    "march_rays",
    "nearest_centre",
    "observe_occupancy",
    "pixel_rays",
    "render_loss",
    "render_opaque",
    "rendered_gradient",
    "resample",
    "routed_mlp",
    "routed_program",
    "smooth_depth_loss",
    "sparse_depth_loss",
    "spherical_harmonics",
    "surface_loss",
    "unseen_rays",
]


class _Package(ModuleType):
    """The package of an op. It also sets its submodules as attributes of the op's function.

    In ``voronerf.ops``, the function of an op hides the package of the same name. Therefore, for example, ``import
    voronerf.ops.adam.reference as reference`` looks up ``reference`` in the function ``voronerf.ops.adam``.
    """

    def __setattr__(self, name: str, value: object) -> None:
        super().__setattr__(name, value)
        if isinstance(value, ModuleType):  # an imported submodule
            setattr(globals()[self.__name__.removeprefix(f"{__name__}.")], name, value)


for _op in __all__:
    if (_package := sys.modules.get(f"{__name__}.{_op}")) is not None:
        _package.__class__ = _Package
        for _name in [name for name in vars(_package) if f"{_package.__name__}.{name}" in sys.modules]:
            setattr(_package, _name, getattr(_package, _name))
