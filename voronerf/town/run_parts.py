"""A run of several parts: what its checkpoint has of them, and the parts that are made of a checkpoint.

The tensors ``part-N.diagram.*`` and ``part-N.owner`` are those of a part, ``part-N.router-M.router.*`` those of its
routers, which lie in files of their own. ``values["parts"]`` says the rest: how each network is made, where it stands.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from voronerf.app.train.checkpoint import Checkpoint, CheckpointError
from voronerf.app.train.config import TrainConfig
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.average import load_averages
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.fields import FIELDS, FieldType
from voronerf.router import VoronoiRouter
from voronerf.router.grouping import cell_parameters
from voronerf.town.coarse import Coarse
from voronerf.town.parts import Part, Parts, Similarity, Solid
from voronerf.town.streaming import Pages


def recipe_of(config: TrainConfig) -> dict[str, Any]:
    """What a file needs to make the networks of a configuration again."""
    return {"field": config.field, "options": config.network_options, "cell_tables": config.cell_tables}


def make_router(recipe: Mapping[str, Any], device: torch.device | str = "cpu", backend: str = "auto") -> VoronoiRouter:
    """A router of one cell around the network of a recipe, with any parameters.

    Raises:
        ValueError: For a field that is not in the table, or options that it does not take.
    """
    name = recipe["field"]
    if name not in FIELDS:
        raise ValueError(f"the field {name!r:.60} is not in this program (voronerf.nerf.fields.register_field adds it)")
    kind = FIELDS[name]
    options = {key: _tuples(value) for key, value in recipe["options"].items()}
    around = {
        key: value for key, value in kind.router_options.items() if not (recipe["cell_tables"] and key == "share")
    }
    network = _unfilled(kind, options)
    centre = VoronoiDiagram(torch.zeros(1, 3))
    router = VoronoiRouter(network, centre, coords="first3", backend=backend, way="fused", **around)
    router.recipe = {"field": name, "options": options, "cell_tables": bool(recipe["cell_tables"])}
    return router if any(p.is_meta for p in router.parameters()) else router.to(device)


def _unfilled(kind: FieldType, options: Mapping[str, Any]) -> nn.Module:
    """A network without memory for its parameters, where it is nothing but these; else one with any."""
    with torch.random.fork_rng(devices=[]):
        try:
            with torch.device("meta"):
                network = kind.build(options)
        except RuntimeError:  # a field that computes numbers where it is made
            return kind.build(options)
        return network if not any(True for _ in network.buffers()) else kind.build(options)


def _tuples(value: Any) -> Any:
    """Tuples for the lists of JSON."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def describe_parts(parts: Parts) -> list[dict[str, Any]]:
    """What the values of a checkpoint say of parts.

    Raises:
        ValueError: For a router without a recipe, which cannot be made again.
    """
    found = []
    for index, part in enumerate(parts):
        if any(router.recipe is None for router in part):
            raise ValueError(f"part {index}: its routers must have a recipe, by which a file tells how to make them")
        seen = part.contraction
        found.append(
            {
                "routers": [dict(router.recipe or {}) for router in part],
                "frame": part.frame.to_values(),
                "region": [solid.to_values() for solid in part.region],
                "layer": part.layer,
                "contraction": None if seen is None else {"centre": seen.centre.tolist(), "radius": seen.radius},
            }
        )
    return found


def parts_states(parts: Parts) -> dict[str, dict[str, Tensor]]:
    """The tensors of parts, by the first word of their names in a checkpoint and the rest of them."""
    return {
        f"part-{i}": {
            **{f"diagram.{name}": tensor for name, tensor in part.diagram.state_dict().items()},
            "owner": part.owner,
            **{
                f"router-{j}.router.module.{name}": tensor
                for j, router in enumerate(part)
                for name, tensor in router.module.state_dict().items()
            },
        }
        for i, part in enumerate(parts)
    }


def open_parts(
    checkpoint: Checkpoint, device: torch.device | str = "cpu", backend: str = "auto", pages: Pages | None = None
) -> Parts:
    """The parts that a checkpoint has; a router that stands in several places is one object.

    Args:
        checkpoint: With the networks, unless there are pages.
        device: Of the networks.
        backend: Of the operations.
        pages: The files of the networks, of which only as much is read as is needed.

    Raises:
        CheckpointError: When something is missing, damaged or does not fit.
    """
    made: dict[str, VoronoiRouter] = {}
    found = []
    for index, values in enumerate(checkpoint.values["parts"]):
        try:
            diagram = VoronoiDiagram.from_state(checkpoint.group(f"part-{index}"), "diagram.")
            owner = checkpoint.tensors[f"part-{index}.owner"]
            routers = []
            for number, recipe in enumerate(values["routers"]):
                file = str(recipe["file"])
                if file not in made:
                    leaves = (owner == number).nonzero()[:, 0]
                    state = checkpoint.group(f"part-{index}.router-{number}") if pages is None else pages.tensors(file)
                    made[file] = fill_router(make_router(recipe, device, backend), diagram.part(leaves), state, device)
                    if pages is not None:
                        pages.watch(file, made[file])
                routers.append(made[file])
            found.append(place_part(values, routers, diagram.to(device), owner))
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
            line = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise CheckpointError(f"{checkpoint.source}: part {index}: {line}") from None
    parts = Parts(found, backend=backend)
    if pages is not None:
        pages.check()
    return parts


def restore_coarse(parts: Parts, checkpoint: Checkpoint) -> None:
    """Gives parts the coarse levels that a checkpoint has of them.

    Raises:
        CheckpointError: When one does not fit.
    """
    for index, part in enumerate(parts):
        state = checkpoint.group(f"part-{index}.coarse")
        try:
            if state:
                part.coarse = Coarse(**{name: tensor.clone().to(part.owner.device) for name, tensor in state.items()})
        except (TypeError, ValueError) as error:
            raise CheckpointError(f"{checkpoint.source}: part-{index}.coarse: {error}") from None


@torch.no_grad()
def restore_parts(parts: Parts, checkpoint: Checkpoint) -> None:
    """Gives parts the parameters that a checkpoint of the same parts has.

    Raises:
        CheckpointError: When it is of other parts.
    """
    for name, state in parts_states(parts).items():
        for key, tensor in state.items():
            stored = checkpoint.tensors.get(f"{name}.{key}")
            if stored is None or stored.shape != tensor.shape:
                came = "nothing" if stored is None else list(stored.shape)
                wanted = list(tensor.shape)
                raise CheckpointError(f"{checkpoint.source}: {name}.{key} must have shape {wanted}, got {came}")
            tensor.copy_(stored)


def fill_router(
    router: VoronoiRouter, diagram: VoronoiDiagram, state: Mapping[str, Tensor], device: torch.device | str
) -> VoronoiRouter:
    """Gives a router of :func:`make_router` the cells of a file of networks; on the CPU, the tensors themselves.

    Raises:
        ValueError: For a parameter that is missing or of another shape.
    """
    values = {
        name.removeprefix("router."): tensor for name, tensor in state.items() if name.startswith("router.module.")
    }
    stacked = {id(parameter) for parameter in cell_parameters(router.module)}
    for name, parameter in router.module.named_parameters():
        first = [diagram.num_cells] if id(parameter) in stacked else []
        wanted = [*first, *parameter.shape[len(first) :]]
        came = values.get(f"module.{name}")
        if came is None or list(came.shape) != wanted:
            shape = "nothing" if came is None else list(came.shape)
            raise ValueError(f"{name} must have shape {wanted}, got {shape}")
    values |= {f"diagram.{name}": tensor for name, tensor in diagram.state_dict().items()}
    empty = any(parameter.is_meta for parameter in router.parameters())
    router.load_state_dict(values, assign=empty or torch.device(device).type == "cpu")
    router.to(device)
    averages = {name: tensor for name, tensor in state.items() if name.endswith(".average")}
    load_averages([p for group in grouped_parameters([router]) for p in group], Checkpoint(averages, {}))
    return router.eval()


def grouped_parameters(routers: Iterable[VoronoiRouter]) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """The parameters of routers with recipes, in the order that an optimiser numbers them: networks, then tables."""
    dense: list[nn.Parameter] = []
    tables: list[nn.Parameter] = []
    for router in routers:
        patterns = FIELDS[router.recipe["field"]].sparse_parameters if router.recipe else ()
        for name, parameter in router.module.named_parameters():
            (tables if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns) else dense).append(parameter)
    return dense, tables


def place_part(values: Mapping[str, Any], routers: list[VoronoiRouter], diagram: VoronoiDiagram, owner: Tensor) -> Part:
    """A part of what :func:`describe_parts` says of it.

    Raises:
        ValueError: For values that do not fit.
    """
    seen = values["contraction"]
    return Part(
        routers,
        diagram,
        owner,
        frame=Similarity(**values["frame"]),
        contraction=None if seen is None else Contraction(torch.tensor(seen["centre"]), float(seen["radius"])),
        region=[Solid.from_values(solid) for solid in values["region"]],
        layer=int(values["layer"]),
    )
