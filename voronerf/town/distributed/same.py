"""What must be the same on all ranks before they begin: settings, code, scene."""

from __future__ import annotations

import dataclasses
import functools
import zlib
from pathlib import Path
from typing import Any

import torch

from voronerf.app.scenes import Scene
from voronerf.town.distributed.group import Group

#: Settings that machines may name in their own ways.
OWN = ("data", "device", "lpips")


def check_same(group: Group, config: Any) -> None:
    """Compares settings, a dataclass, and code of all ranks.

    Raises:
        ValueError: Names the first that differs.
    """
    fields = [field.name for field in dataclasses.fields(config) if field.name not in OWN]
    settings = {f"--{name.replace('_', '-')}": repr(getattr(config, name)) for name in fields}
    group.check_equal({"the code of voronerf": _code(), "the version of torch": torch.__version__, **settings})


def check_same_scene(group: Group, scene: Scene) -> None:
    """Compares cameras and the middle row of every image on all ranks; images may not fit into memory.

    Raises:
        ValueError: When they differ.
    """
    views = scene.train
    rows = views.images[:, views.images.shape[1] // 2]
    tensors = (rows, views.cameras.poses, views.cameras.intrinsics, scene.test.cameras.poses)
    found = [zlib.crc32(tensor.contiguous().cpu().numpy().data) for tensor in tensors]
    group.check_equal({"the scene": f"{scene.name} {'-'.join(f'{number:08x}' for number in found)}"})


@functools.cache
def _code() -> str:
    """A checksum of the package's sources."""
    root = Path(__file__).resolve().parents[2]
    found = functools.reduce(lambda so_far, path: zlib.crc32(path.read_bytes(), so_far), sorted(root.rglob("*.py")), 0)
    return f"{found:08x}"
