"""The field of nerfacc's examples: `VanillaNeRFRadianceField.forward(x, condition=None)` and `query_density(x)`.

The inputs are raw positions, [n, 3] from the packed sampler or [rays, samples, 3]; the field encodes them. The
estimator calls `query_density`, so it is routed as well. The condition has one row per sample or per ray.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf import VoronoiRouter


class SinusoidalEncoder(nn.Module):
    """A stand-in for nerfacc's encoder, which has no parameters and one buffer."""

    def __init__(self, x_dim: int, max_deg: int) -> None:
        super().__init__()
        self.latent_dim = x_dim * (1 + 2 * max_deg)
        self.register_buffer("scales", torch.tensor([2**i for i in range(max_deg)]))

    def forward(self, x: Tensor) -> Tensor:
        scaled = (x[..., None, :] * self.scales[:, None]).reshape(*x.shape[:-1], -1)
        return torch.cat([x, torch.sin(scaled), torch.cos(scaled)], dim=-1)


class MLP(nn.Module):
    """A stand-in for nerfacc's MLP: hidden layers, a skip connection, an optional output layer."""

    def __init__(self, input_dim: int, output_dim: int | None, depth: int, width: int, skip: int | None = None) -> None:
        super().__init__()
        self.skip = skip
        self.hidden_layers = nn.ModuleList()
        features = input_dim
        for i in range(depth):
            self.hidden_layers.append(nn.Linear(features, width))
            features = width + (input_dim if self.joins(i) else 0)
        self.output_layer = None if output_dim is None else nn.Linear(features, output_dim)
        self.output_dim = features if output_dim is None else output_dim

    def joins(self, i: int) -> bool:
        return self.skip is not None and i > 0 and i % self.skip == 0

    def forward(self, x: Tensor) -> Tensor:
        inputs = x
        for i, layer in enumerate(self.hidden_layers):
            x = F.relu(layer(x))
            if self.joins(i):
                x = torch.cat([x, inputs], dim=-1)
        return x if self.output_layer is None else self.output_layer(x)


class VanillaNeRFRadianceField(nn.Module):
    """A stand-in for `radiance_fields.mlp.VanillaNeRFRadianceField`."""

    def __init__(self, net_depth=8, net_width=256, skip_layer=4, net_width_condition=128) -> None:
        super().__init__()
        self.posi_encoder, self.view_encoder = SinusoidalEncoder(3, 10), SinusoidalEncoder(3, 4)
        self.base = MLP(self.posi_encoder.latent_dim, None, net_depth, net_width, skip_layer)
        self.sigma_layer = MLP(self.base.output_dim, 1, 0, 0)
        self.bottleneck_layer = MLP(self.base.output_dim, net_width, 0, 0)
        self.rgb_layer = MLP(net_width + self.view_encoder.latent_dim, 3, 1, net_width_condition)

    def query_density(self, x: Tensor) -> Tensor:
        return F.relu(self.sigma_layer(self.base(self.posi_encoder(x))))

    def query_opacity(self, x: Tensor, step_size: float) -> Tensor:
        return self.query_density(x) * step_size

    def forward(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensor]:
        h = self.base(self.posi_encoder(x))
        condition = self.view_encoder(condition)
        if condition.shape[:-1] != h.shape[:-1]:
            rays, features = condition.shape
            condition = condition.view(rays, *[1] * (h.dim() - 2), features).expand(*h.shape[:-1], features)
        rgb = self.rgb_layer(torch.cat([self.bottleneck_layer(h), condition], dim=-1))
        return torch.sigmoid(rgb), F.relu(self.sigma_layer(h))


def main() -> None:
    torch.manual_seed(0)
    positions, directions = torch.rand(3000, 3) * 2 - 1, F.normalize(torch.randn(3000, 3), dim=-1)

    # Before: one network.
    radiance_field = VanillaNeRFRadianceField(net_width=64, net_width_condition=32)
    rgb, sigma = radiance_field(positions, directions)
    density = radiance_field.query_density(positions)

    # After: one network per cell.
    centres = torch.rand(16, 3) * 2 - 1
    radiance_field = VoronoiRouter(
        radiance_field, centres, coords="first3", methods=["query_density", "query_opacity"], fuse=True
    )
    routed_rgb, routed_sigma = radiance_field(positions, directions)
    routed_density = radiance_field.query_density(positions)

    torch.testing.assert_close((routed_rgb, routed_sigma, routed_density), (rgb, sigma, density))
    torch.testing.assert_close(radiance_field.query_opacity(positions, 0.01), density * 0.01)
    print(f"nerfacc: {radiance_field.num_cells} cells, {list(routed_rgb.shape)}, {list(routed_sigma.shape)}")


if __name__ == "__main__":
    main()
