"""Runs a kernel with a planted bug, without torch: ``bugs.py MODULE BUG SEED``; BUG is a number in planted.cu.

The last printed line is the verdict. Under a sanitizer each bug needs a separate process.
"""

import sys

import numpy as np
from emulation_build import load


def planted(module, bug, seed):
    """Runs the kernel, which computes three times the sum of each block; returns its largest error."""
    blocks, threads = 2, 64
    values = ((7 * np.arange(blocks * threads)) % 13).astype(np.float32)
    out, counter = np.full_like(values, -1), np.zeros(1, np.int32)
    module.seed(seed)
    module.planted(*(array.ctypes.data for array in (values, out, counter)), blocks, threads, bug)
    sums = 3 * values.reshape(blocks, threads).sum(axis=1)
    return float(np.nan_to_num(np.abs(out - sums.repeat(threads)), nan=np.inf).max())


def verdict(module, bug, seed):
    """Returns "right", "wrong" or the error."""
    try:
        return "right" if planted(module, int(bug), seed) < 1e-6 else "wrong"
    except RuntimeError as fault:
        return str(fault)


if __name__ == "__main__":
    print(verdict(load(sys.argv[1]), sys.argv[2], int(sys.argv[3])))
