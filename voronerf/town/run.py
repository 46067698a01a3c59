"""Reads and writes runs of several parts.

A run directory with the file ``town.json`` has several parts. Its checkpoint has the tensors ``part-N.diagram.*`` and
``part-N.owner`` of each part, and the occupancy grid. ``values["parts"]`` has the placement of each part, and names the
files of its networks, which are checkpoints in the same folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from voronerf.app.files import read_json
from voronerf.app.run import Run, shown_scene
from voronerf.app.scenes import Scene
from voronerf.app.scenes.record import placed, read_scene
from voronerf.app.train.build import present_device
from voronerf.app.train.checkpoint import (
    Checkpoint,
    CheckpointError,
    checkpoint_path,
    is_shown,
    last_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from voronerf.app.train.config import TrainConfig, check_samples
from voronerf.app.train.run_directory import check_folders
from voronerf.diagram import VoronoiDiagram
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import Occupancy, Sampler, Stratified
from voronerf.nerf.volume import Space
from voronerf.town.geometry import Similarity, Solid
from voronerf.town.network import StoredRouter, config_of
from voronerf.town.parts import Part, Parts

#: The file that marks the directory of a run of several parts.
TOWN = "town.json"


def is_town(run: Path) -> bool:
    """Returns whether a run directory holds a run of several parts."""
    return (run / TOWN).is_file()


def stored_territories(run: Path) -> int | None:
    """Returns the number of territories in which a run was trained, or None if the run does not store it."""
    values = read_json(run / TOWN) if is_town(run) else None
    count = values.get("territories") if isinstance(values, dict) else None
    return count if isinstance(count, int) and count > 0 else None


def write_parts(run: Path, config: TrainConfig, parts: Parts, grid: OccupancyGrid | None) -> None:
    """Writes one file for each network, even if several parts share it, and then the run's checkpoint."""
    folder, names = checkpoint_path(run).parent, dict[int, str]()
    for network in (network for part in parts for network in part.networks):
        if id(network) not in names:
            names[id(network)] = name = f"networks-{len(names)}.safetensors"
            save_checkpoint(folder / name, network.stored())
    placements = [place_of(part, [names[id(network)] for network in part.networks]) for part in parts]
    cells = [(part.diagram, part.owner) for part in parts]
    save_checkpoint(checkpoint_path(run), index_of(config, cells, placements, grid))


def place_of(part: Part, files: Sequence[str]) -> dict[str, Any]:
    """Returns the placement of a part, as stored in a checkpoint's values."""
    sphere = part.contraction
    return {
        "networks": list(files),
        "frame": part.frame.to_values(),
        "region": [solid.to_values() for solid in part.region],
        "layer": part.layer,
        "contraction": None if sphere is None else {"centre": sphere.centre.tolist(), "radius": sphere.radius},
    }


def index_of(
    config: TrainConfig,
    cells: Sequence[tuple[VoronoiDiagram, Tensor]],
    placed: list[dict[str, Any]],
    grid: OccupancyGrid | None,
) -> Checkpoint:
    """Makes the checkpoint of a run of parts, without the networks, which have their own files.

    Args:
        config: The settings of the run.
        cells: (diagram, owner) of each part; owner is the network of each leaf.
        placed: The placement of each part, see :func:`place_of`.
        grid: The occupancy grid, or None.
    """
    tensors: dict[str, Tensor] = {} if grid is None else {f"occupancy.{k}": v for k, v in grid.state_dict().items()}
    for number, (diagram, owner) in enumerate(cells):
        tensors |= {f"part-{number}.diagram.{name}": value for name, value in diagram.state_dict().items()}
        tensors[f"part-{number}.owner"] = owner
    tensors = {name: value.cpu().clone() for name, value in tensors.items()}
    return Checkpoint(tensors, {"config": config.to_values(), "parts": placed})


def open_parts(run: Path, checkpoint: Checkpoint, device: torch.device | str = "cpu", backend: str = "auto") -> Parts:
    """Opens the parts of a checkpoint; a network that several parts share is one object."""
    networks: dict[str, StoredRouter] = {}
    parts = []
    for index, values in enumerate(checkpoint.values["parts"]):
        try:
            for name in values["networks"]:
                if Path(name).name != name:
                    raise ValueError(f"networks must be files beside the checkpoint, got {name!r:.100}")
                if name not in networks:
                    stored = load_checkpoint(checkpoint_path(run).with_name(name), keep=is_shown)
                    networks[name] = StoredRouter(stored, device, backend)
            sphere = values["contraction"]
            part = Part(
                [networks[name] for name in values["networks"]],
                VoronoiDiagram.from_state(checkpoint.group(f"part-{index}"), "diagram.").to(device),
                checkpoint.tensors[f"part-{index}.owner"],
                frame=Similarity(**values["frame"]),
                contraction=None
                if sphere is None
                else Contraction(torch.tensor(sphere["centre"]), float(sphere["radius"])),
                region=[Solid.from_values(solid) for solid in values["region"]],
                layer=int(values["layer"]),
            )
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, RuntimeError) as error:
            line = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise CheckpointError(f"{checkpoint.source}: part {index}: {line}") from None
        parts.append(part)
    return Parts(parts, backend=backend)


def open_run(
    path: Path | str,
    *,
    scene: Scene | None = None,
    data: str | Path | None = None,
    downscale: int | None = None,
    allow_outside: bool = False,
    samples: tuple[int, ...] | None = None,
    device: str = "cpu",
    backend: str = "auto",
) -> Run:
    """Opens a run of several parts: one that was joined, cut or placed, or trained in territories.

    Args:
        path: The run directory.
        scene: The scene, with the images of the first run or without images; None to load it.
        data: The scene folder of the first run; None for the folder of its training.
        downscale: The factor by which images are reduced; None for the factor of the training.
        allow_outside: Whether to read images that lie outside of the scene folder.
        samples: The number of samples per ray, as a tuple of one number; None for the number of the run.
        device: "cpu", "cuda:0", "auto" or another value of `--device`.
        backend: The backend of the operations.

    Raises:
        CheckpointError: There is no usable checkpoint.
        ConfigError: An argument is invalid, or a folder of the run is a link to elsewhere.
        SceneError: The scene cannot be read.

    Examples:
        >>> from voronerf.town import open_run
        >>> def first_picture(joined):
        ...     return open_run(joined).render(0).colour
    """
    path = Path(path)
    device = present_device(device)
    check_folders(path)
    checkpoint = last_checkpoint(path, keep=is_shown)
    config = config_of(checkpoint)
    check_samples(replace(config, samples=samples))
    config, scene = shown_scene(path, config, scene, data, downscale, allow_outside)
    scene = _in_place(scene, read_scene(path / "scene.json"))
    parts = open_parts(path, checkpoint, device, backend)
    for part in parts:
        part.open()
    space = Space(None, scene.spacing, False, None)
    (count,) = samples or config.samples or (64,)
    sampler: Sampler = Stratified(count, space=space, backend=backend)
    if state := checkpoint.group("occupancy"):
        picture = None if samples is None else count
        grid = OccupancyGrid.from_state(state, device=device)
        sampler = Occupancy(grid, count, picture_samples=picture, space=space, backend=backend)
    return Run(path, config, scene, parts, Renderer({"field": parts}, sampler, backend=backend))


def _in_place(read: Scene, record: Scene) -> Scene:
    """Replaces the poses of a scene's views by the poses of ``record``, the scene that the run has stored.

    If the views have other names than the first views of ``record``, they keep their own poses, moved into the space of
    ``record``.
    """
    splits = {}
    for name in ("train", "test"):
        views, recorded = getattr(read, name), getattr(record, name)
        names = recorded.names[: len(views)]
        if names not in (views.names, tuple(f"0-{view}" for view in views.names)):
            return placed(read, record)
        cameras = replace(views.cameras, poses=recorded.cameras.poses[: len(views)].to(views.cameras.poses))
        splits[name] = replace(views, cameras=cameras, names=names, sparse_depth=None)
    return replace(record, **splits)
