"""Products of a group of four warps (group_product.cu), without torch: ``group_cases.py MODULE BUG SEED``.

The last line printed is "right", "wrong" or the error.
"""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import numpy as np


def rounded(values: np.ndarray, bfloat16: bool) -> tuple[np.ndarray, np.ndarray]:
    """Values of 16 bits: the bits, and what they stand for."""
    if bfloat16:
        wide = values.astype(np.float32).view(np.uint32) & np.uint32(0xFFFF0000)
        return (wide >> 16).astype(np.uint16), wide.view(np.float32).astype(np.float64)
    halves = values.astype(np.float16)
    return halves.view(np.uint16), halves.astype(np.float64)


def pack(bits: np.ndarray, leading: int, stride: int, step_bytes: int, size: int) -> np.ndarray:
    """b [n, k] in core matrices, written element by element from what the PTX manual says of the two offsets."""
    packed = np.full(size // 2, 0x7FC0, np.uint16)
    for n, k in np.ndindex(bits.shape):
        step, column = divmod(k, 16)
        at = step * step_bytes + n // 8 * stride + column // 8 * leading + n % 8 * 16 + column % 8 * 2
        packed[at // 2] = bits[n, k]
    return packed


def errors(
    module: ModuleType,
    *,
    tiles: int,
    bfloat16: bool,
    steps: int = 3,
    groups: int = 1,
    threads: int = 0,
    order: str = "k",
    bug: int = 0,
    seed: int = 0,
) -> float:
    """The largest error of a product against float64, of what it adds up.

    ``order``: whether core matrices lie side by side along k or along n.
    """
    random = np.random.default_rng(seed)
    rows, n, k = 64 * groups, 8 * tiles, 16 * steps
    a, left = rounded(random.standard_normal((rows, k)), bfloat16)
    b, right = rounded(random.standard_normal((n, k)), bfloat16)
    before = random.standard_normal((rows, n)).astype(np.float32)
    leading, stride = (128, 256) if order == "k" else (128 * tiles, 128)
    step_bytes = 256 * tiles
    packed, out = pack(b, leading, stride, step_bytes, steps * step_bytes), before.copy()
    sizes = [packed.nbytes, steps, step_bytes, leading, stride]
    module.seed(seed)
    addresses = (array.ctypes.data for array in (a, packed, out))
    module.group_product(*addresses, sizes, threads or 128 * groups, tiles, bfloat16, bug)
    added = np.abs(left) @ np.abs(right).T + np.abs(before)
    # What is no number is no small error either.
    return float(np.nan_to_num(np.abs(out - (before + left @ right.T)) / added, nan=np.inf).max())


def main(path: str, bug: int, seed: int) -> None:
    """One bug, in a module that may be under a sanitizer."""
    spec = importlib.util.spec_from_file_location("voronerf_emulation", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    try:
        print("right" if errors(module, tiles=4, bfloat16=True, bug=bug, seed=seed) < 1e-6 else "wrong")
    except RuntimeError as error:
        print(error)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
