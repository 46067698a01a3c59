"""Networks from positions and directions to colours and densities; they know nothing of rays or images."""

from voronerf.fields.kilonerf import KiloNeRF
from voronerf.fields.nerf import NeRF, nerf_table

__all__ = ["KiloNeRF", "NeRF", "nerf_table"]
