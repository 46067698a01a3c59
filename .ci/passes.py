"""Counts the machine instructions of whole passes of five networks, without a GPU: ``passes.py COMPILED``.

COMPILED is program_cuda.cu, compiled for sm_90 to an object file or a cubin. The emulation of tests/cuda_emulation runs
the project's kernels, and machine_run.py runs the machine code of the same launches. Both must write the same results.

A count is the number of instructions that warps issue for 32 rows of bfloat16 products. The pass "gradients" is the
program that computes the forward pass again, and the gradients of all parameters. Each task has two tiles, and the
count includes their share of the start of the task. The kernels that pack weights and add up partial sums do not count.

``--profile NETWORK`` prints the instructions of each step of a network's programs, ``--listing`` the count of each
instruction, ``--json`` only the counts. The project is imported from PYTHONPATH, else from this checkout.
"""

from __future__ import annotations

import argparse
import json
import struct
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path += [str(ROOT), str(ROOT / "tests" / "cuda_emulation"), str(ROOT / "benchmarks"), str(Path(__file__).parent)]

from emulated import emulated  # noqa: E402
from machine_run import PROCESS, Kernel, Launch, read_kernel, tools  # noqa: E402
from ops.networks import NETS, parameters  # noqa: E402

from voronerf import MLP, HashGridField, grouped_mlp  # noqa: E402

KERNELS = {rows: f"program_kernel.*HalfNumbersILb1EEELi{rows // 16}ELi1ELb1E" for rows in (16, 32)}
"""The names of the kernels with bfloat16 products, by the rows of a warp."""
CELLS, CELL_ROWS = 2, 256
N = 16384
"""The number of rows of a call. Most are in no cell: only for large calls does the plan give a task several tiles."""
STATES = 512
"""The bytes of a block's shared memory before its values, kProgramStates."""
ALLOWED = 3e-3
"""The largest relative difference (Frobenius norm) from the emulation. Orders of summation differ by 7e-4."""
CUDA_STEP = 80
"""The bytes of a CudaStep."""
OPERATIONS = ("plain", "input", "output", "linear", "chain", "waves", "outer", "columns", "end")
"""The names of CudaOp."""
NETWORKS = {
    **{name: NETS[name] for name in ("w64d4", "mlp32", "nerf64")},
    "hashgrid": HashGridField().layers,
    "integrated": MLP(NETS["w64d4"].layers, (4,), position_octaves=10, position_encoding="integrated"),
}


@dataclass(frozen=True)
class Pass:
    """The instructions of a pass, all for 32 rows.

    Attributes:
        count: Their number.
        steps: The number of each step of the program, in order, and of the rest.
        listing: The number, address and text of each instruction of the kernel.
        rows: The rows of a warp.
        written: The count of numbers that the machine code wrote in global memory.
        error: The largest relative difference from the results of the emulation.
    """

    count: float
    steps: list[tuple[str, float]]
    listing: list[tuple[float, int, str]]
    rows: int
    written: int
    error: float


def measure(kernels: dict[int, Kernel], name: str) -> dict[str, Pass]:
    """Returns the passes "forward" and "gradients" of a network.

    Raises:
        RuntimeError: The machine code's results differ from the emulation's, or the plan is not as expected.
        NotImplementedError: An instruction is unknown.
    """
    net, random = NETWORKS[name], torch.Generator().manual_seed(6)
    positions = torch.rand(N, 6 if net.integrated else 3, generator=random)
    positions[:, 3:] *= 1e-3  # variances
    offsets = torch.arange(CELLS + 1, dtype=torch.int32) * CELL_ROWS
    weights, biases = parameters(net, CELLS, positions.shape[1], torch.bfloat16, torch.device("cpu"))
    options: dict[str, Any] = {"layers": net, "backend": "native"}
    if net.uses_directions:
        directions = torch.randn(N // 64, 3, generator=random)
        options["directions"] = torch.nn.functional.normalize(directions, dim=1)
        options["direction_index"] = torch.arange(N, dtype=torch.int32) // 64
    leaves = [*weights, *biases]
    if net.grid is not None:
        options["features"] = torch.randn(net.grid.table_shape, generator=random)
        leaves.append(options["features"])
    for leaf in leaves:
        leaf.requires_grad_()
    gradient = torch.randn(N, net.out_features, generator=random).bfloat16()
    found: list[Pass] = []

    def launched(kernel: str, grid: int, threads: int, shared: int, arguments: bytes) -> None:
        if kernel == "kernel":  # of the function `launch` in program_cuda.cu
            found.append(_run(kernels, grid, threads, shared, arguments))

    with emulated() as module:
        module.watch(launched)
        try:
            out = grouped_mlp(positions, offsets, weights, biases, **options)
            gradients = torch.autograd.grad(out, leaves, gradient)
        finally:
            module.watch(None)
    # The forward pass keeps look-ups in the table. Few of the table's gradients are not 0.
    columns = net.out_features + (net.grid.out_features if net.grid else 0)
    expected = [columns * CELLS * CELL_ROWS, sum(entries.numel() for entries in gradients[: 2 * len(weights)])]
    expected[1] += sum(int(entries.count_nonzero()) for entries in gradients[2 * len(weights) :])
    if len(found) != 2 or any(one.written < least for one, least in zip(found, expected)):
        raise RuntimeError(f"{name}: {[one.written for one in found]} numbers were written, not {expected}")
    return dict(zip(("forward", "gradients"), found))


def _run(kernels: dict[int, Kernel], grid: int, threads: int, shared: int, arguments: bytes) -> Pass:
    """Runs the machine code of a launch of program_kernel that the emulation has just run."""
    columns, steps = struct.unpack_from("<i20xQ", arguments, 48)  # of CudaProgram
    height = (shared - STATES) // (4 * columns)
    rows = height * 32 // threads
    if rows not in kernels or CELL_ROWS % height:
        raise RuntimeError(f"a warp has {rows} rows, a tile {height}")
    names = [_step_name(steps)]
    while not names[-1].startswith("end"):
        names.append(_step_name(steps + CUDA_STEP * len(names)))
    records = range(steps, steps + CUDA_STEP * len(names), CUDA_STEP)
    launch = Launch(kernels[rows], grid, threads, shared, arguments, records, STATES)
    for block in range(CELLS):  # each cell is one task
        launch.run(block)
    share = 32 / (CELLS * CELL_ROWS)
    by_step = [(name, share * launch.steps[i]) for i, name in enumerate(names)]
    by_step.append(("rest", share * launch.steps[-1]))
    listing = [(share * count, 16 * i, text) for i, (count, text) in enumerate(zip(launch.counts, launch.kernel.texts))]
    error, written = _compared(launch)
    if not error <= ALLOWED:
        raise RuntimeError(f"the machine code's results differ from the emulation's by {error:.1e}")
    return Pass(share * sum(launch.counts), by_step, listing, rows, written, error)


def _step_name(record: int) -> str:
    """Returns the operation of a CudaStep, and its depth and width or the columns of its operands x and y."""
    words = PROCESS.numbers[4][(record - PROCESS.base) // 4 :][:20].tolist()
    operation = OPERATIONS[words[17]]
    depth, width = (words[3], words[11]) if operation == "outer" else (words[6], words[7])
    return f"{operation} {depth}x{width}"


def _compared(launch: Launch) -> tuple[float, int]:
    """Returns the machine code's largest relative difference from the emulation, and the count of results."""
    pairs = []
    for width in (2, 4):
        places = np.array([*launch.stored[width]], np.int64)
        stored = np.array([*launch.stored[width].values()], np.uint32), PROCESS.numbers[width][places // width]
        pairs.append([(bits.astype(np.uint32) << 32 - 8 * width).view(np.float32) for bits in stored])
    if launch.added:
        at, values = (np.concatenate(parts) for parts in zip(*launch.added))
        places, inverse = np.unique(at, return_inverse=True)
        pairs.append([np.bincount(inverse, values), PROCESS.numbers[4][places // 4].view(np.float32)])
    errors = [float(np.linalg.norm(found - known) / np.linalg.norm(known)) for found, known in pairs if len(found)]
    return float(np.max(errors)), sum(len(found) for found, _ in pairs)


def main() -> None:
    """Prints the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("compiled", type=Path)
    parser.add_argument("--profile", choices=NETWORKS)
    parser.add_argument("--listing", action="store_true")
    parser.add_argument("--json", action="store_true")
    chosen, path = parser.parse_args(), tools()
    if path is None:
        parser.error("cuobjdump or nvdisasm is missing")
    kernels = {rows: read_kernel(chosen.compiled, pattern, path) for rows, pattern in KERNELS.items()}
    passes = {
        f"{name} {direction}": found
        for name in ([chosen.profile] if chosen.profile else NETWORKS)
        for direction, found in measure(kernels, name).items()
    }
    if chosen.json:
        print(json.dumps({name: round(found.count) for name, found in passes.items()}))
        return
    for name, found in passes.items():
        print(f"{name}: {found.count:.0f} (warps of {found.rows} rows, difference {found.error:.1e})")
        if chosen.profile:
            for number, (step, count) in enumerate(found.steps):
                print(f"  {number:3} {step:16} {count:8.1f}")
            kinds = Counter[str]()
            for count, _, text in found.listing:
                kinds[text.split()[text[0] == "@"].split(".")[0]] += count
            print("  " + ", ".join(f"{count:.0f} {kind}" for kind, count in kinds.most_common(24)))
        for count, address, text in found.listing if chosen.listing else ():
            if count:
                print(f"  {count:8.2f}  {address:05x}  {text}")


if __name__ == "__main__":
    main()
