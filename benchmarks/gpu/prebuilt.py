"""Prebuilds the extension: compiles its objects on one machine and links them on another, to save time there.

    prebuilt.py make FOLDER [ARCHITECTURE]    compiles all objects but bindings.cpp, the only file that needs Python
    prebuilt.py link FOLDER                   compiles bindings.cpp, links, and installs the module into the package
    prebuilt.py try FOLDER                    links, checks that the module loads, and removes its files

Both machines must run Linux on x86-64. The linking machine needs a C++ compiler, nvcc, ninja, Python's headers, and a C
library at least as new as the compiling machine's. Linking refuses objects of other sources or for another GPU.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import sysconfig
import time
import zlib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
OBJECT_OF_BINDINGS = "bindings.cpp.o"


def main(arguments: list[str]) -> int:
    """Parses the command line and runs make, link or try."""
    if len(arguments) not in (2, 3) or arguments[0] not in ("make", "link", "try"):
        print(__doc__)
        return 2
    build = runpy.run_path(str(ROOT / "setup.py"), run_name="voronerf_setup")
    folder = Path(arguments[1]).resolve()
    os.chdir(ROOT)
    begin = time.perf_counter()
    if arguments[0] == "make":
        done = make(build, folder, *arguments[2:])
    else:
        done = link(build, folder)
        if arguments[0] == "link":
            build["put"](folder / module_name(), ROOT / "voronerf/ops/_core" / module_name())
        else:
            for name in (OBJECT_OF_BINDINGS, module_name()):  # not part of the portable folder
                (folder / name).unlink()
    print(f"prebuilt: {done} in {time.perf_counter() - begin:.1f} s")
    return 0


def make(build: dict[str, Any], folder: Path, architecture: str = "90") -> str:
    """Compiles all objects but the bindings into a folder that another machine can link; returns a summary."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "made").unlink(missing_ok=True)  # marks the folder as incomplete
    text = prepare(build, folder, architecture)
    objects = [name for name in edges(text) if name.endswith(".o") and name != OBJECT_OF_BINDINGS]
    command = [*build["ninja"](), "-C", str(folder), "-j", os.environ.get("MAX_JOBS", "2"), *objects]
    subprocess.run(command, check=True)
    (folder / "made").write_text(f"{architecture} {digest()}")
    size = sum((folder / name).stat().st_size for name in objects)
    return f"{len(objects)} objects for sm_{architecture}, {size / 1e6:.1f} MB"


def link(build: dict[str, Any], folder: Path) -> str:
    """Links the objects with bindings.cpp for this Python."""
    if not (folder / "made").exists():
        raise SystemExit(f"prebuilt: FOLDER must hold what `prebuilt.py make` has left, got {folder}")
    architecture, sources = (folder / "made").read_text().split()
    if sources != digest():
        raise SystemExit("prebuilt: the objects must match csrc and setup.py, got objects of other sources")
    if (there := build["architectures_there"]()) and there != (architecture,):
        raise SystemExit(f"prebuilt: the objects must be for this GPU, sm_{there[0]}, got sm_{architecture}")
    text = prepare(build, folder, architecture)
    # Without build edges, ninja treats the existing objects as sources.
    kept = [OBJECT_OF_BINDINGS, module_name()]
    lines = text.splitlines()
    rules = lines[: next(i for i, line in enumerate(lines) if line.startswith("build "))]
    chosen = [line for name in kept for line in edges(text)[name]]
    (folder / "build.ninja").write_text("\n".join([*rules, *chosen, ""]))
    subprocess.run([*build["ninja"](), "-C", str(folder)], check=True)
    if not build["stub_of"](folder / module_name()):
        raise SystemExit("prebuilt: the linked module does not load")
    return f"{module_name()} linked, {(folder / module_name()).stat().st_size / 1e6:.1f} MB,"


def prepare(build: dict[str, Any], folder: Path, architecture: str) -> str:
    """Writes the files that setup.py generates for a build; returns the text of build.ninja."""
    os.environ.update(VORONERF_CUDA="1", VORONERF_CUDA_ARCHITECTURES=architecture)
    cuda = build["find_cuda"]()
    text = str(build["ninja_file"](Path(module_name()), cuda, folder))
    for name, said in (
        ("bindings.cpp", build["bindings"]()),
        ("build_info.h", build["build_info"](cuda)),
        ("build.ninja", text),
    ):
        build["write_if_changed"](folder / name, said)
    return text


def edges(text: str) -> dict[str, list[str]]:
    """Returns the lines of each edge of a build.ninja, by output."""
    edges_by_output: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.startswith("build "):
            last = edges_by_output[line.split()[1].rstrip(":")] = [line]
        elif edges_by_output and line.startswith("  "):
            last.append(line)
    return edges_by_output


def module_name() -> str:
    """Returns the file name of the extension for this Python."""
    return f"_C{sysconfig.get_config_var('EXT_SUFFIX')}"


def digest() -> str:
    """Returns a checksum of all sources of the objects."""
    paths = [*sorted(path for path in (ROOT / "csrc").rglob("*") if path.is_file()), ROOT / "setup.py"]
    checksum = 0
    for path in paths:
        checksum = zlib.crc32(path.relative_to(ROOT).as_posix().encode() + path.read_bytes(), checksum)
    return f"{checksum:08x}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
