"""Checkpoints: safetensors files, written atomically, read without pickle, and verified by checksums.

The tensors belong to the routers with their diagrams, the optimiser, the sample reservoir and the random generators.
All other values (configuration, counters, stages) are JSON in the file's metadata, with a checksum for each tensor and
a checksum for the JSON.
"""

from __future__ import annotations

import json
import re
import threading
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from voronerf.app.files import parse_json, rename, write_bytes
from voronerf.app.wording import similar_path

FORMAT = "voronerf-checkpoint-2"
#: The key of the JSON's checksum among the tensors' checksums.
_VALUES = "values"


class CheckpointError(ValueError):
    """A checkpoint that cannot be read, or that belongs to another configuration; the message names the file."""


@dataclass(frozen=True)
class Checkpoint:
    """The contents of a checkpoint: tensors by name, all other values as JSON values, and the file name for errors."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]
    source: str = "checkpoint"

    def group(self, prefix: str) -> dict[str, Tensor]:
        """Returns the tensors whose names begin with ``prefix.``, under their names without this prefix."""
        return {name[len(prefix) + 1 :]: t for name, t in self.tensors.items() if name.startswith(prefix + ".")}


def checkpoint_path(run: Path) -> Path:
    """Returns the path of the last checkpoint in a run directory."""
    return run / "checkpoints" / "last.safetensors"


def checkpoint_paths(run: Path) -> list[Path]:
    """Returns the checkpoints in a run directory, the latest first: last, last-1, last-2, ..."""
    last = checkpoint_path(run)
    earlier = [p for p in last.parent.glob("last-*.safetensors") if p.stem[5:].isdecimal()]
    return [last] * last.is_file() + sorted(earlier, key=lambda path: int(path.stem[5:]))


def keep_checkpoint(run: Path, checkpoint: Checkpoint, keep: int) -> None:
    """Writes a checkpoint as the last one, renames older ones to ``last-1``, ..., and deletes all but ``keep``.

    If the new checkpoint cannot be written, the older ones stay unchanged.
    """
    last = checkpoint_path(run)
    written = last.with_name("new.safetensors")
    save_checkpoint(written, checkpoint)
    # The oldest one first, so that a crash leaves a gap in the numbers but loses no checkpoint.
    for number, path in reversed(list(enumerate(checkpoint_paths(run), 1))):
        if number < keep:
            rename(path, last.with_name(f"last-{number}.safetensors"))
        else:
            path.unlink()
    rename(written, last)


class CheckpointWriter:
    """Writes the checkpoints of a run one after another, in a background thread."""

    def __init__(self, run: Path, keep: int) -> None:
        self.run, self.keep = run, keep
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None

    @property
    def busy(self) -> bool:
        """Returns whether a checkpoint is being written."""
        return self._thread is not None and self._thread.is_alive()

    def write(self, checkpoint: Checkpoint) -> None:
        """Starts writing a checkpoint, after the previous one is written; its tensors must not change meanwhile."""
        self.wait()
        self._error = MemoryError("no memory for the thread that writes a checkpoint")  # the thread clears it

        def run() -> None:
            try:
                keep_checkpoint(self.run, checkpoint, self.keep)
            except BaseException as error:
                self._error = error
            else:
                self._error = None

        # A daemon thread, since a second Ctrl-C must end the process at once.
        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Waits until the checkpoint is written, and raises the error of its thread, if any."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._error is not None:
            error, self._error = self._error, None
            raise error


def _all(name: str) -> bool:
    return True


def is_shown(name: str) -> bool:
    """Returns whether rendering needs the tensor with this name; other tensors are for training alone."""
    return name.startswith(("router", "part-", "occupancy.")) or name.endswith(".average")


def last_checkpoint(run: Path, *, keep: Callable[[str], bool] = _all) -> Checkpoint:
    """Returns the last readable checkpoint of a run, and warns if it skips unreadable ones.

    Args:
        run: The run directory.
        keep: Function that selects tensors by name; see :func:`load_checkpoint`.

    Raises:
        CheckpointError: If there is no readable checkpoint.
    """
    paths = checkpoint_paths(run)
    if not paths:
        raise CheckpointError(no_run(run, "checkpoint"))
    errors = []
    for path in paths:
        try:
            checkpoint = load_checkpoint(path, keep=keep)
        except CheckpointError as error:
            errors.append(error)
            continue
        if errors:
            warnings.warn(f"{errors[0]}; using {path.name} instead", stacklevel=2)
        return checkpoint
    raise errors[0]


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Writes a checkpoint atomically: on failure, an older file at ``path`` stays unchanged."""
    values = json.dumps(checkpoint.values)
    sums = {name: _checksum(tensor) for name, tensor in checkpoint.tensors.items()}
    sums[_VALUES] = zlib.crc32(values.encode())
    metadata = {"format": FORMAT, "values": values, "checksums": json.dumps(sums)}
    write_bytes(path, save(checkpoint.tensors, metadata))


def no_run(path: Path, file: str) -> str:
    """Returns the error message for a path without a run, in which ``file`` is missing.

    The message suggests a run that contains the path, lies in it, or has a similar name.
    """
    reason = f"there is no {file} in it" if path.is_dir() else "it is a file" if path.is_file() else None
    parents = [folder for folder in path.parents if (folder / "config.json").is_file()]
    candidates = parents[:1] or sorted(config.parent for config in path.glob("*/config.json"))[:1]
    similar = [config.parent for config in path.parent.glob("*/config.json")]
    hint = f"; did you mean {candidates[0]}?" if candidates else similar_path(path, similar)
    return f"no run at {path}: {reason or 'there is no such folder'}{hint}"


def load_checkpoint(path: Path, *, keep: Callable[[str], bool] = _all) -> Checkpoint:
    """Reads a checkpoint onto the CPU.

    Args:
        path: The file.
        keep: Function that takes a tensor's name, and returns whether to read and verify the tensor. The other tensors
            must exist, too.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: there is no checkpoint")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            version = re.fullmatch(r"voronerf-checkpoint-(\d{1,9})", str(metadata.get("format")))
            if version and int(version[1]) > int(FORMAT.rpartition("-")[2]):
                raise CheckpointError(f"{path}: must be a {FORMAT} file, got {version[0]} of a newer voronerf")
            if metadata.get("format") != FORMAT:
                raise CheckpointError(f"{path}: not a {FORMAT} file, its format is {metadata.get('format')!r}")
            sums = parse_json(metadata["checksums"])
            names = [*file.keys()]
            # Copied: a mapped file that is cut short would end the process by SIGBUS when its pages are read.
            tensors = {name: file.get_tensor(name).clone() for name in names if keep(name)}
        if missing := sorted(sums.keys() ^ {*names, _VALUES}):
            raise CheckpointError(f"{path}: a damaged checkpoint, {missing[0]} or its checksum is missing")
        checked = {name: _checksum(tensor) for name, tensor in tensors.items()}
        checked[_VALUES] = zlib.crc32(metadata["values"].encode())
        if wrong := sorted(name for name, checksum in checked.items() if checksum != sums[name]):
            raise CheckpointError(f"{path}: a damaged checkpoint, {wrong[0]} has another checksum")
        return Checkpoint(tensors, parse_json(metadata["values"]), str(path))
    except CheckpointError:
        raise
    except (SafetensorError, ValueError, KeyError, AttributeError, OSError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint: {error}") from None


def _checksum(tensor: Tensor) -> int:
    """Returns the checksum of a tensor's elements, shape and dtype."""
    kind = zlib.crc32(f"{tensor.dtype} {list(tensor.shape)}".encode())
    return zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy().data, kind)


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Returns the optimiser's per-parameter state as tensors named ``INDEX.KEY`` (Adam's state is tensors alone)."""
    state = optimizer.state_dict()["state"]
    return {f"{index}.{key}": value for index, s in state.items() for key, value in s.items()}


def load_optimizer_tensors(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Restores the tensors of :func:`optimizer_tensors`; parameter groups and learning rates stay unchanged."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, _, key = name.partition(".")
        if not (index.isdecimal() and int(index) < len(parameters) and key):
            raise ValueError(f"optimizer.{name} must be of one of {len(parameters)} parameters")
        state.setdefault(int(index), {})[key] = tensor.clone()  # the optimiser updates its state in place
    for number, entries in state.items():
        for key in ("exp_avg", "exp_avg_sq", *entries):
            wanted = [] if key == "step" else list(parameters[number].shape)
            actual = list(entries[key].shape) if key in entries else None
            if actual != wanted:
                raise ValueError(f"optimizer.{number}.{key} must have shape {wanted}, got {actual or 'nothing'}")
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
