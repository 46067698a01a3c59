"""The cameras of a run as a ``transforms.json``, which nerfstudio, instant-ngp and voronerf read."""

from __future__ import annotations

import glob
from pathlib import Path

import torch

from voronerf.app.run import Run
from voronerf.app.scenes.images import read_header
from voronerf.app.scenes.lenses import Lens
from voronerf.app.scenes.transforms import Shot, write_transforms
from voronerf.nerf.cameras import Cameras

SUFFIXES = (".json",)


def export_cameras(run: Run, path: Path | str, *, to_files: bool = False) -> int:
    """Writes the training cameras, and the test cameras, which stay held out.

    Args:
        run: The run.
        path: The file. If ``images`` beside it holds the pictures, the cameras have their sizes, else those of the
            training.
        to_files: In the coordinates of the scene's files, not in those of the scene.

    Returns:
        The number of cameras.

    Raises:
        SceneError: For a lens that the format does not have.
        OSError: When the file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_cameras
        >>> def count(run: Run) -> int:
        ...     return export_cameras(run, "capture/transforms.json", to_files=True)
    """
    path, transform, shots = Path(path), run.scene.transform, dict[str, list[Shot]]()
    for name in ("train", "test"):
        part = getattr(run.scene, name)
        cameras = part.cameras
        if to_files and transform is not None:
            cameras = cameras.moved(torch.linalg.inv(transform))
        shots[name] = [_shot(cameras, number, view, path.parent) for number, view in enumerate(part.names)]
    every = [shot for part in shots.values() for shot in part]
    lists = {f"{name}_filenames": [shot.file for shot in part] for name, part in shots.items()}
    write_transforms(path, every, **lists)
    return len(every)


def _shot(cameras: Cameras, number: int, name: str, folder: Path) -> Shot:
    size, file = cameras.size(number), f"images/{name}"
    width, height = size
    for image in sorted((folder / "images").glob(glob.escape(name) + ".*"))[:1]:
        file, (width, height) = f"images/{image.name}", read_header(image, 1).size
    intrinsics = tuple((cameras.intrinsics[number] * max(1, round(width / size[0]))).tolist())
    coefficients = () if cameras.distortion is None else tuple(cameras.distortion[number].tolist())
    model = 0 if cameras.models is None else int(cameras.models[number])
    return Shot(file, cameras.poses[number], Lens(intrinsics, coefficients, model), width, height)
