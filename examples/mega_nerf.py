"""The networks of cmusatyalab/mega-nerf: k modules, one per centroid, become one router with the same outputs.

`NeRF.forward(x, sigma_only=False, sigma_noise=None)` takes [m, 7]: position, direction and the image's index, which
selects an appearance vector. `MegaNeRF` loops over its sub-modules with a mask for each; the router evaluates all of
them at once.
"""

import copy

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf import VoronoiRouter


def encode(x: Tensor, octaves: int) -> Tensor:
    """Returns the encoding [..., d (1 + 2 octaves)] of x [..., d]; x itself comes first."""
    waves = [wave(2**i * x) for i in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], dim=-1)


class NeRF(nn.Module):
    """A stand-in for `mega_nerf.models.nerf.NeRF`."""

    def __init__(self, layers=8, skip_layers=(4,), layer_dim=256, appearance_dim=48, appearance_count=10, affine=False):
        super().__init__()
        self.skip_layers = skip_layers
        widths = [63] + [layer_dim + 63 if i in skip_layers else layer_dim for i in range(1, layers)]
        self.xyz_encodings = nn.ModuleList(nn.Sequential(nn.Linear(w, layer_dim), nn.ReLU(True)) for w in widths)
        self.embedding_a = nn.Embedding(appearance_count, appearance_dim) if appearance_dim > 0 else None
        self.affine = nn.Linear(appearance_dim, 12) if affine else None
        self.xyz_encoding_final = nn.Linear(layer_dim, layer_dim)
        extra = 0 if affine else appearance_dim
        self.dir_a_encoding = nn.Sequential(nn.Linear(layer_dim + 27 + extra, layer_dim // 2), nn.ReLU(True))
        self.sigma = nn.Linear(layer_dim, 1)
        self.rgb = nn.Linear(layer_dim // 2, 3)

    def forward(self, x: Tensor, sigma_only: bool = False, sigma_noise: Tensor | None = None) -> Tensor:
        expected = 3 if sigma_only else 6 + (self.embedding_a is not None)
        if x.shape[1] != expected:
            raise ValueError(f"Unexpected input shape: {x.shape} (expected: {expected})")
        xyz = encode(x[:, :3], 10)
        h = xyz
        for i, layer in enumerate(self.xyz_encodings):
            if i in self.skip_layers:
                h = torch.cat([xyz, h], -1)
            h = layer(h)
        sigma = self.sigma(h)
        if sigma_noise is not None:
            sigma += sigma_noise
        sigma = F.softplus(sigma - 1)
        if sigma_only:
            return sigma
        inputs = [self.xyz_encoding_final(h), encode(x[:, 3:6], 4)]
        if self.embedding_a is not None and self.affine is None:
            inputs.append(self.embedding_a(x[:, -1].long()))
        rgb = self.rgb(self.dir_a_encoding(torch.cat(inputs, -1)))
        if self.affine is not None:
            transform = self.affine(self.embedding_a(x[:, -1].long())).view(-1, 3, 4)
            rgb = (transform[:, :, :3] @ rgb.unsqueeze(-1) + transform[:, :, 3:]).squeeze(-1)
        return torch.cat([torch.sigmoid(rgb), sigma], -1)


class MegaNeRF(nn.Module):
    """A stand-in for `mega_nerf.models.mega_nerf.MegaNeRF` with `boundary_margin=1`: a mask for each module."""

    def __init__(self, sub_modules: list[nn.Module], centroids: Tensor) -> None:
        super().__init__()
        self.sub_modules = nn.ModuleList(sub_modules)
        self.register_buffer("centroids", centroids)

    def forward(self, x: Tensor, sigma_only: bool = False, sigma_noise: Tensor | None = None) -> Tensor:
        cluster = torch.cdist(x[:, :3], self.centroids).argmin(dim=1)
        results = torch.zeros(x.shape[0], 1 if sigma_only else 4, dtype=x.dtype)
        for i, child in enumerate(self.sub_modules):
            mask = cluster == i
            if mask.any():
                results[mask] = child(x[mask], sigma_only, None if sigma_noise is None else sigma_noise[mask])
        return results


def main() -> None:
    torch.manual_seed(0)
    x = torch.cat([torch.rand(3000, 3) * 2 - 1, F.normalize(torch.randn(3000, 3)), torch.randint(0, 10, (3000, 1))], 1)
    noise = torch.randn(3000, 1)
    centroids = torch.rand(8, 3) * 2 - 1

    # Before: a container of sub-modules that were trained one by one.
    sub_modules = [NeRF(layer_dim=32) for _ in range(8)]
    mega = MegaNeRF(sub_modules, centroids)
    out, sigma = mega(x, sigma_noise=noise), mega(x[:, :3], sigma_only=True)

    # After: the same modules in one router.
    router = VoronoiRouter.from_modules(sub_modules, centroids, coords="first3")
    routed, routed_sigma = router(x, sigma_noise=noise), router(x[:, :3], sigma_only=True)
    torch.testing.assert_close(routed, out)
    torch.testing.assert_close(routed_sigma, sigma)

    # The reverse: `cell` extracts a sub-module, and `load_cell` loads a retrained one into its cell.
    for name, value in router.cell(3).state_dict().items():
        assert torch.equal(value, sub_modules[3].state_dict()[name])
    retrained = copy.deepcopy(sub_modules[3])
    nn.init.zeros_(retrained.rgb.weight)
    router.load_cell(3, retrained)
    mega.sub_modules[3] = retrained
    torch.testing.assert_close(router(x), mega(x))
    print(f"mega-nerf: {router.num_cells} modules in one router, {list(routed.shape)}")


if __name__ == "__main__":
    main()
