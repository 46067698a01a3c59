"""Attacks with damaged checkpoints and hostile runs."""

from __future__ import annotations

import json
import os
import random
import shutil
import warnings
from pathlib import Path

import torch
from attempts import REFUSED, RIGHT, Failed
from commands import judged
from hostile import damaged, flipped, json_text, mutated
from input_files import FIELDS, copied_run

from voronerf.app.train.checkpoint import (
    Checkpoint,
    CheckpointError,
    checkpoint_path,
    checkpoint_paths,
    last_checkpoint,
    load_checkpoint,
    save_checkpoint,
)

COMMANDS: tuple[tuple[str, ...], ...] = (
    ("eval", "--views", "1", "--panels", "1", "--lpips", "off"),
    ("render", "--frames", "1"),
    ("export", "--web", "{run}/page.html"),
    ("train", "--resume", "--steps", "18", "--lpips", "off", "--out"),
)


def same(first: Checkpoint, second: Checkpoint) -> bool:
    """Returns whether two checkpoints are equal bit for bit."""
    if first.values != second.values or first.tensors.keys() != second.tensors.keys():
        return False
    pairs = ((first.tensors[name], second.tensors[name]) for name in first.tensors)
    return all(a.dtype == b.dtype and a.shape == b.shape and torch.equal(bits(a), bits(b)) for a, b in pairs)


def bits(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.reshape(-1).view(torch.uint8)


def flipped_bit(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Damages a checkpoint: the library must refuse it and load the previous checkpoint."""
    run = copied_run(inputs, rng.choice(list(FIELDS)), folder)
    path = checkpoint_path(run)
    whole, data = load_checkpoint(path), path.read_bytes()
    older = load_checkpoint(checkpoint_paths(run)[1])
    # Half of the damage hits the header, a small part of the file with the most structure.
    bit = rng.randrange(8 * min(len(data), 6000 if rng.random() < 0.5 else len(data)))
    path.write_bytes(flipped(data, bit) if rng.random() < 0.7 else damaged(rng, data))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = last_checkpoint(run)
    if same(found, whole):
        return RIGHT  # the change has no effect, like a space in the header
    if not same(found, older) or len(said) != 1 or str(path) not in str(said[0].message):
        raise Failed(f"a damaged checkpoint was taken, or another than the one before it: {said}")
    try:
        load_checkpoint(path)
    except CheckpointError as error:
        if str(path) in str(error) and "\n" not in str(error):
            return REFUSED
        raise Failed(f"not one line that names the file: {error}") from None
    raise Failed("a damaged checkpoint was read")


def stranger_run(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Changes settings, tensors, files or links of a run: a command must succeed or refuse it in one line."""
    run = copied_run(inputs, rng.choice(list(FIELDS)), folder)
    outside = Path(shutil.copytree(inputs / "outside", folder / "outside"))
    change = rng.choice((config, values, values, tensors, tensors, metrics, links, files))
    if change in (values, tensors) and rng.random() < 0.7:
        for path in checkpoint_paths(run)[1:]:  # so that no other checkpoint is loaded
            path.unlink()
    change(rng, run, outside)
    before = contents(folder, run)
    verdict = judged(*(part.format(run=run) for part in rng.choice(COMMANDS)), run)
    if contents(folder, run) != before:
        raise Failed("something outside of the run was changed")
    return verdict


def contents(folder: Path, run: Path) -> dict[str, bytes]:
    """Returns the contents of the files outside a run."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_relative_to(run))
    return {str(path): path.read_bytes() for path in files}


def config(rng: random.Random, run: Path, outside: Path) -> None:
    path = run / "config.json"
    path.write_bytes(json_text(mutated(rng, json.loads(path.read_text()))))


def values(rng: random.Random, run: Path, outside: Path) -> None:
    """Changes values of a checkpoint with a valid checksum; often changes settings in config.json too."""
    path = checkpoint_path(run)
    checkpoint = load_checkpoint(path)
    other = mutated(rng, checkpoint.values)
    try:
        save_checkpoint(path, Checkpoint(checkpoint.tensors, other))
    except (RecursionError, ValueError):
        return
    if isinstance(other.get("config"), dict) and rng.random() < 0.7:
        (run / "config.json").write_bytes(json_text(other["config"]))


def tensors(rng: random.Random, run: Path, outside: Path) -> None:
    """Removes tensors, or changes their shape, dtype or values."""
    path = checkpoint_path(run)
    checkpoint = load_checkpoint(path)
    held = dict(checkpoint.tensors)
    name = rng.choice(list(held))
    there, kind = held[name], rng.randrange(7)
    if kind == 0:
        prefix = name if rng.random() < 0.5 else name.split(".")[0]
        held = {other: tensor for other, tensor in held.items() if not other.startswith(prefix)}
    elif kind == 1:
        held[name] = there.flatten() if there.dim() != 1 else there[None]
    elif kind == 2:
        kinds = torch.float64, torch.float16, torch.int64, torch.int32, torch.bool, torch.uint8
        held[name] = there.to(rng.choice(kinds))
    elif kind == 3:
        held[name] = torch.cat([there.reshape(1) if there.dim() == 0 else there] * 2)
    elif kind == 4:
        numbers = (torch.nan, torch.inf, -1e38, 0.0) if there.is_floating_point() else (-1, 2**31 - 1, 7, -(2**31))
        value = rng.choice(numbers) if there.dtype not in (torch.uint8, torch.bool) else 255
        held[name] = torch.where(torch.rand(there.shape) < 0.3, torch.full_like(there, value), there)
    elif kind == 5:
        held[name] = there[:0] if there.dim() else there
    else:
        names = "", "x", "router.x", "optimizer.99.exp_avg", "optimizer.x", "generator.y", "\x1b[2J"
        held[rng.choice(names)] = there.clone()
    save_checkpoint(path, Checkpoint({key: tensor.contiguous() for key, tensor in held.items()}, checkpoint.values))


def metrics(rng: random.Random, run: Path, outside: Path) -> None:
    path = run / "metrics.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    if rng.random() < 0.5:
        path.write_bytes(damaged(rng, path.read_bytes()))
    else:
        path.write_bytes(b"\n".join(json_text(line) for line in mutated(rng, lines)))


def links(rng: random.Random, run: Path, outside: Path) -> None:
    """Replaces a folder or a file by a link that leads out of the run."""
    there = run / rng.choice(("checkpoints", "images", "plots", "samples", "eval.json", "video.mp4", "metrics.jsonl"))
    if there.is_dir():
        shutil.rmtree(there)
    else:
        there.unlink(missing_ok=True)
    there.symlink_to(rng.choice((outside, outside / "mine", "../outside", "..", "/nowhere", there.name)))


def files(rng: random.Random, run: Path, outside: Path) -> None:
    """Replaces a file by a folder, a pipe or other contents."""
    names = "config.json", "checkpoints/last.safetensors", "metrics.jsonl", "eval.json", "summary.json"
    path = run / rng.choice(names)
    path.unlink(missing_ok=True)
    kind = rng.randrange(5)
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        os.mkfifo(path)
    elif kind == 2:
        path.write_bytes(rng.randbytes(rng.choice((0, 1, 8, 1000))))
    elif kind == 3:
        path.symlink_to("/dev/zero")
    else:
        path.write_bytes((2**62).to_bytes(8, "little") + b"{}")
