"""Networks from positions and directions to colours and densities; they know nothing of rays or images."""

from voronerf.fields.density import DensityField, density_table
from voronerf.fields.kilonerf import KiloNeRF
from voronerf.fields.mipnerf import MipNeRF
from voronerf.fields.nerf import NeRF, nerf_table

__all__ = ["DensityField", "KiloNeRF", "MipNeRF", "NeRF", "density_table", "nerf_table"]
