"""A field on a hash grid: Instant NGP, with a small network for each cell. Units as in `voronerf.nerf.fields.nerf`."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from torch import nn

from voronerf.nerf.fields.radiance import INITIAL_DENSITY, RadianceField, reset_layers
from voronerf.ops._core.checks import physical_memory
from voronerf.ops._core.grids import UNIT_CUBE, HashGrid
from voronerf.ops._core.layers import MLP, Layer

#: The initial bias of the hidden layers. The features are near zero at first. With a bias of zero, each unit would be
#: at the kink of its ReLU, and the first steps could switch off a whole layer: one seed in seven lost its colours.
HIDDEN_BIAS = 0.3

#: The base-2 logarithm of the number of entries of a level in contracted space, for a short training and for a training
#: of at least `LONG` seconds. A larger table takes longer to read and to train, so it is better only in long trainings.
CONTRACTED_ENTRIES, LONG_ENTRIES, LONG = 17, 19, 25.0

#: The density scale in contracted space.
CONTRACTED_DENSITY = 40.0

#: The density scale and the initial density in a box whose longest side is 1; other boxes divide both by their longest
#: side. A thinner initial field learns more slowly: a dark object may get a single colour while the field is still
#: almost transparent.
BOX_DENSITY, BOX_INITIAL = 200.0, 2.0

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


class HashGridField(RadianceField):
    """A hash grid followed by a small network (Müller et al. 2022, section 5.4).

    A layer of ``width`` channels reads the features of the position. A linear head gives the density. A second layer,
    which also sees the view direction, gives the colour through a linear head.

    In :class:`voronerf.VoronoiRouter` the cells share the grid (``share=["features"]``), and each cell has its own
    network, which resolves hash collisions between cells. Without ``share``, each cell has its own table.

    Args:
        width: Channels of the hidden layers, at least 2.
        depth: Hidden layers before the heads, at least 1.
        levels: The number of resolutions of the grid, 1 to 24.
        level_features: Features of a level: 1, 2, 4 or 8.
        log2_entries: The base-2 logarithm of the maximum number of entries of a level, 10 to 24.
        base: The coarsest resolution.
        finest: The finest resolution.
        box: The lowest and the highest corner of the grid; None is the unit cube.
        direction_octaves: Octaves of the encoding of the view direction.
        view_directions: Whether colour depends on the view direction.
        density_scale: Factor on the density, per scene unit, > 0.
        initial_density: The density of the untrained field, per scene unit, > 0.

    Raises:
        ValueError: A size is out of range, or the table does not fit into memory.

    Examples:
        >>> import torch
        >>> from voronerf import HashGridField, VoronoiRouter
        >>> field = HashGridField(width=32, log2_entries=12)
        >>> router = VoronoiRouter(field, torch.rand(16, 3), share=["features"])
        >>> router.module.features.shape[1], router.module.trunk[0].weight.shape  # one table, 16 networks
        (2, torch.Size([16, 32, 16]))
        >>> colour, density = router(torch.rand(10, 3), torch.nn.functional.normalize(torch.rand(10, 3), dim=-1))
        >>> colour.shape, density.shape
        (torch.Size([10, 3]), torch.Size([10]))
    """

    router_options: ClassVar[dict[str, Any]] = {"share": ["features"]}
    sparse_parameters = ("features",)
    ray_growth = 8.0
    lr_hold = 0.25

    def __init__(
        self,
        width: int = 32,
        depth: int = 1,
        levels: int = 8,
        level_features: int = 2,
        log2_entries: int = 15,
        base: float = 16,
        finest: float = 256,
        box: Box | None = None,
        direction_octaves: int = 2,
        view_directions: bool = True,
        density_scale: float = 10.0,
        initial_density: float = INITIAL_DENSITY,
    ) -> None:
        super().__init__()
        if width < 2 or depth < 1:
            raise ValueError(f"HashGridField: width must be at least 2 and depth 1, got {width} and {depth}")
        if direction_octaves < 0:
            raise ValueError(f"HashGridField: direction_octaves must not be negative, got {direction_octaves}")
        if not density_scale > 0:
            raise ValueError(f"HashGridField: density_scale must be positive, got {density_scale}")
        if not initial_density > 0:
            raise ValueError(f"HashGridField: initial_density must be positive, got {initial_density}")
        grid = HashGrid(levels, level_features, log2_entries, base, finest, box or UNIT_CUBE)
        trunk = [Layer(("positions",) if i == 0 else (i - 1,), width, "relu") for i in range(depth)]
        view: tuple[int | str, ...] = (depth - 1, "directions") if view_directions else (depth - 1,)
        heads = [Layer((depth - 1,), 1), Layer(view, width, "relu"), Layer((depth + 1,), 3)]
        self.view_directions, self.density_scale = view_directions, density_scale
        self.initial_density = initial_density
        self.layers = MLP(
            (*trunk, *heads),
            outputs=(depth + 2, depth),
            direction_octaves=direction_octaves if view_directions else None,
            position_encoding="hash",
            grid=grid,
        )
        size, memory = 4 * math.prod(grid.table_shape), physical_memory()
        if size > memory:
            raise ValueError(
                f"HashGridField: log2_entries must be smaller: {levels} levels of {level_features} features and up to "
                f"2^{log2_entries} entries take {size / 2**20:.1f} MiB, the machine has {memory / 2**20:.1f}"
            )
        self.features = nn.Parameter(torch.empty(grid.table_shape, device=torch.get_default_device()))
        linears = [nn.Linear(i, o) for o, i in self.layers.weight_shapes(3, 3)]
        self.trunk = nn.ModuleList(linears[:depth])
        self.density, self.view, self.colour = linears[depth:]
        self.reset_parameters()

    @staticmethod
    def learning_rate(**_: object) -> float:
        """Returns Adam's initial learning rate: twice the published rate, for faster training on all tested scenes."""
        return 0.02

    @staticmethod
    def scene_options(pixel: float, box: Box, contracted: bool, seconds: float) -> dict[str, Any]:
        """Returns options for a scene: the grid covers the box, with finer cells and more entries for larger images.

        In a box, the finest cells are half a pixel wide. The number of cells on a surface grows with the square of the
        resolution. The number of entries grows more slowly, from 2^15 for an object of 88 pixels to 2^18 for 353
        pixels, since larger tables take longer to read and to learn. The density scale is inverse to the size of the
        box.

        In contracted space, most surfaces are farther away than the middle of the scene, where the pixel width is
        measured. So the finest cells are one pixel wide, with 2^17 entries, or 2^19 in a training of at least 25
        seconds. Surfaces are thinner relative to the whole space, so the density scale is larger.
        """
        side = max(high - low for low, high in zip(*box))
        pixels = side / pixel
        finest, entries = round((1 if contracted else 2) * pixels), round(1.5 * math.log2(pixels) + 5.3)
        large = LONG_ENTRIES if seconds >= LONG else CONTRACTED_ENTRIES
        options = {
            "box": box,
            "finest": max(finest, 32),
            "log2_entries": large if contracted else min(max(entries, 14), 19),
        }
        if contracted:
            return {**options, "density_scale": CONTRACTED_DENSITY}
        return {**options, "density_scale": BOX_DENSITY / side, "initial_density": BOX_INITIAL / side}

    def reset_parameters(self) -> None:
        """Initialises features near zero, as published, and layers by `voronerf.nerf.fields.radiance.reset_layers`."""
        nn.init.uniform_(self.features, -1e-4, 1e-4)
        reset_layers(self.linears(), [self.density, self.colour], self.density_scale, self.initial_density)
        for layer in (*self.linears()[:-3], self.view):
            nn.init.constant_(layer.bias, HIDDEN_BIAS)

    def linears(self) -> list[nn.Linear]:
        """Returns the linear layers in the order of ``layers``."""
        trunk = [layer for layer in self.trunk if isinstance(layer, nn.Linear)]
        return [*trunk, self.density, self.view, self.colour]
