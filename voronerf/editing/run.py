"""Reads and writes runs of several parts.

A run directory with the file ``parts.json`` has several parts; the file also tells whether the run was cut. The run's
checkpoint has the tensors ``part-N.diagram.*`` and ``part-N.kept`` of each part, and the occupancy grid.
``values["parts"]`` has the placement of each part, and names the file of its networks, a checkpoint in the same folder.
"""

from __future__ import annotations

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
from voronerf.editing.geometry import Similarity, Solid
from voronerf.editing.network import StoredRouter, config_of
from voronerf.editing.parts import Part, Parts
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.occupancy import OccupancyGrid
from voronerf.nerf.renderer import Renderer
from voronerf.nerf.samplers import Occupancy, Sampler, Stratified
from voronerf.nerf.volume import Space

#: The file that marks the directory of a run of several parts.
PARTS = "parts.json"


def has_parts(run: Path) -> bool:
    """Returns whether a run directory holds a run of several parts."""
    return (run / PARTS).is_file()


def is_cut(run: Path) -> bool:
    """Returns whether a run was cut, or made of cut runs, so that pictures show only a part of its scene."""
    return has_parts(run) and read_json(run / PARTS, dict).get("cut") is True


def write_parts(run: Path, config: TrainConfig, parts: Parts, grid: OccupancyGrid | None) -> None:
    """Writes one file for each router, even if several parts share it, and then the run's checkpoint."""
    folder, names, placements = checkpoint_path(run).parent, dict[int, str](), list[dict[str, Any]]()
    tensors: dict[str, Tensor] = {} if grid is None else {f"occupancy.{k}": v for k, v in grid.state_dict().items()}
    for number, part in enumerate(parts):
        network = part.network
        if id(network) not in names:
            names[id(network)] = name = f"networks-{len(names)}.safetensors"
            save_checkpoint(folder / name, network.stored())
        tensors |= {f"part-{number}.diagram.{name}": value for name, value in part.diagram.state_dict().items()}
        tensors[f"part-{number}.kept"] = part.kept
        placements.append(place_of(part, names[id(network)]))
    tensors = {name: value.cpu().clone() for name, value in tensors.items()}
    save_checkpoint(checkpoint_path(run), Checkpoint(tensors, {"config": config.to_values(), "parts": placements}))


def place_of(part: Part, file: str) -> dict[str, Any]:
    """Returns the placement of a part, as stored in a checkpoint's values."""
    sphere = part.contraction
    return {
        "networks": file,
        "frame": part.frame.to_values(),
        "region": [solid.to_values() for solid in part.region],
        "layer": part.layer,
        "contraction": None if sphere is None else {"centre": sphere.centre.tolist(), "radius": sphere.radius},
    }


def open_parts(run: Path, checkpoint: Checkpoint, device: torch.device | str = "cpu", backend: str = "auto") -> Parts:
    """Opens the parts of a checkpoint; a network that several parts share is one object."""
    networks: dict[str, StoredRouter] = {}
    parts = []
    for index, values in enumerate(checkpoint.values["parts"]):
        try:
            name = values["networks"]
            if Path(name).name != name:
                raise ValueError(f"networks must be a file beside the checkpoint, got {name!r:.100}")
            if name not in networks:
                stored = load_checkpoint(checkpoint_path(run).with_name(name), keep=is_shown)
                networks[name] = StoredRouter(stored, device, backend)
            sphere = values["contraction"]
            part = Part(
                networks[name],
                VoronoiDiagram.from_state(checkpoint.group(f"part-{index}"), "diagram.").to(device),
                checkpoint.tensors[f"part-{index}.kept"],
                frame=Similarity(**values["frame"]),
                contraction=None
                if sphere is None
                else Contraction(
                    torch.tensor(sphere["centre"], dtype=torch.float32, device="cpu"), float(sphere["radius"])
                ),
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
    """Opens a run of several parts: one that was joined, cut or placed.

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
        >>> from voronerf.editing import open_run
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
    scene = placed(scene, read_scene(path / "scene.json"))
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
