"""Counts the machine instructions of a network layer, without a GPU.

A layer is found as the shortest loop through the block with the most multiply instructions.

``layers(object, "90")`` reads an object file with cuobjdump, from the toolkit or the package nvidia-cuda-cuobjdump.
"""

from __future__ import annotations

import heapq
import re
import shutil
import subprocess
import sysconfig
from collections import Counter
from pathlib import Path

PRODUCTS = {"HMMA": 32, "FFMA": 128}
"""The multiply instructions (HMMA for matrices, FFMA for floats), each with the minimum number in a layer's block."""
LINE = re.compile(r"^\s+/\*([0-9a-f]{4,})\*/\s+(.*?);")
BRANCH = re.compile(r"^(?P<when>@!?U?P\d+ )?(?P<what>[A-Z][A-Z0-9]*)(?P<kind>\S*)(?P<rest>.*)$")

Code = list[tuple[int, str]]
"""The addresses and instructions of a kernel."""


def tools() -> str | None:
    """Returns a PATH that contains cuobjdump and nvdisasm; None if one of them is missing."""
    folders = [str(folder) for folder in Path(sysconfig.get_path("purelib")).glob("nvidia/*/bin")]
    path = ":".join([*folders, *filter(None, [str(Path(found).parent) if (found := shutil.which("nvcc")) else None])])
    path = f"{path}:/usr/local/cuda/bin:/usr/local/bin:/usr/bin:/bin"
    return path if all(shutil.which(name, path=path) for name in ("cuobjdump", "nvdisasm")) else None


def layers(compiled: Path, architecture: str, path: str) -> dict[str, Counter[str]]:
    """Returns, by mangled kernel name, the number of instructions of each kind in one layer of the kernel.

    Kernels without enough multiply instructions are left out. ``path`` is the PATH that `tools` returns.
    """
    command = [shutil.which("cuobjdump", path=path) or "cuobjdump", "-arch", f"sm_{architecture}", "-sass", compiled]
    said = subprocess.run(command, capture_output=True, text=True, check=True, env={"PATH": path}).stdout
    kernels = dict[str, Code]()
    for line in said.splitlines():
        if "Function : " in line:
            code = kernels.setdefault(line.split("Function : ")[1].strip(), [])
        elif match := LINE.match(line):
            code.append((int(match[1], 16), match[2]))
    return {name: found for name, code in kernels.items() if (found := layer(code))}


def layer(code: Code) -> Counter[str]:
    """Counts, by kind, the instructions of the shortest cycle through the block with the most multiply instructions.

    In a chain of layers this cycle is one layer and the code between layers. A basic block that loops to itself counts
    once. The result is empty if no block has enough multiply instructions.
    """
    blocks, ways = _blocks(code)
    kinds = [Counter(kind(text) for _, text in block) for block in blocks]
    product = next((name for name in PRODUCTS if any(count[name] for count in kinds)), "FFMA")
    products = [count[product] for count in kinds]
    if max(products, default=0) < PRODUCTS[product]:
        return Counter()
    start = products.index(max(products))
    best, queue = dict[int, int](), [(0, start, (start,))]
    while queue:
        length, at, way = heapq.heappop(queue)
        if at == start and length:
            return sum((kinds[block] for block in way[:-1]), Counter())
        if best.get(at, length + 1) <= length:
            continue
        best[at] = length
        for after in ways[at]:
            if after != at:
                heapq.heappush(queue, (length + len(blocks[after]), after, (*way, after)))
    return kinds[start]


def kind(instruction: str) -> str:
    """Returns an instruction's kind, such as "LDG" for "@P0 LDG.E.128.CONSTANT R4, desc[UR4][R2.64]"."""
    match = BRANCH.match(instruction)
    return match["what"] if match else instruction


def _blocks(code: Code) -> tuple[list[Code], list[set[int]]]:
    """Returns the basic blocks, and for each block the indices of the blocks that may follow it."""
    places = {address: place for place, (address, _) in enumerate(code)}
    jumps = dict[int, tuple[int | None, bool]]()  # index -> (target, whether the next instruction may follow)
    for place, (_, text) in enumerate(code):
        match = BRANCH.match(text)
        what = match["what"] if match else ""
        if match and what in ("BRA", "EXIT", "RET", "BRX", "JMP"):
            to = re.search(r"0x[0-9a-f]+\s*$", match["rest"]) if what in ("BRA", "JMP") else None
            sometimes = bool(match["when"]) or match["kind"].startswith(".DIV") or " P" in match["rest"].split("0x")[0]
            jumps[place] = places.get(int(to[0], 16)) if to else None, sometimes
    starts = {0, *(to for to, _ in jumps.values() if to is not None), *(place + 1 for place in jumps)}
    firsts = sorted(start for start in starts if start < len(code))
    numbers = {first: number for number, first in enumerate(firsts)}
    ends = [*firsts[1:], len(code)]
    ways = []
    for end in ends:
        to, sometimes = jumps.get(end - 1, (None, True))
        after = {numbers[to]} if to is not None else set()
        ways.append(after | ({numbers[end]} if sometimes and end in numbers else set()))
    return [code[first:end] for first, end in zip(firsts, ends)], ways
