"""Attacks with hostile scenes."""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import struct
import zlib
from pathlib import Path

from attempts import Failed
from commands import judged
from hostile import VALUES, damaged, json_text, mutated
from input_files import FIELDS, SIDE, TINY
from PIL import Image


def stranger_scene(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Trains two steps on a changed scene: the command must succeed or refuse it in one line."""
    name = rng.choice(("blender", "capture", "colmap", "colmap-text", "llff"))
    scene = Path(shutil.copytree(inputs / name, folder / "scene"))
    outside = Path(shutil.copytree(inputs / "outside", folder / "outside"))
    transforms = name in ("blender", "capture")
    change = rng.choice((contents, contents, picture, path, text) if transforms else (model, model, picture, link))
    change(rng, scene, outside)
    field = FIELDS[rng.choice(list(FIELDS))]
    out = folder / "run"
    verdict = judged("train", "--data", scene, "--out", out, *TINY, *field, "--steps", "2")
    if change in (path, link) and verdict != "refused":
        raise Failed("an image outside of the scene was read")
    if sorted(file.name for file in outside.iterdir()) != ["secret.png"]:
        raise Failed("something was written outside")
    # For pictures without a file of cameras, COLMAP runs, and its results stay in `capture`.
    if verdict == "refused" and out.exists() and [path.name for path in out.iterdir()] != ["capture"]:
        raise Failed(f"{sorted(out.rglob('*'))} were written for a scene that was refused")
    return verdict


def model(rng: random.Random, scene: Path, outside: Path) -> None:
    """Damages a file of the COLMAP model or the LLFF poses, or changes a number in it."""
    file = rng.choice(sorted([*scene.glob("sparse/0/*"), *scene.glob("*.npy")]))
    data = file.read_bytes()
    if file.suffix == ".txt" and rng.random() < 0.7:
        words = data.decode().split(" ")
        words[rng.randrange(len(words))] = str(rng.choice(VALUES))
        data = " ".join(words).encode(errors="replace")
    elif rng.random() < 0.6:
        number = rng.choice((1e308, -1.0, 0.0, float("nan"), 1e-300, 1e30, 4e9, 2.0**63))
        other = rng.choice((struct.pack("<d", number), struct.pack("<q", rng.choice((-1, 0, 2**40, 2**62)))))
        at = rng.randrange(max(1, len(data) - 8))
        data = data[:at] + other + data[at + 8 :]
    else:
        data = damaged(rng, data)
    file.write_bytes(data)


def link(rng: random.Random, scene: Path, outside: Path) -> None:
    """Replaces an image, all images or the model's folder by links outside the scene."""
    there = scene / rng.choice(("images/01.jpg", "images", "sparse" if (scene / "sparse").is_dir() else "images"))
    away = outside.with_name("away") if there.is_dir() else outside / "secret.png"
    if there.is_dir():
        there.rename(away)
    else:
        there.unlink()
    there.symlink_to(away)


def transforms(rng: random.Random, scene: Path) -> Path:
    return rng.choice(sorted(scene.glob("*.json")))


def contents(rng: random.Random, scene: Path, outside: Path) -> None:
    """Changes one value of a transforms file."""
    file = transforms(rng, scene)
    value = mutated(rng, json.loads(file.read_text()))
    if rng.random() < 0.2 and isinstance(value, dict):
        names = "near", "far", "k1", "k2", "p1", "camera_model", "aabb_scale", "train_filenames", "mask_path"
        value[rng.choice(names)] = rng.choice((1e308, -1, "x", None, [], ["x"], 1e-300, "\x1b[2J"))
    file.write_bytes(json_text(value))


def text(rng: random.Random, scene: Path, outside: Path) -> None:
    """Damages a transforms file, or replaces it by a folder, a pipe or a link to a device."""
    file = transforms(rng, scene)
    data, kind = file.read_bytes(), rng.randrange(6)
    file.unlink()
    if kind == 0:
        file.mkdir()
    elif kind == 1:
        os.mkfifo(file)
    elif kind == 2:
        file.symlink_to("/dev/zero")
    else:
        file.write_bytes(damaged(rng, data))


def path(rng: random.Random, scene: Path, outside: Path) -> None:
    """Makes a frame's path or a linked folder lead to an image outside the scene."""
    file = transforms(rng, scene)
    value = json.loads(file.read_text())
    frame = rng.choice(value["frames"])
    kind = rng.randrange(5)
    if kind == 0:
        frame["file_path"] = "../outside/secret.png"
    elif kind == 1:
        frame["file_path"] = str(outside / "secret")
    elif kind == 2:
        frame["file_path"] = "images/../../outside/./secret.png"
    elif kind == 3:
        (scene / frame["file_path"]).unlink()
        (scene / frame["file_path"]).symlink_to(outside / "secret.png")
    else:
        (scene / "more").symlink_to(outside)
        frame["file_path"] = "more/secret.png"
    file.write_text(json.dumps(value))


def picture(rng: random.Random, scene: Path, outside: Path) -> None:
    """Replaces one image or all images."""
    images = sorted((scene / "images").iterdir())
    data = other_picture(rng, images[0].read_bytes())
    for image in images if rng.random() < 0.3 else [rng.choice(images)]:
        image.unlink()
        if data is None:
            os.mkfifo(image)
        else:
            image.write_bytes(data)


def other_picture(rng: random.Random, whole: bytes) -> bytes | None:
    """Returns bytes to replace a picture; None stands for a pipe, on which a reader would block."""
    kind = rng.randrange(9)
    if kind == 0:
        return None
    if kind <= 3:
        return damaged(rng, whole)
    if kind == 4:  # other formats; EPS would start a program
        file = io.BytesIO()
        Image.new("RGB", (SIDE, SIDE)).save(file, rng.choice(("EPS", "GIF", "TIFF", "BMP", "PPM", "PDF", "ICO", "TGA")))
        return file.getvalue()
    if kind == 5:  # other modes of a supported format
        file = io.BytesIO()
        mode = rng.choice(("1", "L", "P", "CMYK", "I;16", "LA"))
        Image.new(mode, (SIDE, SIDE)).save(file, "JPEG" if mode == "CMYK" else "PNG")
        return file.getvalue()
    if kind == 6:
        return rng.randbytes(rng.choice((0, 1, 30, 3000)))
    sizes = (30_000, 30_000), (13_000, 13_000), (5_000, 1), (2**31 - 1, 2**31 - 1), (0, 5), (SIDE, 10**6)
    return bomb(*rng.choice(sizes), rng.choice((1, 8, 16)), rng.choice((0, 2, 6)))


def bomb(width: int, height: int, depth: int, colour: int) -> bytes:
    """Returns a PNG of any size whose data is a few zeros."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(100_000))), (b"IEND", b""))
    text = b"\x89PNG\r\n\x1a\n"
    for name, data in chunks:
        text += struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
    return text
