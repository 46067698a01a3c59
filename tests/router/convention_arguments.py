"""Fields with arguments per sample, per ray or for all samples, also in containers and objects."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from convention_harness import RAYS, Case, uniform
from torch import Tensor, nn


class CodePerRay(nn.Module):
    """A field that takes a view direction, a code and a time for each ray."""

    def __init__(self, code: int = 5) -> None:
        super().__init__()
        self.net = nn.Linear(3 + 3 + code + 1, 4)

    def forward(self, x: Tensor, d: Tensor, *, code: Tensor | None = None, time: Tensor | None = None) -> Tensor:
        parts = [x, d.expand_as(x), code[:, None].expand(*x.shape[:-1], -1)]
        return self.net(torch.cat([*parts, time[:, None, None].expand(*x.shape[:-1], 1)], -1))


@dataclass
class Frustums:
    origins: Tensor
    directions: Tensor
    starts: Tensor

    def positions(self) -> Tensor:
        return self.origins + self.directions * self.starts


@dataclass
class Samples:
    frustums: Frustums
    camera: Tensor
    name: str = "ray"
    metadata: dict[str, Any] = field(default_factory=dict)


class TakesSamples(nn.Module):
    """A field that takes samples as an object, and looks up a code for each camera."""

    def __init__(self) -> None:
        super().__init__()
        self.table, self.net = nn.Embedding(4, 2), nn.Linear(8, 3)

    def forward(self, samples: Samples) -> dict[str, Any]:
        positions = samples.frustums.positions()
        code = self.table(samples.camera[..., 0])
        h = self.net(torch.cat([positions, samples.frustums.directions, code], -1))
        return {"colour": h, "kept": Frustums(positions, h, h[..., :1]), "name": samples.name}


def samples(lead: tuple[int, ...]) -> Any:
    frustums = Frustums(uniform(lead), uniform(lead), uniform(lead, 1))
    return (Samples(frustums, torch.randint(4, (*lead, 1)), metadata={"none": None}),), {}


def positions_of(samples: Samples) -> Tensor:
    return samples.frustums.positions()


def per_ray(lead: tuple[int, ...]) -> Any:
    return (uniform(lead), uniform((lead[0], 1))), {"code": uniform(lead[:1], 5), "time": torch.rand(lead[:1])}


SAID = {"coords": "first3", "per_ray": ["d", "code", "time"]}
ARGUMENTS = [
    Case("rows of rays", CodePerRay, per_ray, lead=RAYS, fuses=True, rank=3),
    Case("rows of rays that are named", CodePerRay, per_ray, lead=RAYS, options=SAID, rank=3),
    Case("objects", TakesSamples, samples, positions_of, RAYS, {"coords": positions_of}, rank=3),
]
