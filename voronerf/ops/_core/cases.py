"""The case of an op: how to make valid arguments of it, and what it must refuse.

Each op has one, ``voronerf/ops/<op>/case.py``. From it come the rows of the tests of every op, the random calls of the
attack and of the sanitizers, what runs on the emulated and on a real GPU, and a row of the benchmark. n is the size of
a call: points, samples or rays.
"""

from __future__ import annotations

import importlib
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from voronerf.ops._core import backends

FLOATS = (torch.float32, torch.float32, torch.float64, torch.float16, torch.bfloat16)
"""For a free `Draw` to choose from."""
SIZES = (0, 1, 2, 3, 7, 8, 9, 15, 16, 17, 31, 33, 64, 100)
"""About those of vectors, tiles and blocks."""
Arguments = dict[str, Any]


class Draw:
    """Choices and numbers for the arguments of one call.

    Args:
        seed: of the numbers and choices.
        free: any option of each choice, and tensors with any strides; else the first option, and contiguous tensors.
        pinned: choices by name that are made already.
    """

    def __init__(self, seed: int = 0, *, free: bool = False, **pinned: Any) -> None:
        self.free, self._pinned = free, pinned
        self._random, self._generator = random.Random(seed), torch.Generator().manual_seed(seed)

    def among(self, name: str, *options: Any) -> Any:
        """The choice of a name: as pinned, any of the options, or the first."""
        if name in self._pinned:
            return self._pinned[name]
        return self._random.choice(options) if self.free else options[0]

    def number(self, name: str, usual: Any, low: int, high: int) -> int:
        """An integer, ``usual`` or from low to high."""
        return int(self.among(name, self._random.randint(low, high) if self.free else usual))

    def dtype(self, *options: torch.dtype) -> torch.dtype:
        """A floating-point type."""
        found: torch.dtype = self.among("dtype", *(options or FLOATS))
        return found

    def uniform(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Numbers from 0 to 1."""
        return self._viewed(torch.rand(shape, generator=self._generator, dtype=torch.float64).to(dtype))

    def normal(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Normally distributed numbers."""
        return self._viewed(torch.randn(shape, generator=self._generator, dtype=torch.float64).to(dtype))

    def integers(self, low: int, high: int, *shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        """Integers from low to high - 1."""
        return self._viewed(torch.randint(low, max(high, low + 1), shape, generator=self._generator, dtype=dtype))

    def unit(self, n: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Unit vectors [n, 3]."""
        return torch.nn.functional.normalize(self.normal(n, 3, dtype=torch.float64), dim=1).to(dtype)

    def points(self, n: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Positions [n, 3]: at random, on a lattice, where distances are equal, or far away."""
        kind = self.among("points", "random", "lattice", "far")
        found = self.normal(n, 3, dtype=torch.float64) if kind != "lattice" else self.integers(-2, 3, n, 3).double()
        return self._viewed((found * (1000.0 if kind == "far" else 1.0)).to(dtype))

    def offsets(self, n: int, k: int) -> Tensor:
        """int32 [k + 1]: rising, empty cells among them; of a free draw some rows may belong to no cell."""
        cuts = sorted(self._random.randint(0, n) for _ in range(k + 1))
        if not self.free or self._random.random() < 0.7:
            cuts[0], cuts[-1] = 0, n
        return torch.tensor(cuts, dtype=torch.int32)

    def _viewed(self, tensor: Tensor) -> Tensor:
        """The same values, of a free draw in another place of memory with other strides."""
        kind = self._random.randrange(6) if self.free and tensor.dim() else 5
        if kind == 0:
            wide = tensor.new_empty(*tensor.shape[:-1], 2 * tensor.shape[-1])
            wide[..., ::2] = tensor
            return wide[..., ::2]
        if kind == 1 and tensor.dim() > 1:
            return tensor.transpose(0, -1).contiguous().transpose(0, -1)
        if kind == 2:  # not where vectors are aligned
            shifted = tensor.new_empty(tensor.numel() + 1)
            shifted[1:] = tensor.reshape(-1)
            return shifted[1:].view(tensor.shape)
        return tensor


@dataclass(frozen=True)
class Case:
    """The case of an op.

    Attributes:
        make: draw and n -> arguments by name, all valid, without ``backend``.
        kinds: choices that are pinned for a test, by the name of the kind.
        refused: error -> the arguments that are changed for it. A TypeError if the error speaks of a type, a dtype or a
            kind of number, else a ValueError.
        alternatives: name -> the same result by other means, from the same arguments, for the benchmark.
        differentiable: whether the op has gradients.
        in_place: whether it writes into its arguments.
        comparable: whether all backends give the same tensors.
        call: the public function, if it has another name than the op.
        traced: whether torch can trace it, on every backend.
        on_devices: choices of further calls for kernels of devices.
        device_rows: n of a call under a sanitizer: more than a block, where each row has a thread and a call no more.
        hostile: what of the arguments may be senseless without an access outside of them: "indices", "numbers" for
            these and floating-point numbers, "" for nothing.
    """

    make: Callable[[Draw, int], Arguments]
    kinds: Mapping[str, Arguments] = field(default_factory=lambda: {"": {}})
    refused: Mapping[str, Arguments] = field(default_factory=dict)
    alternatives: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    differentiable: bool = False
    in_place: bool = False
    comparable: bool = True
    call: str = ""
    traced: bool = True
    on_devices: Sequence[Arguments] = ()
    device_rows: int = 40
    hostile: str = ""


def cases() -> dict[str, Case]:
    """Of every op, by its name. A folder with several ops has ``CASES`` by their names."""
    found = {}
    for op in backends.ops():
        module = importlib.import_module(f"voronerf.ops.{backends.folder(op)}.case")
        found[op] = getattr(module, "CASES", {}).get(op) or module.CASE
    return found
