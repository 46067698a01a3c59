"""Networks from positions and directions to colours and densities; they know nothing of rays or images."""

from voronerf.fields.nerf import NeRF

__all__ = ["NeRF"]
