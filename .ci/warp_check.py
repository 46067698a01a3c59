"""Compiles every Warp kernel to GPU machine code, without a GPU: ``warp_check.py [ARCHITECTURE ...] [--half]``.

Warp contains a compiler, so this needs neither nvcc nor a driver. For each kernel it prints the registers of a thread,
its stack (spilled values) and the shared memory of a block, the maximum over the architectures. Kernels for 16-bit
weights (``--half``) take about a minute each, because they contain products for tensor cores.
"""

from __future__ import annotations

import importlib
import json
import struct
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import torch
import warp as wp

import voronerf.ops  # noqa: F401  # declares the ops of the kernels
from voronerf import kernels
from voronerf.kernels.network import THREADS
from voronerf.kernels.network import kernels as of_networks

ARCHITECTURES = (75, 80, 86, 89, 90, 100, 120)
REGISTERS, FRAME = 0x2F, 0x11  # attributes of a kernel in the section .nv.info of a cubin


def resources(cubin: bytes) -> dict[str, tuple[int, int]]:
    """Returns the registers and the stack bytes of a thread, for each forward kernel of a cubin (64-bit ELF)."""
    start, count, names_at = *struct.unpack_from("<Q", cubin, 0x28), *struct.unpack_from("<HH", cubin, 0x3C)
    rows = [struct.unpack_from("<IIQQQQIIQQ", cubin, start + 64 * i) for i in range(count)]
    text = lambda table, at: cubin[(begin := rows[table][4] + at) : cubin.index(b"\0", begin)].decode()  # noqa: E731
    sections = {text(names_at, row[0]): row for row in rows}
    symbols, info = sections[".symtab"], sections[".nv.info"]
    found: dict[str, dict[int, int]] = {}
    at, end = info[4], info[4] + info[5]
    while at < end:
        form, attribute, size = struct.unpack_from("<BBH", cubin, at)
        if form == 4 and attribute in (REGISTERS, FRAME):
            symbol, value = struct.unpack_from("<II", cubin, at + 4)
            name = text(symbols[6], struct.unpack_from("<I", cubin, symbols[4] + 24 * symbol)[0])
            found.setdefault(name, {})[attribute] = value
        at += 4 + (size if form == 4 else 0)
    return {name: (part.get(REGISTERS, 0), part.get(FRAME, 0)) for name, part in found.items() if "forward" in name}


def main(arguments: list[str]) -> int:
    """Compiles for the named architectures, or all of them, and prints the table."""
    half = "--half" in arguments
    chosen = [int(argument) for argument in arguments if argument != "--half"] or list(ARCHITECTURES)
    files = Path(kernels.__path__[0]).glob("[a-z]*.py")
    modules = [] if half else [wp.get_module(f"voronerf.kernels.{file.stem}") for file in files if imported(file.stem)]
    for dtype in (torch.float16, torch.bfloat16) if half else (torch.float32,):
        modules += [kernel.module for kernel in of_networks(dtype)]
    found: dict[str, list[int]] = {}
    seconds: Counter[int] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for module in modules:
            module.options["block_dim"] = THREADS if "kernels__locals" in module.name else 256
            for architecture in chosen:
                start = time.perf_counter()
                (cubin,) = wp.compile_aot_module(module, arch=architecture, module_dir=folder, use_ptx=False)
                seconds[architecture] += round(time.perf_counter() - start, 1)
                shared = json.loads(next(Path(folder).glob(f"{cubin.name.split('.sm')[0]}*.meta")).read_text())
                for name, (registers, stack) in resources(cubin.read_bytes()).items():
                    short = "_".join(part for part in name.split("_")[:-4] if part not in ("", "kernels", "locals"))
                    file = module.name.rpartition("kernels.")[2] if "voronerf" in module.name else "grouped_program"
                    row = found.setdefault(f"{file}: {short.removesuffix('_kernel')}", [0, 0, 0])
                    row[:] = map(max, row, (registers, stack, shared.get(f"{name}_smem_bytes", 0)))
    print("| kernel | registers | stack | shared memory of a block |\n|---|---|---|---|")
    for name, row in sorted(found.items()):
        print(f"| {name} | {row[0]} | {row[1]} | {row[2]} |")
    print("seconds to compile:", ", ".join(f"sm_{name}: {taken:.0f}" for name, taken in seconds.items()))
    return 0


def imported(name: str) -> bool:
    """Imports a kernel file and returns whether it has kernels."""
    importlib.import_module(f"voronerf.kernels.{name}")
    return bool(wp.get_module(f"voronerf.kernels.{name}").kernels)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
