"""Runs one planted bug: ``planted.py MODULE BUG SEED``. The last line printed is "right", "wrong" or the error."""

from __future__ import annotations

import array
import importlib.util
import sys

path, bug, seed = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
spec = importlib.util.spec_from_file_location("voronerf_emulation", path)
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)

blocks, threads = 2, 64
values = array.array("f", [float((7 * i) % 13) for i in range(blocks * threads)])
out = array.array("f", [-1.0] * (blocks * threads))
counter = array.array("i", [0])
module.seed(seed)
try:
    module.planted(*(part.buffer_info()[0] for part in (values, out, counter)), blocks, threads, bug)
except RuntimeError as error:
    print(error)
else:
    sums = [3 * sum(values[block * threads : (block + 1) * threads]) for block in range(blocks)]
    print("right" if list(out) == [sums[i // threads] for i in range(blocks * threads)] else "wrong")
