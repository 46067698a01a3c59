"""Converts the glTF output of trimesh to the conventions of glTF 2.0.

glTF has +Y up (section 3.4), linear colours (3.9.2), and a metallic default material (5.19). voronerf's geometry has z
up and sRGB colours, and trimesh writes both unchanged.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_SRGB = np.arange(256) / 255
#: The linear value of each sRGB byte (IEC 61966-2-1).
LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
#: The material of meshes with vertex colours: matt, and double-sided for open surfaces.
MATT = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
#: glTF's name for uint16.
UNSIGNED_SHORT = 5123


def follow_conventions(buffers: dict[Any, bytes], tree: dict[str, Any]) -> None:
    """Turns +Z into +Y, makes colours linear, and gives meshes with vertex colours a material.

    This is a ``buffer_postprocessor`` of ``trimesh.exchange.gltf.export_glb``. Linear vertex colours get 16 bits, since
    8 bits would merge a quarter of the sRGB values (the dark ones) with other values.

    Args:
        buffers: The bytes of each buffer view; changed in place.
        tree: The JSON, whose accessors are an ordered dictionary; changed in place.
    """
    accessors, keys = [*tree["accessors"].values()], [*buffers]
    primitives = [primitive for mesh in tree["meshes"] for primitive in mesh["primitives"]]
    for index, name in {index: name for part in primitives for name, index in part["attributes"].items()}.items():
        accessor = accessors[index]
        key = keys[accessor["bufferView"]]
        values: NDArray[Any]
        if name == "COLOR_0":
            colours = np.frombuffer(buffers[key], np.uint8).reshape(-1, 4)
            values = np.concatenate((LINEAR[colours[:, :3]], colours[:, 3:] / 255), 1)
            values = (values * 65535).round().astype("<u2")
            accessor["componentType"] = UNSIGNED_SHORT
        else:  # POSITION and NORMAL
            x, y, z = np.frombuffer(buffers[key], "<f4").reshape(-1, 3).T
            values = np.stack((x, z, -y), 1)
        buffers[key] = values.tobytes()
        accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
    for material in tree["materials"]:
        factor = material["pbrMetallicRoughness"]["baseColorFactor"]
        factor[:3] = [float(LINEAR[round(255 * value)]) for value in factor[:3]]
    for part in primitives:
        if "COLOR_0" in part["attributes"]:
            part["material"] = len(tree["materials"])
            tree["materials"].append(MATT)
