"""Builds the emulated CUDA module: ``emulation_build.py [none|address|thread]`` prints its path.

g++ compiles the .cu files of csrc/ with emulation.h in place of CUDA; ninja recompiles only changed files. Each
sanitizer has its own module. The scheduler (emulation.cpp) is compiled without sanitizers, so that they see only the
kernels.
"""

import fcntl
import functools
import importlib.util
import platform
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
HERE = Path(__file__).resolve().parent
SANITIZERS = {
    "none": [],
    # Sanitizer checks in function calls compile twice as fast as inline checks.
    "address": ["-fsanitize=address", "--param", "asan-instrumentation-with-call-threshold=0"],
    "thread": ["-fsanitize=thread"],
}
PYTHON = {"module.cpp", "index_maps.cpp"}
"""Files of Python bindings, which are compiled together with the bindings of csrc/."""
PLAIN = {"emulation.cpp", "emulated_products.cpp", "python.cpp"}
"""Files that are compiled without sanitizers."""
FAST = {"emulation.cpp", "emulated_products.cpp"}
"""Files that are optimised: a launch spends most of its time in the scheduler and the products."""
SHARED = ("cell_sort_plan.cpp", "centre_index.cpp")
"""C++ files of csrc/ that the launchers need."""
REPLACED = {"radix_sort.cu"}
"""Files that need the CUDA toolkit's headers; this folder has a .cpp file in place of each."""


@functools.cache
def build(sanitizer="none"):
    """Builds the module if it is out of date; returns its path."""
    out = ROOT / "build" / "cuda-emulation" / f"{platform.machine()}-{sys.implementation.cache_tag}"
    (out / sanitizer).mkdir(parents=True, exist_ok=True)
    with (out / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # test processes share the folder
        return _build(out, sanitizer)


def _build(out, sanitizer):
    import pybind11

    module = out / sanitizer / f"voronerf_emulation{sysconfig.get_config_var('EXT_SUFFIX')}"
    kernels = [source for source in sorted((ROOT / "csrc").rglob("*.cu")) if source.name not in REPLACED]
    sources = [*kernels, *sorted(HERE.glob("*.cu"))]
    sources += [path for path in sorted(HERE.glob("*.cpp")) if path.name not in PYTHON]
    sources += [path for path in sorted((ROOT / "csrc").rglob("*.cpp")) if path.name in SHARED]
    sources.append(_for_python(out / "bindings" / "python.cpp"))
    includes = [ROOT / "csrc", HERE, Path(pybind11.get_include()), Path(sysconfig.get_path("include"))]
    flags = ["-std=c++17", "-Og", "-g1", "-fPIC", "-ffp-contract=off", "-fno-fast-math", "-fvisibility=hidden"]
    flags += ["-Wall", "-Wextra", "-Werror", "-Wno-unknown-pragmas", "-DVN_EMULATE", "-DVN_WITH_CUDA"]
    flags += [f"-I{path}" for path in includes[:2]] + [f"-isystem{path}" for path in includes[2:]]
    watched = SANITIZERS[sanitizer]
    lines = [
        "rule cxx",
        f"  command = g++ {shlex.join(flags)} $flags -MMD -MF $out.d -c -x c++ $in -o $out",
        "  depfile = $out.d",
        "  deps = gcc",
        "rule header",
        f"  command = g++ {shlex.join(flags)} $flags -MMD -MF $out.d -x c++-header $in -o $out",
        "  depfile = $out.d",
        "  deps = gcc",
        "rule link",
        f"  command = g++ -shared $in {shlex.join(watched)} -o $out",
    ]
    # The headers of all kernels are precompiled, which halves the compile time of small files.
    header = f"{sanitizer}/kernels.h"
    _write(out / header, '#include "emulation.h"\n')
    lines += [f"build {header}.gch: header {header}", f"  flags = {shlex.join(watched)}"]
    objects = []
    for source in sources:
        plain, kernels = source.name in PLAIN, source.suffix == ".cu"
        objects.append(f"{'plain' if plain else sanitizer}/{source.parent.name}/{source.name}.o")
        lines.append(f"build {objects[-1]}: cxx {source}{f' | {header}.gch' if kernels else ''}")
        own = [*([] if plain else watched), *(["-include", header] if kernels else [])]
        own += ["-O2"] if source.name in FAST else []
        lines.append(f"  flags = {shlex.join(own)}")
    lines += [f"build {sanitizer}/{module.name}: link {' '.join(objects)}", ""]
    (out / f"{sanitizer}.ninja").write_text("\n".join(lines))
    command = [sys.executable, "-m", "ninja", "-C", str(out), "-f", f"{sanitizer}.ninja", f"{sanitizer}/{module.name}"]
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode != 0:
        raise RuntimeError(f"the emulated module does not compile:\n{result.stdout}{result.stderr}")
    return module


def _for_python(path):
    """Writes one file that includes all bindings, since pybind11's headers take most of the compile time."""
    bindings = ROOT / "csrc" / "bindings"
    files = [file for file in sorted(bindings.glob("*.cpp")) if "VN_CUDA(" in file.read_text()]
    files += [
        bindings / name
        for name in (
            "bind.cpp",
            "program_call.cpp",
            "signature.cpp",
            "tensor_view.cpp",
            "unchanged.cpp",
        )
    ]
    files += [HERE / name for name in sorted(PYTHON)]
    text = "".join(f'#include "{file}"\n' for file in files)
    _write(path, text)
    return path


def _write(path, text):
    if not path.exists() or path.read_text() != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def load(path):
    """Loads the module at a path without torch, whose import takes minutes under a sanitizer."""
    spec = importlib.util.spec_from_file_location("voronerf_emulation", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    print(build(*sys.argv[1:]))
