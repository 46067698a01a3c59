"""The test cases of the ops: a case makes valid arguments of an op, and lists arguments that the op must refuse.

``<op>.py`` of this folder defines ``CASE``, or a dict ``CASES`` for a folder of several ops. The cases parametrise the
tests of every op, the random calls of ``make attack`` (tests/attack), the runs under sanitizers, on the emulated and on
a real GPU, and the benchmark. n is the number of points, samples or rays of a call.
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
"""The dtypes that a free `Draw` chooses from."""
SIZES = (0, 1, 2, 3, 7, 8, 9, 15, 16, 17, 31, 33, 64, 100)
"""Sizes close to the widths of vectors, tiles and blocks."""
Arguments = dict[str, Any]


class Draw:
    """A source of choices and numbers for the arguments of one call.

    Args:
        seed: the seed of the numbers and choices.
        free: whether options and strides are random; otherwise the first option is always chosen, and tensors are
            contiguous.
        pinned: fixed choices, by name.
    """

    def __init__(self, seed: int = 0, *, free: bool = False, **pinned: Any) -> None:
        self.free, self._pinned = free, pinned
        self._random, self._generator = random.Random(seed), torch.Generator().manual_seed(seed)

    def among(self, name: str, *options: Any) -> Any:
        """Returns the pinned choice of this name; else a random option if the draw is free, or the first option."""
        if name in self._pinned:
            return self._pinned[name]
        return self._random.choice(options) if self.free else options[0]

    def number(self, name: str, usual: Any, low: int, high: int) -> int:
        """Returns an integer: a random one from low to high if the draw is free, else ``usual``."""
        return int(self.among(name, self._random.randint(low, high) if self.free else usual))

    def dtype(self, *options: torch.dtype) -> torch.dtype:
        """Draws a floating-point dtype."""
        dtype: torch.dtype = self.among("dtype", *(options or FLOATS))
        return dtype

    def uniform(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Draws uniform numbers from 0 to 1."""
        return self._viewed(torch.rand(shape, generator=self._generator, dtype=torch.float64).to(dtype))

    def normal(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Draws normally distributed numbers."""
        return self._viewed(torch.randn(shape, generator=self._generator, dtype=torch.float64).to(dtype))

    def integers(self, low: int, high: int, *shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        """Draws integers from low to high - 1."""
        return self._viewed(torch.randint(low, max(high, low + 1), shape, generator=self._generator, dtype=dtype))

    def unit(self, n: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Draws unit vectors [n, 3]."""
        return torch.nn.functional.normalize(self.normal(n, 3, dtype=torch.float64), dim=1).to(dtype)

    def points(self, n: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Draws positions [n, 3]: random, on a lattice (with equal distances), or far from the origin."""
        kind = self.among("points", "random", "lattice", "far")
        positions = self.normal(n, 3, dtype=torch.float64) if kind != "lattice" else self.integers(-2, 3, n, 3).double()
        return self._viewed((positions * (1000.0 if kind == "far" else 1.0)).to(dtype))

    def offsets(self, n: int, k: int) -> Tensor:
        """Draws ascending offsets, int32 [k + 1]; cells may be empty. In free mode some rows may have no cell."""
        cuts = sorted(self._random.randint(0, n) for _ in range(k + 1))
        if not self.free or self._random.random() < 0.7:
            cuts[0], cuts[-1] = 0, n
        return torch.tensor(cuts, dtype=torch.int32)

    def _viewed(self, tensor: Tensor) -> Tensor:
        """Returns the same values; a free draw may change strides and alignment."""
        kind = self._random.randrange(6) if self.free and tensor.dim() else 5
        if kind == 0:
            wide = tensor.new_empty(*tensor.shape[:-1], 2 * tensor.shape[-1])
            wide[..., ::2] = tensor
            return wide[..., ::2]
        if kind == 1 and tensor.dim() > 1:
            return tensor.transpose(0, -1).contiguous().transpose(0, -1)
        if kind == 2:  # an unaligned address
            shifted = tensor.new_empty(tensor.numel() + 1)
            shifted[1:] = tensor.reshape(-1)
            return shifted[1:].view(tensor.shape)
        return tensor


@dataclass(frozen=True)
class Case:
    """The test case of an op.

    Attributes:
        make: (draw, n) -> valid arguments by name, without ``backend``.
        kinds: name of a kind of call -> the choices that its tests pin.
        refused: error message -> the changed arguments that raise it: a TypeError if the message is about a type, a
            dtype or a kind of number, else a ValueError.
        alternatives: name -> a function that computes the same result from the same arguments, for the benchmark.
        differentiable: whether the op has gradients.
        in_place: whether the op writes into its arguments.
        comparable: whether all backends return the same tensors.
        call: the name of the public function, if it is not the op's name.
        traced: whether torch can trace the op on every backend.
        on_devices: the pinned choices of additional calls on GPUs.
        device_rows: n of a call under a sanitizer; more than a block has threads if a kernel has a thread for each row.
        hostile: the arguments that may have invalid values without an access out of bounds: "indices"; "numbers" for
            indices and floating-point numbers; "" for none. A sanitizer runs the kernels on such values.
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


CASES: dict[str, Case] = {}
"""The case of every op, by name."""
for _op in backends.ops():
    _module = importlib.import_module(f"cases.{backends.folder(_op)}")
    CASES[_op] = getattr(_module, "CASES", {}).get(_op) or _module.CASE
