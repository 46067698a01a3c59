"""Checkpoints: one safetensors file, written atomically, read without pickle.

The tensors are those of the routers with their diagrams, of the optimiser, of the sample reservoir and of the random
generators. Everything else (configuration, counters, stages) is JSON in the metadata of the file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from voronerf.files import write_bytes

FORMAT = "voronerf-checkpoint-1"


class CheckpointError(ValueError):
    """A checkpoint that cannot be read, or that belongs to another configuration; the message names the file."""


@dataclass(frozen=True)
class Checkpoint:
    """The contents of a checkpoint: tensors by name, and everything else as JSON values."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]

    def group(self, prefix: str) -> dict[str, Tensor]:
        """The tensors below ``prefix.``, without it."""
        return {name[len(prefix) + 1 :]: t for name, t in self.tensors.items() if name.startswith(prefix + ".")}


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Writes a checkpoint atomically.

    Raises:
        OSError: When it cannot be written; an older checkpoint at ``path`` is then untouched.
    """
    tensors = {name: t.detach().cpu().contiguous().clone() for name, t in checkpoint.tensors.items()}
    write_bytes(path, save(tensors, {"format": FORMAT, "values": json.dumps(checkpoint.values)}))


def load_checkpoint(path: Path) -> Checkpoint:
    """Reads a checkpoint onto the CPU.

    Raises:
        CheckpointError: When the file is missing, truncated or no checkpoint of this version.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: there is no checkpoint")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        if metadata.get("format") != FORMAT:
            raise CheckpointError(f"{path}: not a {FORMAT} file, its format is {metadata.get('format')!r}")
        return Checkpoint(tensors, json.loads(metadata["values"]))
    except (SafetensorError, json.JSONDecodeError, KeyError, OSError) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint: {error}") from None


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The optimiser's per-parameter state as tensors named ``INDEX.KEY`` (all of Adam's state is tensors)."""
    state = optimizer.state_dict()["state"]
    return {f"{index}.{key}": torch.as_tensor(value) for index, s in state.items() for key, value in s.items()}


def load_optimizer_tensors(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """The inverse of :func:`optimizer_tensors`; groups and learning rates stay the optimiser's own."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, key = name.split(".", 1)
        state.setdefault(int(index), {})[key] = tensor.clone()  # the optimiser updates its state in place
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
