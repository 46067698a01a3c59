"""The conventions of glTF 2.0, for what trimesh writes of geometry with z up and colours as in pictures.

glTF has +Y up (section 3.4), linear colours (3.9.2) and a metallic material where a mesh names none (5.19). trimesh
writes positions and colours as they are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_SRGB = np.arange(256) / 255
#: The linear value of each byte of a picture, in sRGB (IEC 61966-2-1).
LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
#: The material of meshes with vertex colours: matt, and seen from behind too, where a surface is open.
MATT = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
#: glTF's name for uint16.
UNSIGNED_SHORT = 5123


def follow_conventions(buffers: dict[Any, bytes], tree: dict[str, Any]) -> None:
    """Turns +Z into +Y, makes colours linear, and gives meshes with vertex colours a material.

    It is a ``buffer_postprocessor`` of ``trimesh.exchange.gltf.export_glb``. Vertex colours become 16 bits, since in 8
    a quarter of the bytes of a picture, the dark ones, would fall together.

    Args:
        buffers: The bytes of each buffer view.
        tree: The JSON, whose accessors are a dictionary of their order.
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
