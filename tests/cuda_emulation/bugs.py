"""Planted bugs, without torch: ``bugs.py MODULE BUG SEED``, a bug of group_product.cu or, named pN, of planted.cu.

The last line printed is the verdict. Under a sanitizer a bug needs a process of its own.
"""

import sys

import numpy as np
from emulation_build import load


def rounded(values, bfloat16):
    """Values of 16 bits: the bits, and what they stand for."""
    if bfloat16:
        wide = values.astype(np.float32).view(np.uint32) & np.uint32(0xFFFF0000)
        return (wide >> 16).astype(np.uint16), wide.view(np.float32).astype(np.float64)
    halves = values.astype(np.float16)
    return halves.view(np.uint16), halves.astype(np.float64)


def pack(bits, leading, stride, step_bytes, size):
    """b [n, k] in core matrices, written element by element from what the PTX manual says of the two offsets."""
    packed = np.full(size // 2, 0x7FC0, np.uint16)
    for n, k in np.ndindex(bits.shape):
        step, column = divmod(k, 16)
        at = step * step_bytes + n // 8 * stride + column // 8 * leading + n % 8 * 16 + column % 8 * 2
        packed[at // 2] = bits[n, k]
    return packed


def group_error(module, *, tiles, bfloat16, steps=3, groups=1, threads=0, order="k", bug=0, seed=0):
    """The largest error against float64 of a product of groups of four warps, of what it adds up.

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
    with np.errstate(invalid="ignore"):  # what is no number is no small error either
        return float(np.nan_to_num(np.abs(out - (before + left @ right.T)) / added, nan=np.inf).max())


def planted(module, bug, seed):
    """The largest error of three times the sum of a block, in each of its threads."""
    blocks, threads = 2, 64
    values = ((7 * np.arange(blocks * threads)) % 13).astype(np.float32)
    out, counter = np.full_like(values, -1), np.zeros(1, np.int32)
    module.seed(seed)
    module.planted(*(array.ctypes.data for array in (values, out, counter)), blocks, threads, bug)
    sums = 3 * values.reshape(blocks, threads).sum(axis=1)
    return float(np.nan_to_num(np.abs(out - sums.repeat(threads)), nan=np.inf).max())


def verdict(module, bug, seed):
    """ "right", "wrong" or the error."""
    try:
        if bug.startswith("p"):
            error = planted(module, int(bug[1:]), seed)
        else:
            error = group_error(module, tiles=4, bfloat16=True, bug=int(bug), seed=seed)
        return "right" if error < 1e-6 else "wrong"
    except RuntimeError as fault:
        return str(fault)


if __name__ == "__main__":
    print(verdict(load(sys.argv[1]), sys.argv[2], int(sys.argv[3])))
