"""Writes input files of attempts: scenes of 16 x 16 pixels, a finished run of each field, and a folder outside."""

from __future__ import annotations

import importlib.util
import json
import os
import shlex
import shutil
import sys
from pathlib import Path

import commands
import numpy as np
from PIL import Image

from voronerf.nerf.cameras import orbit_cameras

sys.path.append(str(Path(__file__).parents[1] / "app" / "scenes"))
from scene_files import write_colmap, write_images, write_llff, write_walls

#: Options of a short training.
TINY = shlex.split(
    "--steps 16 --cells 3 --split-at 0.5 --width 8 --depth 2 --rays 64 --samples 8 --evaluations 2 --eval-views 1 "
    "--lpips off"
)
#: Options of a field of plain networks, and of the default field with a smaller hash grid.
FIELDS = {
    "nerf": shlex.split("--field nerf --no-occupancy"),
    "hashgrid": shlex.split("--field-options log2_entries=10 levels=3"),
}
#: Options of a short `voronerf process`.
FEATURES = ("--max-features", "300")
#: The pose of the cameras, which look at the origin from 4 units away.
POSE = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 4], [0, 0, 0, 1]]
SIDE = 16
CAPTURE = {"fl_x": 20.0, "fl_y": 20.0, "cx": 8, "cy": 8, "w": SIDE, "h": SIDE, "k1": 0.0}


def prepare_scenes(inputs: Path) -> None:
    """Writes the same images as a Blender scene and as a capture."""
    noise = np.random.default_rng(0)
    for name, files in (("blender", ("transforms_train", "transforms_test")), ("capture", ("transforms",))):
        (inputs / name / "images").mkdir(parents=True)
        for file in files:
            frames = []
            for number in range(9):
                path = f"images/{file}_{number}.png"
                Image.fromarray(noise.integers(0, 255, (SIDE, SIDE, 4), dtype=np.uint8)).save(inputs / name / path)
                pose = [list(row) for row in POSE]
                pose[0][3] = 0.1 * number
                frames.append({"file_path": path, "transform_matrix": pose})
            lens = {"camera_angle_x": 0.7} if name == "blender" else CAPTURE
            (inputs / name / f"{file}.json").write_text(json.dumps({**lens, "frames": frames}))
    (inputs / "outside").mkdir()
    Image.fromarray(noise.integers(0, 255, (SIDE, SIDE, 3), dtype=np.uint8)).save(inputs / "outside" / "secret.png")


def prepare_photographs(inputs: Path) -> None:
    """Writes the scenes, and images with a COLMAP model (binary or text) or with LLFF poses."""
    prepare_scenes(inputs)
    poses = orbit_cameras(9, radius=4, elevation=20, width=SIDE, height=SIDE, focal=20, centre=(1, 2, 3)).poses
    points = np.random.default_rng(0).normal(size=(60, 3)) * 0.4 + (1, 2, 3)
    for name in ("colmap", "colmap-text", "llff"):
        write_images(inputs / name, [(SIDE, SIDE)] * 9)
        if name == "llff":
            write_llff(inputs / name, poses, (SIDE, SIDE), 20.0, (2.5, 5.5))
        else:
            write_colmap(inputs / name, poses, [(SIDE, SIDE)] * 9, points, binary=name == "colmap")
    if importlib.util.find_spec("pycolmap") is not None:
        prepare_process(inputs)


def prepare_process(inputs: Path) -> None:
    """Writes photographs, half of them with masks, and the folder of a `voronerf process` that stopped at its end."""
    views = orbit_cameras(40, radius=4, elevation=35, width=240, height=180, focal=200)[:8]
    write_walls(inputs / "photographs", views)
    (inputs / "photographs" / "masks").mkdir()
    for number in range(4):
        mask = Image.new("L", (240, 180), 255)
        mask.paste(0, (0, 0, 20, 180))
        mask.save(inputs / "photographs" / "masks" / f"{number:02} a.png")
    status, _, err = commands.run("process", inputs / "photographs", inputs / "stopped", *FEATURES)
    if status != 0:
        raise RuntimeError(err)
    shutil.rmtree(inputs / "stopped" / "sparse")  # written last


def prepare_runs(inputs: Path) -> None:
    """Writes the scenes, and runs with three checkpoints whose settings name a scene by a relative path."""
    prepare_scenes(inputs)
    os.chdir(inputs)
    for name, field in FIELDS.items():
        options = ("--data", "blender", *TINY, *field, "--checkpoint-every", "1e-9")
        status, _, err = commands.run("train", "--out", inputs / name, *options)
        if status != 0:
            raise RuntimeError(err)


def copied_run(inputs: Path, name: str, folder: Path) -> Path:
    """Copies a run, so that an attempt may change it."""
    os.chdir(inputs)
    return Path(shutil.copytree(inputs / name, folder / "run", symlinks=True))
