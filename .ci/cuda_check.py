"""Compiles every .cu file without a GPU, with warnings as errors: ``cuda_check.py ARCHITECTURE ...``, such as 80 90.

It uses the rules of setup.py and the build folder, so a build for the same architectures reuses the objects. The last
architecture is compiled to PTX as well.

For every kernel it prints registers, spills, shared memory and the warps that fit a multiprocessor's registers, and
compares them with the table .ci/cuda_resources.json. More spilled bytes than in the table are a failure, and so is any
spill of a kernel that is not in the table. If nvcc has the version recorded in the table, more registers, more shared
memory and fewer warps are failures too. With this nvcc, sm_90 and the programs cuobjdump and nvdisasm, passes.py runs
the machine code of whole passes of networks. It is a failure if their results are wrong, or if a pass has over 1 % more
instructions than in the table. The check also fails if a kernel's resources are not reported for every architecture, or
if there is no kernel. Kernels of the toolkit (CUB) are only counted: their names change with the toolkit's version. In
the output, sm_80 is an A100, sm_89 an RTX 4090, sm_90 an H200.

``--update`` writes the named architectures to the table and removes kernels that no longer exist. The last line of the
output is one sentence: what was compiled, and whether it passed.
"""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
BUILD = runpy.run_path(str(ROOT / "setup.py"), run_name="voronerf_setup")
TOOLS = runpy.run_path(str(Path(__file__).with_name("machine_run.py")))["tools"]
OUT: Path = BUILD["build_folder"]()
TABLE = ROOT / ".ci" / "cuda_resources.json"
REGISTERS = 65536
"""The registers of a multiprocessor."""
MOST_WARPS = {"sm_75": 32, "sm_86": 48, "sm_89": 48, "sm_120": 48}
"""The maximum number of warps on a multiprocessor; 64 for other architectures."""
NETWORKS = "network/cuda/program_cuda.cu.o"
"""The object file with the kernels of networks."""
ALLOWED = 1.01
"""The instructions that a pass may have, relative to the table."""
FLAGS = "-Werror all-warnings -Xcompiler -Wall,-Wextra,-Werror -Xptxas -v"
OBJECT = re.compile(r"^\[\d+/\d+\] (?=\S+\.cu\.o$)", re.MULTILINE)
"""The line that ninja prints before the output of a compilation."""
KERNEL = re.compile(
    r"Compiling entry function '(?P<name>\w+)' for '(?P<arch>\w+)'.*?"
    r"(?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads.*?"
    r"Used (?P<registers>\d+) registers(?P<rest>[^\n]*)",
    re.DOTALL,
)


def main(architectures: list[str]) -> int:
    """Compiles, prints and compares; returns the exit status."""
    update = "--update" in architectures
    architectures = [architecture for architecture in architectures if architecture != "--update"]
    nvcc = shutil.which("nvcc") or shutil.which("nvcc", path="/usr/local/cuda/bin")
    if nvcc is None:
        print("cuda-check: nothing was compiled, because nvcc is neither on PATH nor in /usr/local/cuda/bin.")
        return 1
    cuda = BUILD["Cuda"]("", Path(nvcc), tuple(architectures))
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "cuda.ninja").write_text(BUILD["ninja_file"](Path("_C.so"), cuda, OUT))
    objects = [f"{path.relative_to(ROOT / 'csrc').as_posix()}.o" for path in sorted((ROOT / "csrc").rglob("*.cu"))]
    for name in objects:  # an up-to-date object prints nothing
        (OUT / name).unlink(missing_ok=True)
    command = [*BUILD["ninja"](), "-C", str(OUT), "-f", "cuda.ninja", "-k", "0", *objects]
    environment = {**os.environ, "NVCC_APPEND_FLAGS": FLAGS}
    said = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment).stdout
    results = dict(part.split("\n", 1) for part in OBJECT.split(said)[1:])
    failed = [name for name in objects if "\nFAILED: " in f"\n{results.get(name, 'FAILED: ')}"]
    kernels: Kernels = {}
    borrowed = set()
    for name, text in results.items():
        if name in failed:
            print(f"{name}:\n{text}")
        for match in KERNEL.finditer(text):
            if "3cub" in match["name"]:
                borrowed.add(match["name"])
                continue
            shared = re.search(r"(\d+) bytes smem", match["rest"])
            kernels.setdefault(f"{Path(name).stem}: {demangled(match['name'])}", {})[match["arch"]] = {
                "registers": int(match["registers"]),
                "spilled_bytes": int(match["stores"]) + int(match["loads"]),
                "shared_bytes": int(shared[1]) if shared else 0,
                "warps": warps(int(match["registers"]), match["arch"]),
            }
    version = nvcc_version(nvcc)
    passes: dict[str, int] = {}
    wrong = ""
    compiled_networks = "90" in architectures and NETWORKS not in failed and (OUT / NETWORKS).is_file()
    if TOOLS() is None:
        print("cuda-check: no passes were run: cuobjdump or nvdisasm is missing.")
    elif compiled_networks and (update or table()["nvcc"] == version):
        passes, wrong = passes_of(OUT / NETWORKS)
    for name, count in passes.items():
        print(f"{name} (sm_90): {count} instructions for 32 rows")
    for kernel, by_architecture in sorted(kernels.items()):
        columns = {key: [row[key] for row in by_architecture.values()] for key in COLUMNS}
        print(f"{kernel}: " + ", ".join(f"{key} {span(values)}" for key, values in columns.items()))
    spilling = sum(row["spilled_bytes"] > 0 for rows in kernels.values() for row in rows.values())
    targets = f"{', '.join(f'sm_{arch}' for arch in architectures)} and PTX of {architectures[-1]}"
    # Kernels of files that failed to compile are skipped, because the failure itself is reported.
    broken = {Path(name).stem for name in failed}
    compiled = {kernel: found for kernel, found in kernels.items() if kernel.split(":")[0] not in broken}
    lacking = [
        f"{kernel} (sm_{arch})"
        for kernel, found in sorted(compiled.items())
        for arch in architectures
        if f"sm_{arch}" not in found
    ]
    worse = [] if update else regressions(version, kernels, passes)
    for line in worse:
        print(line)
    if failed:
        outcome = f"failed in {', '.join(failed)}"
    elif lacking:
        outcome = f"failed: no resources were reported of {', '.join(lacking)}"
    elif not kernels:
        outcome = "failed: no kernel was reported"
    elif wrong:
        outcome = f"failed: {wrong}"
    elif worse:
        outcome = f"failed: {len(worse)} regressions against {TABLE.relative_to(ROOT)}, listed above"
    else:
        outcome = f"held without a warning, {spilling} spilling"
        if update:
            TABLE.write_text(as_text(version, *merged(version, kernels, passes)))
    toolkit = f" and {len(borrowed)} of the toolkit's" if borrowed else ""
    print(f"cuda-check: {len(objects)} files, {len(kernels)} kernels{toolkit} compiled for {targets} {outcome}.")
    return 1 if failed or lacking or wrong or worse or not kernels else 0


def passes_of(compiled: Path) -> tuple[dict[str, int], str]:
    """Returns the instructions of each pass that passes.py counts, or why there are none."""
    command = [sys.executable, str(Path(__file__).with_name("passes.py")), "--json", str(compiled)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode == 0:
        return json.loads(done.stdout), ""
    return {}, f"passes.py ended with {done.returncode}, {(done.stderr.strip() or 'silently').splitlines()[-1]}"


Kernels = dict[str, dict[str, dict[str, int]]]


def regressions(version: str, kernels: Kernels, passes: dict[str, int]) -> list[str]:
    """Returns a line for each value that is worse than in the table.

    A kernel or architecture that is not in the table gets a line only if it spills.
    """
    kept = table()
    same = kept["nvcc"] == version
    compared = ("spilled_bytes", *(("registers", "shared_bytes") if same else ()))
    worse = [
        f"{name}: {count} instructions, above {kept['passes'][name]}"
        for name, count in passes.items()
        if same and count > ALLOWED * kept["passes"].get(name, count)
    ]
    for kernel, by_architecture in sorted(kernels.items()):
        for architecture, row in by_architecture.items():
            known = unpack(kept["kernels"].get(kernel, {})).get(architecture, {"spilled_bytes": 0})
            for key in compared:
                if row[key] > known.get(key, row[key]):
                    worse.append(f"{kernel} ({architecture}): {key} {row[key]}, above {known[key]}")
            if "registers" in compared and row["warps"] < known.get("warps", 0):
                worse.append(f"{kernel} ({architecture}): warps {row['warps']}, below {known['warps']}")
    return worse


def merged(version: str, kernels: Kernels, passes: dict[str, int]) -> tuple[Kernels, dict[str, int]]:
    """Returns the table's kernels and passes with the new values.

    If the table records the same version of nvcc, the compiled kernels keep their rows of other architectures, and the
    passes are kept if none were run.
    """
    kept = table()
    if kept["nvcc"] != version:
        kept |= {"kernels": {}, "passes": {}}
    rows = {
        kernel: dict(sorted((unpack(kept["kernels"].get(kernel, {})) | found).items(), key=lambda row: number(row[0])))
        for kernel, found in kernels.items()
    }
    return rows, passes or kept["passes"]


def table() -> dict[str, Any]:
    """Returns the recorded table: the version of nvcc, kernels and passes."""
    empty = {"nvcc": "", "kernels": {}, "passes": {}}
    return empty | (json.loads(TABLE.read_text()) if TABLE.exists() else {})


def number(architecture: str) -> int:
    """Returns 90 for "sm_90"."""
    return int(architecture.removeprefix("sm_"))


COLUMNS = ("registers", "spilled_bytes", "shared_bytes", "warps")


def as_text(version: str, kernels: Kernels, passes: dict[str, int]) -> str:
    """Returns the table as JSON, one line for each kernel."""
    rows = {
        kernel: {architecture: [row[key] for key in COLUMNS] for architecture, row in by_architecture.items()}
        for kernel, by_architecture in sorted(kernels.items())
    }
    lines = ",\n".join(f"  {json.dumps(kernel)}: {json.dumps(row)}" for kernel, row in rows.items())
    counts = ",\n".join(f"  {json.dumps(name)}: {count}" for name, count in passes.items())
    head = f' "nvcc": "{version}",\n "passes": {{\n{counts}\n }},\n "columns": {json.dumps(COLUMNS)},\n'
    return f'{{\n{head} "kernels": {{\n{lines}\n }}\n}}\n'


def unpack(rows: dict[str, list[int]]) -> dict[str, dict[str, int]]:
    """Returns a kernel's values by architecture and column name, from its rows in the table."""
    return {architecture: dict(zip(COLUMNS, row)) for architecture, row in rows.items()}


def warps(registers: int, architecture: str) -> int:
    """Returns the number of warps whose registers fit a multiprocessor."""
    return min(MOST_WARPS.get(architecture, 64), REGISTERS // (32 * -(-max(registers, 1) // 8) * 8))


def nvcc_version(nvcc: str) -> str:
    """Returns nvcc's version, such as "V13.0.88"."""
    found = re.search(
        r"V[\d.]+", subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=True).stdout
    )
    return found[0] if found else ""


def demangled(name: str) -> str:
    """Returns a kernel's demangled name with template arguments, or `name` if c++filt is missing."""
    if shutil.which("c++filt") is None:
        return name
    full = subprocess.run(["c++filt", name], capture_output=True, text=True, check=True).stdout.strip()
    return full.replace("voronerf::", "").replace("(anonymous namespace)::", "")


def span(values: list[int]) -> str:
    """Returns the range of the numbers as text; for equal numbers, the number."""
    return str(values[0]) if min(values) == max(values) else f"{min(values)}-{max(values)}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
