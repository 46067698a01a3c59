"""The eight conventions of examples/, in every form in which their codebases call them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from convention_harness import Case, example
from torch import Tensor, nn

nerf_pytorch, flexible, nerf_pl, mip = (example(n) for n in ("nerf_pytorch", "flexible_nerf", "nerf_pl", "mipnerf_pl"))
nerfacc, studio, ngp, mega = (example(n) for n in ("nerfacc_field", "nerfstudio_field", "torch_ngp", "mega_nerf"))

Lead = tuple[int, ...]
Arguments = tuple[tuple[Any, ...], dict[str, Any]]


def uniform(lead: Lead, features: int = 3) -> Tensor:
    return torch.rand(*lead, features) * 2 - 1


def first(x: Tensor, *_: Any, **__: Any) -> Tensor:
    return x[..., :3]


def encoded(octaves: int, direction_octaves: int | None) -> Any:
    """Arguments of a field that is encoded outside: one tensor."""

    def arguments(lead: Lead) -> Arguments:
        x = nerf_pytorch.encode(uniform(lead), octaves)
        if direction_octaves is not None:
            x = torch.cat([x, nerf_pytorch.encode(uniform(lead), direction_octaves)], -1)
        return (x,), {}

    return arguments


def one(features: int = 7) -> Callable[[Lead], Arguments]:
    """One tensor, whose first three features are the position."""
    return lambda lead: ((uniform(lead, features),), {})


def pair(lead: Lead) -> Arguments:
    return (uniform(lead), uniform(lead)), {}


def with_rays(lead: Lead) -> Arguments:
    """Positions, and one direction for each ray."""
    return (uniform(lead), uniform(lead[:1])), {}


def mip_arguments(view: bool) -> Any:
    # The means are three of the features here, so that the loop finds them; the router is told at the call.
    def arguments(lead: Lead) -> Arguments:
        x = uniform(lead, 12)
        return ((x, uniform(lead[:1], 9)) if view else (x,)), {}

    return arguments


def mip_field() -> nn.Module:
    return mip.MLP(net_depth=6, net_width=10, net_width_condition=6, skip_index=2, xyz_dim=12, view_dim=9)


def appearance_field() -> nn.Module:
    return studio.AppearanceField(torch.tensor([[-2.0, -2, -2], [2, 2, 2]]), num_images=5, hidden_dim=9, geo_feat_dim=4)


def ray_samples(lead: Lead) -> Any:
    return studio.ray_samples_of(*lead) if len(lead) == 2 else studio.ray_samples_of(*lead, 1)


def outputs_arguments(lead: Lead) -> Arguments:
    return (ray_samples(lead),), {"density_embedding": uniform(lead, 4)}


def mega_field(**options: Any) -> Any:
    return lambda: mega.NeRF(layers=3, skip_layers=(1,), layer_dim=10, appearance_dim=5, appearance_count=7, **options)


def mega_arguments(noise: bool) -> Any:
    def arguments(lead: Lead) -> Arguments:
        x = torch.cat([uniform(lead, 6), torch.randint(0, 7, (*lead, 1))], -1)
        return (x,), ({"sigma_noise": uniform(lead, 1)} if noise else {"sigma_only": False})

    return arguments


STUDIO = {"coords": studio.positions_of, "methods": ["get_density", "get_outputs", "density_fn"]}
NERFACC = {"coords": "first3", "methods": ["query_density", "query_opacity"]}
NGP = {"coords": "first3", "methods": ["density", "color"]}
RAYS = (9, 7)  # unlike any number of features

LISTED = [
    Case(
        "nerf-pytorch",
        lambda: nerf_pytorch.NeRF(D=4, W=10, input_ch=15, input_ch_views=9, skips=[1], use_viewdirs=True),
        encoded(2, 1),
        first,
    ),
    Case(
        "nerf-pytorch without views",
        lambda: nerf_pytorch.NeRF(D=3, W=8, input_ch=15, input_ch_views=0, output_ch=5, skips=[0]),
        encoded(2, None),
        first,
        options={"coords": slice(0, 3)},
    ),
    Case(
        "FlexibleNeRF",
        lambda: flexible.FlexibleNeRFModel(6, 8, 2, num_encoding_fn_xyz=2, num_encoding_fn_dir=1),
        encoded(2, 1),
        first,
        lead=RAYS,
    ),
    Case("nerf_pl", lambda: nerf_pl.NeRF(3, 8, 15, 9, skips=[1]), encoded(2, 1), first),
    Case(
        "nerf_pl sigma_only",
        lambda: nerf_pl.NeRF(3, 8, 15, 9, skips=[1]),
        lambda lead: (encoded(2, None)(lead)[0], {"sigma_only": True}),
        first,
    ),
    Case(
        "mipnerf_pl",
        mip_field,
        mip_arguments(True),
        first,
        lead=RAYS,
        options={"per_ray": ["view_direction"]},
        given=True,
        rank=3,
    ),
    Case("mipnerf_pl without views", mip_field, mip_arguments(False), first, RAYS, {}, given=True, rank=3),
    Case("nerfacc packed", lambda: nerfacc.VanillaNeRFRadianceField(3, 10, 1, 6), pair, first, options=NERFACC),
    Case(
        "nerfacc with a condition per ray",
        lambda: nerfacc.VanillaNeRFRadianceField(3, 10, 1, 6),
        with_rays,
        first,
        lead=RAYS,
        options={**NERFACC, "per_ray": ["condition"]},
    ),
    Case(
        "nerfacc query_density",
        lambda: nerfacc.VanillaNeRFRadianceField(2, 8),
        lambda lead: ((uniform(lead),), {}),
        first,
        options=NERFACC,
        method="query_density",
    ),
    Case(
        "nerfacc query_opacity",
        lambda: nerfacc.VanillaNeRFRadianceField(2, 8),
        lambda lead: ((uniform(lead), 0.01), {}),
        first,
        options=NERFACC,
        method="query_opacity",
    ),
    Case("nerfstudio", appearance_field, lambda lead: ((ray_samples(lead),), {}), studio.positions_of, RAYS, STUDIO),
    Case(
        "nerfstudio get_density",
        appearance_field,
        lambda lead: ((ray_samples(lead),), {}),
        studio.positions_of,
        RAYS,
        STUDIO,
        method="get_density",
    ),
    Case(
        "nerfstudio get_outputs",
        appearance_field,
        outputs_arguments,
        studio.positions_of,
        RAYS,
        STUDIO,
        method="get_outputs",
    ),
    Case(
        "nerfstudio density_fn",
        appearance_field,
        lambda lead: ((uniform(lead),), {}),
        studio.positions_of,
        RAYS,
        STUDIO,
        method="density_fn",
    ),
    Case("torch-ngp", lambda: ngp.NeRFNetwork(8, 4), pair, first, options=NGP),
    Case(
        "torch-ngp density",
        lambda: ngp.NeRFNetwork(8, 4),
        lambda lead: ((uniform(lead),), {}),
        first,
        options=NGP,
        method="density",
    ),
    Case(
        "torch-ngp color",
        lambda: ngp.NeRFNetwork(8, 4),
        lambda lead: (pair(lead)[0], {"geo_feat": uniform(lead, 4)}),
        first,
        options=NGP,
        method="color",
    ),
    Case(
        "torch-ngp color of a part of the samples",
        lambda: ngp.NeRFNetwork(8, 4),
        lambda lead: ((*pair(lead)[0], torch.rand(lead) < 0.5), {"geo_feat": uniform(lead, 4)}),
        first,
        options=NGP,
        method="color",
        one_pass=False,  # the module takes some of its rows, so that cells end elsewhere
    ),
    Case("mega-nerf", mega_field(), mega_arguments(False), first),
    Case("mega-nerf affine with noise", mega_field(affine=True), mega_arguments(True), first),
    Case(
        "mega-nerf sigma_only",
        mega_field(),
        lambda lead: ((uniform(lead), True), {}),
        first,
    ),
]
