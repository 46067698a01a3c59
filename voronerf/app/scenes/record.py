"""The file ``scene.json`` of a run directory: a scene's cameras and space, without its images.

With this file, a run can be rendered without the images. Its fields are named as in `Scene` and `Cameras`.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.files import json_text, read_json, write_text
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.scene import KINDS, Scene, Split
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.contraction import Contraction, Perspective

CONTRACTIONS = {"sphere": Contraction, "perspective": Perspective}
#: The choices of a scene's text fields.
WORDS = {"background": ("white", None), "kind": KINDS}
INTEGERS = {"sizes": torch.int64, "models": torch.int32}


def write_scene(path: Path, scene: Scene) -> None:
    """Writes a scene without its images."""
    values = {name: getattr(scene, name) for name in ("name", "near", "far", *WORDS)}
    for name in ("box", "transform"):
        values[name] = _plain(getattr(scene, name))
    if scene.contraction is not None:
        kind = next(name for name, cls in CONTRACTIONS.items() if isinstance(scene.contraction, cls))
        values["contraction"] = {"kind": kind, **_field_values(scene.contraction)}
    for part in ("train", "test"):
        split = getattr(scene, part)
        values[part] = {"names": list(split.names), **_field_values(split.cameras)}
    write_text(path, json_text(values) + "\n")


def placed(scene: Scene, other: Scene) -> Scene:
    """Returns the views of ``scene`` in the space of ``other``, a scene of the same place.

    Each folder of photographs has its own normalisation, computed from its cameras. The cameras of ``scene`` are moved
    into the normalised coordinates of ``other``.
    """
    if scene.background != other.background:
        ours, theirs = (each.background or "none" for each in (other, scene))
        raise SceneError(f"{scene.name}: background must be {ours}, as in {other.name}, got {theirs}")
    train, test = scene.train, scene.test
    motion = other.transform @ torch.linalg.inv(scene.transform)
    if not torch.allclose(motion, torch.eye(4, dtype=motion.dtype, device=motion.device), atol=1e-6):
        scale = float(torch.linalg.det(motion[:3, :3]).abs()) ** (1 / 3)
        train, test = (replace(part, cameras=part.cameras.moved(motion)) for part in (train, test))
        if train.sparse_depth is not None:
            seen = train.sparse_depth
            train = replace(train, sparse_depth=seen._replace(distances=scale * seen.distances))
    return replace(other, name=scene.name, notes=scene.notes, train=train, test=test)


def read_scene(path: Path) -> Scene:
    """Reads the file of :func:`write_scene`; the splits of the scene have no images."""
    try:
        values = read_json(path)
        words = {name: values[name] for name in WORDS}
        for name, word in words.items():
            if word not in WORDS[name]:
                raise ValueError(f"{name} must be one of {WORDS[name]}, got {word!r:.60}")
        near, far = float(values["near"]), float(values["far"])
        if not 0 <= near < far < float("inf"):
            raise ValueError(f"near and far must satisfy 0 <= near < far, got {near} and {far}")
        arguments = values.get("contraction")
        contraction = None if arguments is None else _build(CONTRACTIONS[arguments.pop("kind")], arguments)
        box = _tensor("box", values["box"])
        if box is not None and (box.shape != (2, 3) or not bool((box[0] < box[1]).all())):
            raise ValueError("box must be its lowest and highest corner")
        transform = _tensor("transform", values["transform"], torch.float64)
        if transform is None or transform.shape != (4, 4) or not torch.linalg.det(transform):
            raise ValueError(f"transform must be an invertible matrix [4, 4], got {values['transform']!r:.60}")
        train, test = _split(values["train"]), _split(values["test"])
        space: dict[str, Any] = {"near": near, "far": far, "box": box, "contraction": contraction}
        return Scene(name=str(values["name"]), train=train, test=test, transform=transform, **space, **words)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RuntimeError) as error:
        raise SceneError(f"{path}: is not the record of a scene: {error}") from None


def _split(values: dict[str, Any]) -> Split:
    names = tuple(map(str, values.pop("names")))
    if not all(isinstance(values[side], int) for side in ("width", "height")):
        raise ValueError(f"width and height must be integers, got {values['width']!r:.60}, {values['height']!r:.60}")
    cameras = _build(Cameras, values)
    if len(names) != len(cameras) or not names:
        raise ValueError(f"names must be as many as poses and at least one, got {len(names)} and {len(cameras)}")
    return Split(cameras, torch.empty(0, 1, 1, 3, dtype=torch.uint8, device="cpu"), names)


def _field_values(value: Any) -> dict[str, Any]:
    return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, Tensor) else value


def _build(kind: type, values: dict[str, Any]) -> Any:
    """Builds a dataclass of tensors and numbers from JSON values."""
    members = {name: _tensor(name, value) if isinstance(value, list) else value for name, value in values.items()}
    if "slopes" in members:
        members["slopes"] = tuple(values["slopes"])
    return kind(**members)


def _tensor(name: str, value: Any, dtype: torch.dtype = torch.float32) -> Tensor | None:
    if value is None:
        return None
    tensor = torch.tensor(value, dtype=INTEGERS.get(name, dtype), device="cpu")
    if not bool(tensor.isfinite().all()):
        raise ValueError(f"{name} must be finite")
    return tensor
