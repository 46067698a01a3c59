"""Runs every kernel on a few blocks under a sanitizer: ``sanitize.py MODULE CALLS [hostile]``.

CALLS is a pickle of recorded.py with calls of the ops' cases. They run without torch, whose import takes minutes under
a sanitizer. Their results must equal the recorded results.

``hostile`` replaces indices and numbers by invalid ones that the host cannot refuse without reading them: decreasing or
out-of-range offsets, invalid trees and cells. Kernels must not access memory outside the tensors; results are
undefined.
"""

import pickle
import sys

import numpy as np
from emulation_build import load

RANDOM = np.random.default_rng(0)
DTYPES = {name: name for name in ("float16", "bfloat16", "float32", "float64", "int32", "int64", "uint8", "bool")}
LEAST, MOST = -(2**31), 2**31 - 1


class Memory:
    """An array with the tensor interface that the module reads."""

    def __init__(self, array):
        self.array, self.dtype = array.copy(), DTYPES.get(array.dtype.name)

    @property
    def shape(self):
        return list(self.array.shape)

    def stride(self):
        return [step // self.array.itemsize for step in self.array.strides]

    def contiguous(self):
        return self

    def is_contiguous(self):
        return True

    def is_neg(self):
        return False

    def data_ptr(self):
        return self.array.ctypes.data


def argument(module, value, memory):
    """Restores an argument from recorded.py's data."""
    if isinstance(value, list):
        return [argument(module, part, memory) for part in value]
    if not isinstance(value, tuple):
        return value
    if value[0] == "array":
        tensor = memory[value[1]]
        tensor.dtype = DTYPES.get(value[2], tensor.dtype)
        return tensor
    if value[0] == "tuple":
        return tuple(argument(module, part, memory) for part in value[1])
    return getattr(module, value[1])(*(argument(module, part, memory) for part in value[3]))


def harm(numbers, before, after):
    """Writes hostile indices, and NaN or other hostile floats if ``numbers``, into arrays that a function only reads.

    ``before`` and ``after`` hold the arrays before and after the recorded call; ``before`` is changed.
    """
    for number, (array, changed) in enumerate(zip(before, after)):
        if array.tobytes() != changed.tobytes():
            continue
        if array.dtype in (np.int32, np.int64):
            values = [LEAST, -5, -1, 0, 1, 4, 5, array.size, array.size + 1, 65_536, MOST]
            before[number] = RANDOM.choice(values, array.shape).astype(array.dtype)
        elif numbers and array.dtype.kind == "f" and array.size > 1:
            before[number] = array.copy()
            before[number].ravel()[::5], before[number].ravel()[1::7] = np.nan, RANDOM.choice([np.inf, -1, 1e38])


def same(found, expected):
    """Returns whether values equal the recorded values; sums may differ by rounding, as their order is not fixed."""
    if found.dtype.kind != "f" or not found.size:
        return found.dtype.itemsize < 4 or np.array_equal(found, expected)
    size = max(np.abs(np.nan_to_num(expected, posinf=0, neginf=0)).max(), 1e-6)
    return np.allclose(found, expected, rtol=1e-3, atol=1e-4 * size, equal_nan=True)


def main(path, calls, kind="usual"):
    module = load(path)
    module.register_torch(DTYPES, (), None)
    with open(calls, "rb") as file:
        every = pickle.load(file)
    for shared, hostile, recorded_calls in every * (3 if kind == "hostile" else 1):
        if kind == "hostile" and not hostile:
            continue
        module.device(90, 120, shared)
        for name, arguments, before, after in recorded_calls:
            before = list(before)
            if kind == "hostile":
                harm(hostile == "numbers", before, after)
            memory = [Memory(array) for array in before]
            getattr(module, name)(*(argument(module, value, memory) for value in arguments))
            if kind != "hostile":
                wrong = [number for number, part in enumerate(memory) if not same(part.array, after[number])]
                assert not wrong, (name, wrong)
            elif name == "cell_sort":
                cells, order, offsets = (part.array for part in memory[:3])
                assert (np.sort(order) == np.arange(len(cells))).all() and (np.diff(offsets) >= 0).all()
    print("clean")


if __name__ == "__main__":
    main(*sys.argv[1:])
