"""Networks from positions and directions to colours and densities. They do not depend on rays or images."""

from voronerf.nerf.fields.hashgrid import HashGridField
from voronerf.nerf.fields.nerf import KiloNeRF, MipNeRF, NeRF
from voronerf.nerf.fields.registry import FIELDS, FieldType, register_field

register_field("nerf")(NeRF)
register_field("mipnerf")(MipNeRF)
register_field("kilonerf")(KiloNeRF)
register_field("hashgrid")(HashGridField)

__all__ = ["FIELDS", "FieldType", "HashGridField", "KiloNeRF", "MipNeRF", "NeRF", "register_field"]
