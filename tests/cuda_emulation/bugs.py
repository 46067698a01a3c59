"""Planted bugs, without torch: ``bugs.py MODULE BUG SEED``, a bug of planted.cu by its number.

The last line printed is the verdict. Under a sanitizer a bug needs a process of its own.
"""

import sys

import numpy as np
from emulation_build import load


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
        return "right" if planted(module, int(bug), seed) < 1e-6 else "wrong"
    except RuntimeError as fault:
        return str(fault)


if __name__ == "__main__":
    print(verdict(load(sys.argv[1]), sys.argv[2], int(sys.argv[3])))
