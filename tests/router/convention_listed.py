"""The eight codebases of examples/, with all calling conventions that they use."""

from __future__ import annotations

from typing import Any

import torch
from convention_harness import RAYS, Arguments, Case, example, first, one, uniform
from torch import nn

nerf_pytorch, flexible, nerf_pl, mip = (example(n) for n in ("nerf_pytorch", "flexible_nerf", "nerf_pl", "mipnerf_pl"))
nerfacc, studio, ngp, mega = (example(n) for n in ("nerfacc_field", "nerfstudio_field", "torch_ngp", "mega_nerf"))

Lead = tuple[int, ...]


def encoded(octaves: int, direction_octaves: int | None) -> Any:
    """Returns a function that makes a single tensor argument, encoded before it reaches the field."""

    def arguments(lead: Lead) -> Arguments:
        x = nerf_pytorch.encode(uniform(lead), octaves)
        if direction_octaves is not None:
            x = torch.cat([x, nerf_pytorch.encode(uniform(lead), direction_octaves)], -1)
        return (x,), {}

    return arguments


def pair(lead: Lead) -> Arguments:
    return (uniform(lead), uniform(lead)), {}


def with_rays(lead: Lead) -> Arguments:
    """Returns positions, and one direction for each ray."""
    return (uniform(lead), uniform(lead[:1])), {}


def mip_arguments(view: bool) -> Any:
    # The first three features are the means, so that the loop finds positions; the router gets them at the call.
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


def skips() -> nn.Module:
    return nerf_pytorch.NeRF(D=4, W=10, input_ch=15, input_ch_views=9, skips=[1], use_viewdirs=True)


def plain() -> nn.Module:
    return nerf_pytorch.NeRF(D=3, W=8, input_ch=15, input_ch_views=0, output_ch=5, skips=[0])


def flexible_field() -> nn.Module:
    return flexible.FlexibleNeRFModel(6, 8, 2, num_encoding_fn_xyz=2, num_encoding_fn_dir=1)


def pl_field() -> nn.Module:
    return nerf_pl.NeRF(3, 8, 15, 9, skips=[1])


def nerfacc_field() -> nn.Module:
    return nerfacc.VanillaNeRFRadianceField(3, 10, 1, 6)


def ngp_field() -> nn.Module:
    field = ngp.NeRFNetwork(8, 4)
    field.encoder = ngp.GridEncoder(log2_hashmap_size=8)
    return field


def studio_case(method: str, arguments: Any) -> Case:
    name = f"nerfstudio {method}"
    return Case(name, appearance_field, arguments, studio.positions_of, RAYS, STUDIO, method=method)


def other(method: str, options: Any, make: Any, arguments: Any, fuses: bool = True, **more: Any) -> Case:
    """Returns a case for a method other than ``forward``."""
    return Case(f"{make.__name__} {method}", make, arguments, options=options, method=method, fuses=fuses, **more)


SLICE = {"coords": slice(0, 3)}
WITH_VIEW, WITH_CONDITION = {"per_ray": ["view_direction"]}, {**NERFACC, "per_ray": ["condition"]}
PART = Case(
    "torch-ngp color of a part of the samples",
    ngp_field,
    lambda lead: ((*pair(lead)[0], torch.rand(lead) < 0.5), {"geo_feat": uniform(lead, 4)}),
    options=NGP,
    method="color",
    way="cell by cell",  # the module selects rows, so offsets of cells change
)
LISTED = [
    Case("nerf-pytorch", skips, encoded(2, 1), fuses=True),
    Case("nerf-pytorch without views", plain, encoded(2, None), options=SLICE, fuses=True),
    Case("FlexibleNeRF", flexible_field, encoded(2, 1), lead=RAYS, fuses=True),
    Case("nerf_pl", pl_field, encoded(2, 1), fuses=True),
    Case("nerf_pl sigma_only", pl_field, lambda lead: (encoded(2, None)(lead)[0], {"sigma_only": True}), fuses=True),
    Case("mipnerf_pl", mip_field, mip_arguments(True), first, RAYS, WITH_VIEW, passes_coords=True, fuses=True, rank=3),
    Case(
        "mipnerf_pl without views",
        mip_field,
        mip_arguments(False),
        first,
        RAYS,
        {},
        passes_coords=True,
        fuses=True,
        rank=3,
    ),
    Case("nerfacc packed", nerfacc_field, pair, options=NERFACC, fuses=True),
    Case("nerfacc with a condition per ray", nerfacc_field, with_rays, first, RAYS, WITH_CONDITION, fuses=True),
    other("query_density", NERFACC, nerfacc_field, one(3)),
    other("query_opacity", NERFACC, nerfacc_field, lambda lead: ((uniform(lead), 0.01), {})),
    studio_case("forward", lambda lead: ((ray_samples(lead),), {})),
    studio_case("get_density", lambda lead: ((ray_samples(lead),), {})),
    studio_case("get_outputs", outputs_arguments),
    studio_case("density_fn", one(3)),
    Case("torch-ngp", ngp_field, pair, options=NGP),  # one table per cell; shared: convention_shared.py
    other("density", NGP, ngp_field, one(3), fuses=False),
    other("color", NGP, ngp_field, lambda lead: (pair(lead)[0], {"geo_feat": uniform(lead, 4)})),
    PART,
    Case("mega-nerf", mega_field(), mega_arguments(False)),
    Case("mega-nerf affine with noise", mega_field(affine=True), mega_arguments(True)),
    Case("mega-nerf sigma_only", mega_field(), lambda lead: ((uniform(lead), True), {}), fuses=True),
]
