"""Scenes written to folders, as Blender's and as captures."""

import json
from typing import Any

import numpy as np
from PIL import Image

Contents = dict[str, Any]


def write_blender(folder, scene, angle):
    """Writes a scene the way Blender's are stored."""
    for name, split in (("train", scene.train), ("test", scene.test)):
        (folder / name).mkdir(parents=True)
        frames = []
        for index, pose in enumerate(split.cameras.poses):
            Image.fromarray(split.images[index].numpy()).save(folder / name / f"r_{index}.png")
            frames.append({"file_path": f"./{name}/r_{index}", "transform_matrix": pose.tolist()})
        (folder / f"transforms_{name}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


def write_capture(folder, cameras, **entries):
    """A capture whose image i is of grey i; its frames are listed from the last to the first."""
    folder.mkdir(exist_ok=True)
    frames = []
    for index, pose in enumerate(cameras.poses):
        grey = np.full((cameras.height, cameras.width, 3), index, dtype=np.uint8)
        Image.fromarray(grey).save(folder / f"{index:02d}.png")
        frames.append({"file_path": f"{index:02d}.png", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 20.0, **entries, "frames": frames[::-1]}))


def rewrite(folder, change, name="transforms", **options):
    """Changes the contents of a file of transforms; returns them."""
    path = folder / f"{name}.json"
    contents = json.loads(path.read_text())
    change(contents)
    path.write_text(json.dumps(contents), **options)
    return contents
