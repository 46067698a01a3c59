"""Writes scenes to folders in the formats of Blender, nerfstudio, COLMAP and LLFF."""

import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from voronerf.app.scenes.lenses import MODELS
from voronerf.nerf.cameras import orbit_cameras

DATA = Path(os.environ.get("VORONERF_DATA", Path(__file__).parents[3].parent / "shared" / "data"))

#: The number of cameras around an object, the image size (width, height), and points that all cameras see.
COUNT, SIZE = 9, (12, 10)
POSES = orbit_cameras(COUNT, radius=4, elevation=20, width=12, height=10, focal=20, centre=(1, 2, 3)).poses
POINTS = np.random.default_rng(0).normal(size=(60, 3)) * 0.4 + (1, 2, 3)


def needs(name):
    """Returns the folder of a downloaded scene; skips the test if the folder is absent."""
    if not (DATA / name).is_dir():
        pytest.skip(f"{DATA / name} is not there; set VORONERF_DATA to a folder that holds {name}")
    return DATA / name


def write_blender(folder, scene, angle):
    """Writes a scene in the format of NeRF's Blender scenes."""
    for name, split in (("train", scene.train), ("test", scene.test)):
        (folder / name).mkdir(parents=True)
        frames = []
        for index, pose in enumerate(split.cameras.poses):
            Image.fromarray(split.images[index].numpy()).save(folder / name / f"r_{index}.png")
            frames.append({"file_path": f"./{name}/r_{index}", "transform_matrix": pose.tolist()})
        (folder / f"transforms_{name}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


def write_capture(folder, cameras, **entries):
    """Writes a nerfstudio capture whose image i has grey value i; the frames are listed in reverse order."""
    folder.mkdir(exist_ok=True)
    frames = []
    for index, pose in enumerate(cameras.poses):
        grey = np.full((cameras.height, cameras.width, 3), index, dtype=np.uint8)
        Image.fromarray(grey).save(folder / f"{index:02d}.png")
        frames.append({"file_path": f"{index:02d}.png", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 20.0, **entries, "frames": frames[::-1]}))


def write_frames(folder, poses, name="images/{:02d}.jpg".format, **entries):
    """Writes a transforms.json with a frame for each pose; ``name`` maps the number of a pose to the image's name."""
    frames = [{"file_path": name(index), "transform_matrix": pose.tolist()} for index, pose in enumerate(poses)]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 20, **entries, "frames": frames}))


def write_walls(folder, views):
    """Writes images, named "00 a.png" and so on, of a textured floor and a wall behind it; COLMAP finds their cameras.

    The cameras ``views`` stand around the origin.
    """
    folder.mkdir(exist_ok=True)
    generator = np.random.default_rng(0)
    floor, wall = _texture(generator), _texture(generator)
    back = views.origins.mean(0)[:2] / views.origins.mean(0)[:2].norm()
    for index in range(len(views)):
        rays = views.image_rays(index)
        origin, direction = rays.origins.double(), rays.directions.double()
        to_floor = (-1 - origin[:, 2]) / direction[:, 2]
        to_wall = (-2 - origin[:, :2] @ back.double()) / (direction[:, :2] @ back.double())
        to_floor, to_wall = (torch.where(t > 0, t, 1e3) for t in (to_floor, to_wall))
        point = (origin + torch.minimum(to_floor, to_wall)[:, None] * direction).numpy()
        side = point[:, 0] * float(back[1]) - point[:, 1] * float(back[0])
        u = np.where(to_floor < to_wall, point[:, 0], side)
        v = np.where(to_floor < to_wall, point[:, 1], point[:, 2])
        column, row = ((np.clip(x / 8 + 0.5, 0, 0.999) * 512).astype(int) for x in (u, v))
        grey = np.where(to_floor < to_wall, floor[row, column], wall[row, column])
        Image.fromarray(grey.reshape(views.height, views.width)).convert("RGB").save(folder / f"{index:02} a.png")


def _texture(generator):
    """Returns a random grey texture, uint8 [512, 512], with detail at several scales."""
    total = np.zeros((512, 512))
    for size in (16, 32, 64, 128, 256):
        total += np.kron(generator.normal(size=(size, size)), np.ones((512 // size, 512 // size))) / size**0.25
    return np.clip(128 + 45 * total, 0, 255).astype(np.uint8)


def rewrite(folder, change, name="transforms", **options):
    """Applies a function to the contents of a transforms file; returns the changed contents."""
    path = folder / f"{name}.json"
    contents = json.loads(path.read_text())
    change(contents)
    path.write_text(json.dumps(contents), **options)
    return contents


def write_images(folder, sizes, **save):
    """Writes JPEG images with the sizes (width, height); image i has grey value i."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for index, (width, height) in enumerate(sizes):
        Image.fromarray(np.full((height, width, 3), index, np.uint8)).save(folder / f"images/{index:02d}.jpg", **save)


def write_deep(path, values):
    """Writes 16-bit values [h, w, channels] as PNG, or colours as TIFF."""
    height, width, channels = values.shape
    if path.suffix == ".png":
        rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
        header = struct.pack(">2I5B", width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
        parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
        chunks = [struct.pack(">I", len(part)) + kind + part for kind, part in parts]
        checked = [chunk + struct.pack(">I", zlib.crc32(chunk[4:])) for chunk in chunks]
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(checked))
    else:
        tags = {256: width, 257: height, 258: 122, 259: 1, 262: 2, 273: 128, 277: 3, 278: height, 279: values.size * 2}
        counts = [(tag, 3, 3 if tag == 258 else 1, value) for tag, value in tags.items()]
        entries = b"".join(struct.pack("<2H2I", *each) for each in counts)
        start = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + b"\0" * 4
        path.write_bytes(start.ljust(122, b"\0") + struct.pack("<3H", 16, 16, 16) + values.astype("<u2").tobytes())


def quaternion(turn):
    """Returns the unit quaternion (w, x, y, z) of a rotation matrix."""
    rows = (
        [turn[0, 0] - turn[1, 1] - turn[2, 2], 0, 0, 0],
        [turn[0, 1] + turn[1, 0], turn[1, 1] - turn[0, 0] - turn[2, 2], 0, 0],
        [turn[0, 2] + turn[2, 0], turn[1, 2] + turn[2, 1], turn[2, 2] - turn[0, 0] - turn[1, 1], 0],
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1], np.trace(turn)],
    )
    values, vectors = np.linalg.eigh(np.array(rows) / 3)
    x, y, z, w = vectors[:, values.argmax()]
    return np.array([w, x, y, z])


def write_colmap(folder, poses, sizes, points, *, binary=True, lenses=None):
    """Writes a COLMAP model with one camera per image; the images are not in the order of their names.

    `lenses` holds a camera model and its parameters for each image, SIMPLE_RADIAL if absent. Every image sees every
    point.
    """
    lenses = lenses or [("SIMPLE_RADIAL", (20.0, 6.0, 5.0, 0.02))] * len(sizes)
    numbers = {name: number for number, (name, _) in MODELS.items()}
    (folder / "sparse/0").mkdir(parents=True, exist_ok=True)
    cameras, images = {}, {}
    for index, (pose, (width, height), lens) in enumerate(zip(np.asarray(poses, np.float64), sizes, lenses)):
        turn = (pose[:3, :3] * (1, -1, -1)).T
        cameras[index + 1] = (width, height, *lens)
        images[index + 1] = (*quaternion(turn), *(-turn @ pose[:3, 3]), index + 1, f"{index:02d}.jpg")
    order = sorted(images, reverse=True)
    seen = [(1.0, 1.0, number) for number in range(len(points))]
    if not binary:
        lines = [f"{key} {name} {w} {h} {' '.join(map(repr, p))}" for key, (w, h, name, p) in cameras.items()]
        (folder / "sparse/0/cameras.txt").write_text("# cameras\n" + "\n".join(lines) + "\n")
        second = " ".join(f"{x} {y} {number}" for x, y, number in seen)
        lines = [f"{key} {' '.join(str(x) for x in images[key])}\n{second}" for key in order]
        (folder / "sparse/0/images.txt").write_text("# images\n" + "\n".join(lines) + "\n")
        track = " ".join(f"{key} 0" for key in order)
        lines = [f"{i} {' '.join(map(str, p))} 9 9 9 0.5 {track}" for i, p in enumerate(points)]
        (folder / "sparse/0/points3D.txt").write_text("\n".join(lines) + "\n")
        return
    data = [struct.pack("<Q", len(cameras))]
    data += [struct.pack(f"<IiQQ{len(p)}d", key, numbers[name], w, h, *p) for key, (w, h, name, p) in cameras.items()]
    (folder / "sparse/0/cameras.bin").write_bytes(b"".join(data))
    data = [struct.pack("<Q", len(images))]
    for key in order:
        *values, camera, name = images[key]
        data += [struct.pack("<I7dI", key, *values, camera), name.encode() + b"\0", struct.pack("<Q", len(seen))]
        data += [struct.pack("<ddq", *sighting) for sighting in seen]
    (folder / "sparse/0/images.bin").write_bytes(b"".join(data))
    data = [struct.pack("<Q", len(points))]
    for index, point in enumerate(points):
        data += [struct.pack("<Q3d3BdQ", index, *point, 9, 9, 9, 0.5, len(order))]
        data += [struct.pack("<II", key, 0) for key in order]
    (folder / "sparse/0/points3D.bin").write_bytes(b"".join(data))


def write_llff(folder, poses, size, focal, bounds):
    """Writes LLFF's poses_bounds.npy: axes (down, right, backwards), position, height, width, focal length, bounds."""
    poses = np.asarray(poses, np.float64)
    lens = np.broadcast_to(np.array([size[1], size[0], focal]), (len(poses), 3))
    matrix = np.stack((-poses[:, :3, 1], poses[:, :3, 0], poses[:, :3, 2], poses[:, :3, 3], lens), axis=-1)
    rows = np.concatenate((matrix.reshape(len(poses), 15), np.broadcast_to(bounds, (len(poses), 2))), axis=1)
    np.save(folder / "poses_bounds.npy", rows)


def oriented(tag):
    """Returns Exif data with an orientation tag."""
    exif = Image.Exif()
    exif[0x0112] = tag
    return exif


def write_both(folder, sizes=(SIZE,) * COUNT, *, binary=True, **save):
    write_images(folder, sizes, **save)
    write_colmap(folder, POSES, sizes, POINTS, binary=binary)
    write_llff(folder, POSES, SIZE, 20.0, (2.5, 5.5))


def every(scene):
    """Returns (names, poses) of all views, sorted by name."""
    rows = [*zip(scene.train.names, scene.train.cameras.poses), *zip(scene.test.names, scene.test.cameras.poses)]
    return [name for name, _ in sorted(rows)], torch.stack([pose for _, pose in sorted(rows)])


def check_pairs(scene, count=COUNT):
    """Checks that a scene, not normalised, has ``count`` images, and that an image of grey value i has pose i."""
    assert len(scene.train) + len(scene.test) == count
    for split in (scene.train, scene.test):
        for image, pose in zip(split.images, split.cameras.poses):
            torch.testing.assert_close(pose, POSES[int(image[0, 0, 0])], atol=1e-5, rtol=0)
    return scene
