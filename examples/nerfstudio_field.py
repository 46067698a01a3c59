"""A field of nerfstudio: `Field.forward(ray_samples)` returns a dictionary whose keys are an Enum.

`RaySamples` holds the positions, so `positions_of` reads them from the arguments. Models also call `get_density` and
`get_outputs` directly, and occupancy grids call `density_fn(positions)`. All of these methods are routed.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf import VoronoiRouter


class FieldHeadNames(Enum):
    """A stand-in for `field_components.field_heads.FieldHeadNames`."""

    RGB = "rgb"
    DENSITY = "density"


class TensorDataclass:
    """A stand-in for `utils.tensor_dataclass.TensorDataclass`, whose tensors are broadcast to one batch shape."""

    def __post_init__(self) -> None:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        shapes = [v.shape[:-1] for v in values.values() if isinstance(v, Tensor)]
        shapes += [v.shape for v in values.values() if isinstance(v, TensorDataclass)]
        self._shape = torch.broadcast_shapes(*shapes)
        for name, value in values.items():
            if isinstance(value, Tensor):
                setattr(self, name, value.broadcast_to(*self._shape, value.shape[-1]))

    @property
    def shape(self) -> torch.Size:
        return self._shape

    def __getitem__(self, index: Any) -> "TensorDataclass":
        return self.mapped(lambda value: value[index])

    def reshape(self, shape: tuple[int, ...]) -> "TensorDataclass":
        return self.mapped(lambda v: v.reshape(*shape, v.shape[-1]) if isinstance(v, Tensor) else v.reshape(shape))

    def flatten(self) -> "TensorDataclass":
        return self.reshape((-1,))

    def mapped(self, function: Callable[[Any], Any]) -> "TensorDataclass":
        """Returns a copy with `function` applied to every tensor, also in nested objects and dictionaries."""

        def change(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: change(item) for key, item in value.items()}
            return function(value) if isinstance(value, (Tensor, TensorDataclass)) else value

        return replace(self, **{f.name: change(getattr(self, f.name)) for f in fields(self)})


@dataclass
class Frustums(TensorDataclass):
    """A stand-in for `cameras.rays.Frustums`."""

    origins: Tensor
    directions: Tensor
    starts: Tensor
    ends: Tensor
    pixel_area: Tensor
    offsets: Tensor | None = None

    def get_positions(self) -> Tensor:
        return self.origins + self.directions * (self.starts + self.ends) / 2


@dataclass
class RaySamples(TensorDataclass):
    """A stand-in for `cameras.rays.RaySamples`."""

    frustums: Frustums
    camera_indices: Tensor | None = None
    deltas: Tensor | None = None
    spacing_to_euclidean_fn: Callable | None = None
    metadata: dict[str, Tensor] | None = None


def encode(x: Tensor, octaves: int) -> Tensor:
    """Returns the encoding [..., d (1 + 2 octaves)] of x [..., d]; x itself comes first."""
    waves = [wave(2**i * x) for i in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], dim=-1)


class AppearanceField(nn.Module):
    """A stand-in for a field of nerfstudio: scene box, base and head network, an appearance vector per image."""

    def __init__(self, aabb: Tensor, num_images: int, hidden_dim: int = 64, geo_feat_dim: int = 15) -> None:
        super().__init__()
        self.aabb = nn.Parameter(aabb, requires_grad=False)
        self.geo_feat_dim = geo_feat_dim
        self.embedding_appearance = nn.Embedding(num_images, 8)
        self.mlp_base = nn.Sequential(
            nn.Linear(3 + 3 * 2 * 8, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, 1 + geo_feat_dim)
        )
        self.mlp_head = nn.Sequential(
            nn.Linear(3 + geo_feat_dim + 8, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, 3), nn.Sigmoid()
        )

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        positions = ray_samples.frustums.get_positions()
        positions = (positions - self.aabb[0]) / (self.aabb[1] - self.aabb[0])
        h = self.mlp_base(encode(positions.view(-1, 3), 8)).view(*ray_samples.frustums.shape, -1)
        density_before_activation, geo_feat = torch.split(h, [1, self.geo_feat_dim], dim=-1)
        return F.softplus(density_before_activation), geo_feat

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Tensor | None = None
    ) -> dict[FieldHeadNames, Tensor]:
        directions = ray_samples.frustums.directions
        appearance = self.embedding_appearance(ray_samples.camera_indices.squeeze(-1))
        h = torch.cat(
            [
                ((directions + 1) / 2).reshape(-1, 3),
                density_embedding.reshape(-1, self.geo_feat_dim),
                appearance.reshape(-1, 8),
            ],
            dim=-1,
        )
        return {FieldHeadNames.RGB: self.mlp_head(h).view(*directions.shape[:-1], -1)}

    def density_fn(self, positions: Tensor) -> Tensor:
        nothing = torch.zeros_like(positions[..., :1])
        frustums = Frustums(positions, torch.ones_like(positions), nothing, nothing, nothing)
        return self.get_density(RaySamples(frustums))[0]

    def forward(self, ray_samples: RaySamples) -> dict[FieldHeadNames, Tensor]:
        density, density_embedding = self.get_density(ray_samples)
        outputs = self.get_outputs(ray_samples, density_embedding=density_embedding)
        outputs[FieldHeadNames.DENSITY] = density
        return outputs


def positions_of(argument: RaySamples | Tensor, *_: object, **__: object) -> Tensor:
    """Returns the positions of the ray samples, or the tensor argument of `density_fn`."""
    return argument if isinstance(argument, Tensor) else argument.frustums.get_positions()


def ray_samples_of(rays: int, samples: int) -> RaySamples:
    """Returns random ray samples in the layout of nerfstudio: tensors per ray are broadcast to samples."""
    edges = torch.linspace(0.5, 2.5, samples + 1)[:, None].expand(rays, samples + 1, 1)
    frustums = Frustums(
        origins=torch.rand(rays, 1, 3) - 0.5,
        directions=F.normalize(torch.randn(rays, 1, 3), dim=-1),
        starts=edges[:, :-1],
        ends=edges[:, 1:],
        pixel_area=torch.full((rays, 1, 1), 1e-4),
    )
    return RaySamples(
        frustums,
        camera_indices=torch.randint(0, 5, (rays, 1, 1)).expand(rays, samples, 1),
        deltas=edges.diff(dim=1),
        spacing_to_euclidean_fn=lambda x: 2 * x + 0.5,
        metadata={"near": edges[:, :-1]},
    )


def main() -> None:
    torch.manual_seed(0)
    ray_samples = ray_samples_of(40, 32)

    # Before: one network.
    field = AppearanceField(torch.tensor([[-2.0, -2, -2], [2, 2, 2]]), num_images=5)
    outputs = field(ray_samples)

    # After: one network per cell.
    field = VoronoiRouter(
        field, torch.randn(16, 3), coords=positions_of, methods=["get_density", "get_outputs", "density_fn"]
    )
    routed = field(ray_samples)
    density, embedding = field.get_density(ray_samples)
    rgb = field.get_outputs(ray_samples, density_embedding=embedding)[FieldHeadNames.RGB]

    for name, value in outputs.items():
        torch.testing.assert_close(routed[name], value)
    torch.testing.assert_close((density, rgb), (routed[FieldHeadNames.DENSITY], routed[FieldHeadNames.RGB]))
    torch.testing.assert_close(field.density_fn(ray_samples.frustums.get_positions()), density)
    print(f"nerfstudio: {field.num_cells} cells, " + ", ".join(f"{k.name} {list(v.shape)}" for k, v in routed.items()))


if __name__ == "__main__":
    main()
