"""Attacks on the image cache: files are damaged, truncated, or replaced by other images or by links."""

from __future__ import annotations

import json
import os
import random
import shutil
from pathlib import Path

import torch
from attempts import REFUSED, RIGHT, Failed
from hostile import damaged, flipped, json_text, mutated

from voronerf.app.scenes import SceneError, load_scene
from voronerf.app.train.build import make_batches
from voronerf.app.train.config import TrainConfig


def harmed_store(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Harms the image cache: it must return the scene's current images or refuse in one line."""
    os.environ["VORONERF_CACHE"] = str(folder / "cache")
    scene = Path(shutil.copytree(inputs / "blender", folder / "scene"))
    outside = Path(shutil.copytree(inputs / "outside", folder / "outside"))
    (outside / "pixels").write_bytes(b"mine")
    before = {path.name: path.read_bytes() for path in outside.iterdir()}
    load_scene(scene, images="disk")
    (store,) = (folder / "cache" / "images").iterdir()
    change = rng.choice((pixels, pixels, record, replaced, link, cut))
    change(rng, store, scene, outside)
    try:
        found = load_scene(scene, images="disk").train.images
        if not torch.equal(found, load_scene(scene, images="memory").train.images):
            raise Failed(f"images differ from the scene's after {change.__name__}")
        verdict = RIGHT
    except SceneError as error:
        if "\n" in str(error) or str(folder) not in str(error):
            raise Failed(f"not one line that names the file: {error}") from None
        verdict = REFUSED
    if {path.name: path.read_bytes() for path in outside.iterdir()} != before:
        raise Failed("something outside of the cache was changed")
    return verdict


def pixels(rng: random.Random, store: Path, scene: Path, outside: Path) -> None:
    """Damages the pixels: flips a bit, overwrites a piece, or cuts off the end."""
    data = (store / "pixels").read_bytes()
    data = flipped(data, rng.randrange(8 * len(data))) if rng.random() < 0.5 else damaged(rng, data)
    (store / "pixels").write_bytes(data)


def record(rng: random.Random, store: Path, scene: Path, outside: Path) -> None:
    """Damages store.json, or changes a value in it."""
    path = store / "store.json"
    text = path.read_bytes()
    path.write_bytes(damaged(rng, text) if rng.random() < 0.5 else json_text(mutated(rng, json.loads(text))))


def replaced(rng: random.Random, store: Path, scene: Path, outside: Path) -> None:
    """Replaces an image of the scene by another image with the same file size and time."""
    two = rng.sample(sorted((scene / "images").glob("transforms_train*")), 2)
    second, first = sorted(two, key=lambda path: path.stat().st_size)
    times = first.stat().st_atime_ns, first.stat().st_mtime_ns
    other = second.read_bytes().ljust(first.stat().st_size, b"\0")
    if rng.random() < 0.5:
        first.unlink()
    first.write_bytes(other)
    os.utime(first, ns=times)


def link(rng: random.Random, store: Path, scene: Path, outside: Path) -> None:
    """Replaces a file or a folder of the cache by a link."""
    there = rng.choice((store, store.parent, store / "pixels", store / "store.json"))
    if there.is_dir():
        shutil.rmtree(there)
    else:
        there.unlink()
    there.symlink_to(rng.choice((outside, outside / "pixels", "/dev/zero", "/nowhere", there.name)))


def cut(rng: random.Random, store: Path, scene: Path, outside: Path) -> None:
    """Truncates the pixel file of an open scene; the next batch must report this."""
    used = load_scene(scene, images="disk")
    batches = make_batches(TrainConfig(device="cpu"), used)
    os.truncate(store / "pixels", rng.randrange((store / "pixels").stat().st_size))
    try:
        batches.draw(64, torch.Generator().manual_seed(0))
    except SceneError:
        return
    raise Failed("a file that was cut short was read")
