"""Checkpoints: safetensors files, written atomically, read without pickle, and refused where a bit of them changed.

The tensors are those of the routers with their diagrams, of the optimiser, of the sample reservoir and of the random
generators. Everything else (configuration, counters, stages) is JSON in the metadata of the file, beside a checksum for
each tensor and one for the JSON.
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
#: The name of the checksum of the JSON, beside those of the tensors.
_VALUES = "values"


class CheckpointError(ValueError):
    """A checkpoint that cannot be read, or that belongs to another configuration; the message names the file."""


@dataclass(frozen=True)
class Checkpoint:
    """The contents of a checkpoint: tensors by name, everything else as JSON values, and the file that errors name."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]
    source: str = "checkpoint"

    def group(self, prefix: str) -> dict[str, Tensor]:
        """The tensors below ``prefix.``, without it."""
        return {name[len(prefix) + 1 :]: t for name, t in self.tensors.items() if name.startswith(prefix + ".")}


def checkpoint_path(run: Path) -> Path:
    """Where a run directory keeps its last checkpoint."""
    return run / "checkpoints" / "last.safetensors"


def checkpoint_paths(run: Path) -> list[Path]:
    """The checkpoints that a run directory has, the last first: last, last-1, last-2..."""
    last = checkpoint_path(run)
    earlier = [p for p in last.parent.glob("last-*.safetensors") if p.stem[5:].isdecimal()]
    return [last] * last.is_file() + sorted(earlier, key=lambda path: int(path.stem[5:]))


def keep_checkpoint(run: Path, checkpoint: Checkpoint, keep: int) -> None:
    """Writes the last checkpoint of a run; the one before becomes ``last-1``; ``keep`` stay, on failure all."""
    last = checkpoint_path(run)
    written = last.with_name("new.safetensors")
    save_checkpoint(written, checkpoint)
    # From the oldest on, so that a crash at any moment leaves a gap in the numbers and no fewer checkpoints.
    for number, path in reversed(list(enumerate(checkpoint_paths(run), 1))):
        if number < keep:
            rename(path, last.with_name(f"last-{number}.safetensors"))
        else:
            path.unlink()
    rename(written, last)


class CheckpointWriter:
    """Writes the checkpoints of a run one after the other, beside what the caller does."""

    def __init__(self, run: Path, keep: int) -> None:
        self.run, self.keep = run, keep
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None

    @property
    def busy(self) -> bool:
        """Whether a checkpoint is being written."""
        return self._thread is not None and self._thread.is_alive()

    def write(self, checkpoint: Checkpoint) -> None:
        """Begins to write a checkpoint, after the one before; its tensors must not change."""
        self.wait()
        self._error = MemoryError("no memory for the thread that writes a checkpoint")  # until that has done so

        def run() -> None:
            try:
                keep_checkpoint(self.run, checkpoint, self.keep)
            except BaseException as error:
                self._error = error
            else:
                self._error = None

        # The end of the process does not wait for it: a second Ctrl-C is to end it at once.
        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Returns when the checkpoint is written."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._error is not None:
            error, self._error = self._error, None
            raise error


def _all(name: str) -> bool:
    return True


def is_shown(name: str) -> bool:
    """Whether a tensor is for pictures, and not for training alone."""
    return name.startswith(("router", "part-", "occupancy.")) or name.endswith(".average")


def last_checkpoint(run: Path, *, keep: Callable[[str], bool] = _all) -> Checkpoint:
    """The last checkpoint of a run that can be read; a warning tells of those passed over.

    Args:
        run: The run directory.
        keep: See :func:`load_checkpoint`.

    Raises:
        CheckpointError: When there is none.
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
            warnings.warn(f"{errors[0]}; {path.name} takes its place", stacklevel=2)
        return checkpoint
    raise errors[0]


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Writes a checkpoint atomically: on failure an older one at ``path`` is untouched."""
    values = json.dumps(checkpoint.values)
    sums = {name: _checksum(tensor) for name, tensor in checkpoint.tensors.items()}
    sums[_VALUES] = zlib.crc32(values.encode())
    metadata = {"format": FORMAT, "values": values, "checksums": json.dumps(sums)}
    write_bytes(path, save(checkpoint.tensors, metadata))


def no_run(path: Path, file: str) -> str:
    """The message for a path without a run, whose folder lacks a file; names a run that the path lies in, holds, or is
    like."""
    reason = f"there is no {file} in it" if path.is_dir() else "it is a file" if path.is_file() else None
    around = [folder for folder in path.parents if (folder / "config.json").is_file()]
    near = around[:1] or sorted(config.parent for config in path.glob("*/config.json"))[:1]
    similar = [config.parent for config in path.parent.glob("*/config.json")]
    end = f"; did you mean {near[0]}?" if near else similar_path(path, similar)
    return f"no run at {path}: {reason or 'there is no such folder'}{end}"


def load_checkpoint(path: Path, *, keep: Callable[[str], bool] = _all) -> Checkpoint:
    """Reads a checkpoint onto the CPU.

    Its tensors are pages of the file: the system drops what is not in use.

    Args:
        path: The file.
        keep: Which tensors, by their names, are read and checked. None of the others may be missing.
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
            tensors = {name: file.get_tensor(name) for name in names if keep(name)}
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
    """The checksum of elements, shape and dtype."""
    kind = zlib.crc32(f"{tensor.dtype} {list(tensor.shape)}".encode())
    return zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy().data, kind)


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The optimiser's per-parameter state as tensors named ``INDEX.KEY`` (all of Adam's state is tensors)."""
    state = optimizer.state_dict()["state"]
    return {f"{index}.{key}": torch.as_tensor(value) for index, s in state.items() for key, value in s.items()}


def load_optimizer_tensors(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """The inverse of :func:`optimizer_tensors`; groups and learning rates stay the optimiser's own."""
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
            came = list(entries[key].shape) if key in entries else None
            if came != wanted:
                raise ValueError(f"optimizer.{number}.{key} must have shape {wanted}, got {came or 'nothing'}")
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
