"""Build of the compiled module ``voronerf.ops._core._C``; everything else is in pyproject.toml.

The extension does not depend on torch: it needs C++17, pybind11 and, if nvcc is found, CUDA. The build writes and runs
a build.ninja, so it is parallel and rebuilds only files whose sources or headers have changed. Files named
``*_isa.cpp`` are compiled once per instruction set (csrc/common/isa.h), and one is chosen at run time.

Environment:
    CXX, CXXFLAGS                the C++ compiler and its flags (default c++, or else g++; clang++ on Windows, because
                                 MSVC cannot compile GNU's vectors); "ccache g++" works too
    VORONERF_OPENMP              0: build without OpenMP; operations then run on one thread, as they always do on macOS
                                 and Windows. Set 0 for clang on Linux, whose OpenMP runtime differs from torch's
    VORONERF_CUDA                auto (default): build with CUDA for this machine's GPU, if nvcc and a GPU are found;
                                 1: for all GPUs, even without a GPU, and fail without nvcc; 0: without CUDA
    VORONERF_CUDA_ARCHITECTURES  such as "80;90": machine code for each, and PTX of the last one for later GPUs
    CUDA_HOME, MAX_JOBS          the folder of the CUDA toolkit; the number of parallel jobs
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import zlib
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
SOURCES = ROOT / "csrc"
ISAS = {
    "x86_64": {
        "avx2": ["-DVN_ISA=1", "-mavx2", "-mfma"],
        "avx512": ["-DVN_ISA=2", "-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl", "-mfma"],
    },
    "aarch64": {"neon": ["-DVN_ISA=3"]},
}
"""The compiler flags of each instruction set, by architecture; the portable code is built too."""
WINDOWS = sys.platform == "win32"
LAUNCHERS = ("ccache", "sccache", "distcc", "icecc")
# One architecture of each major version, whose code also runs on later minor versions. Without 100 and 120 a Blackwell
# GPU would compile the PTX of 90 for minutes on first use of a kernel.
DEFAULT_ARCHITECTURES = "75;80;90;100;120"


class NinjaBuildExt(build_ext):
    """A build command that writes and runs build.ninja, and copies the module to the path that setuptools expects."""

    def build_extension(self, ext: Extension) -> None:
        """Builds the only extension."""
        build = build_folder()
        build.mkdir(parents=True, exist_ok=True)
        cuda = find_cuda()
        write_if_changed(build / "bindings.cpp", bindings())
        write_if_changed(build / "build_info.h", build_info(cuda))
        module = build / Path(self.get_ext_filename(ext.name)).name
        write_if_changed(build / "build.ninja", ninja_file(module, cuda))
        command = [*ninja(), "-C", str(build)]
        if jobs := os.environ.get("MAX_JOBS") or (str(self.parallel) if self.parallel else ""):
            command += ["-j", jobs]
        subprocess.run(command, check=True)
        put(module, Path(self.get_ext_fullpath(ext.name)))
        print(f"voronerf: {cuda.outcome}")


def put(module: Path, target: Path) -> None:
    """Copies the module to its import path, and writes the stub of its bindings."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(module, target)
    if stub := stub_of(module):
        for folder in (ROOT / "voronerf/ops/_core", target.parent):
            write_if_changed(folder / "_C.pyi", stub)
            write_if_changed(folder / "interface.txt", f"{zlib.crc32(stub.encode())}\n")


def build_folder() -> Path:
    """Returns the folder of the object files."""
    return ROOT / "build" / f"{sysconfig.get_platform()}-{sys.implementation.cache_tag}"


class Cuda:
    """The CUDA set-up: nvcc and the architectures, if CUDA is used, and a line that says what was found."""

    def __init__(self, outcome: str, nvcc: Path | None = None, architectures: tuple[str, ...] = ()) -> None:
        self.outcome, self.nvcc, self.architectures = outcome, nvcc, architectures

    def flags(self) -> list[str]:
        """Returns nvcc's flags for the architectures."""
        flags = [f"-gencode=arch=compute_{arch},code=sm_{arch}" for arch in self.architectures]
        last = self.architectures[-1]
        return [*flags, f"-gencode=arch=compute_{last},code=compute_{last}"]


def find_cuda() -> Cuda:
    """Returns the CUDA set-up that VORONERF_CUDA and VORONERF_CUDA_ARCHITECTURES ask for."""
    wish = os.environ.get("VORONERF_CUDA", "auto")
    if wish not in ("auto", "0", "1"):
        raise SystemExit(f"voronerf: VORONERF_CUDA must be auto, 0 or 1, got {wish!r}")
    if wish == "0":
        return Cuda("built without CUDA: VORONERF_CUDA=0")
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    places = [*([home + "/bin"] if home else []), *os.environ.get("PATH", "").split(os.pathsep), "/usr/local/cuda/bin"]
    found = shutil.which("nvcc", path=os.pathsep.join(places))
    if found is None:
        if wish == "1":
            raise SystemExit("voronerf: VORONERF_CUDA=1 but no nvcc; install the CUDA toolkit or set CUDA_HOME")
        return Cuda("built without CUDA: no nvcc on PATH, in CUDA_HOME or in /usr/local/cuda")
    there = architectures_there()
    if wish == "auto" and there is None:
        return Cuda("built without CUDA: no GPU here; VORONERF_CUDA=1 compiles it, which takes some twenty minutes")
    wanted = os.environ.get("VORONERF_CUDA_ARCHITECTURES")
    if wanted:
        architectures = tuple(wanted.replace(",", ";").split(";"))
    else:
        known = subprocess.run([found, "--list-gpu-code"], check=True, capture_output=True, text=True).stdout.split()
        choices = (there if wish == "auto" and there else (), DEFAULT_ARCHITECTURES.split(";"))
        known_of = [tuple(arch for arch in choice if f"sm_{arch}" in known) for choice in choices]
        architectures = known_of[0] or known_of[1]
    return Cuda(f"built with CUDA for {';'.join(architectures)} by {found}", Path(found), architectures)


def architectures_there() -> tuple[str, ...] | None:
    """Returns the architectures of this machine's GPUs; () if the driver does not report them, None without a GPU."""
    try:
        command = ["nvidia-smi", "--query-gpu=compute_cap", "--format=csv,noheader"]
        said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout.split()
    except (OSError, subprocess.SubprocessError):
        said = []
    found = tuple(sorted({cap.replace(".", "") for cap in said if cap.replace(".", "").isdigit()}, key=int))
    return found if found or any(Path(device).exists() for device in ("/dev/nvidiactl", "/dev/dxg")) else None


def compiler() -> list[str]:
    """Returns the command of the C++ compiler: an optional launcher, the program, and arguments."""
    default = "clang++" if WINDOWS else shutil.which("c++") or "g++"
    return shlex.split(os.environ.get("CXX", "")) or [default]


def check_compiler() -> None:
    """Exits with advice on what to install if there is no C++ compiler."""
    for program in compiler()[: 2 if Path(compiler()[0]).name in LAUNCHERS else 1]:
        if shutil.which(program) is None:
            raise SystemExit(
                f"voronerf: a C++17 compiler (g++ or clang++) is needed, but {program} was not found: install the "
                "package g++ (Debian, Ubuntu), gcc-c++ (Fedora), gcc (Arch), cxx-compiler (conda-forge), LLVM "
                "(Windows) or, on macOS, xcode-select --install; set CXX to use another compiler"
            )


def host_compiler() -> list[str]:
    """Returns nvcc's flags for the C++ compiler: the program without a launcher, -Xcompiler before each argument."""
    words = compiler()
    program, *arguments = words[1:] if Path(words[0]).name in LAUNCHERS and len(words) > 1 else words
    return ["-ccbin", program, *(part for argument in arguments for part in ("-Xcompiler", argument))]


def openmp() -> bool:
    """Returns whether the extension uses OpenMP, so that operations run on torch's threads."""
    return sys.platform.startswith("linux") and os.environ.get("VORONERF_OPENMP") != "0"


def ninja() -> list[str]:
    """Returns the command of ninja: from the Python package, or else from PATH."""
    try:
        import ninja as package

        return [str(Path(package.BIN_DIR) / "ninja")]
    except ImportError:
        return ["ninja"]


def isas() -> dict[str, list[str]]:
    """Returns the instruction sets of the compiler's architecture and their flags."""
    target = subprocess.run([*compiler(), "-dumpmachine"], check=True, capture_output=True, text=True).stdout
    architecture = target.split("-")[0].replace("arm64", "aarch64")
    # The portable code runs on processors without the other instruction sets; -O2 compiles faster.
    return {"portable": ["-DVN_ISA=0", "-O2"], **ISAS.get(architecture, {})}


def build_info(cuda: Cuda) -> str:
    """Returns the text of a header that records the build."""
    version = subprocess.run([*compiler(), "--version"], check=True, capture_output=True, text=True).stdout
    if "clang" in version and openmp():
        raise SystemExit(
            f"voronerf: on Linux the extension uses torch's OpenMP runtime (GCC's) and must be built with GCC: set "
            f"CXX=g++, or VORONERF_OPENMP=0 for one thread (got {version.splitlines()[0]})"
        )
    values = {
        "VN_COMPILER": f'"{version.splitlines()[0]}"',
        "VN_OPENMP": str(int(openmp())),
        "VN_CUDA_BUILT": str(int(cuda.nvcc is not None)),
        "VN_CUDA_OUTCOME": f'"{cuda.outcome}"',
        "VN_CUDA_ARCHITECTURES": f'"{";".join(cuda.architectures)}"',
        "VN_CUDA_MAJOR": str(0 if cuda.nvcc is None else toolkit_major(cuda.nvcc)),
    }
    return "#pragma once\n" + "".join(f"#define {name} {value}\n" for name, value in values.items())


def toolkit_major(nvcc: Path) -> int:
    """Returns the major version of the CUDA toolkit, such as 13."""
    said = subprocess.run([nvcc, "--version"], check=True, capture_output=True, text=True).stdout
    found = re.search(r"release (\d+)", said)
    if found is None:
        raise SystemExit(f"voronerf: {nvcc} --version names no release")
    return int(found[1])


def bindings() -> str:
    """Returns the text of a file that includes all files of csrc/bindings, so that their headers compile only once."""
    files = sorted((SOURCES / "bindings").glob("*.cpp"))
    return "".join(f'#include "bindings/{file.name}"\n' for file in files)


def ninja_file(module: Path, cuda: Cuda, folder: Path | None = None) -> str:
    """Returns the text of build.ninja, whose commands run in the build folder or in `folder`.

    Paths are relative to the working folder, so that a copy of the tree with its objects needs no rebuild.
    """
    sources = Path(os.path.relpath(SOURCES, folder or build_folder()))
    common = ["-std=c++17", "-O3", *([] if WINDOWS else ["-fPIC"]), "-fvisibility=hidden", "-Wall", "-Wextra", "-I."]
    # Without OpenMP its pragmas are ignored, and the thread counts in these pragmas are unused parameters.
    threads = ["-fopenmp"] if openmp() else ["-Wno-unknown-pragmas", "-Wno-unused-parameter"]
    includes = [f"-I{sources.as_posix()}", f"-isystem{pybind11_headers()}", f"-isystem{sysconfig.get_path('include')}"]
    # These flags come after CXXFLAGS, to override it. For reproducible results, the compiler must round every
    # operation separately (csrc/geometry/nearest_centre_math.h), use fused operations only where the code calls
    # them, and keep IEEE NaN and infinity. A square root that may set errno is a function call, which prevents
    # vectorisation.
    extra = [*shlex.split(os.environ.get("CXXFLAGS", "")), "-fno-fast-math", "-ffp-contract=off", "-fno-math-errno"]
    # The module is not linked with libgomp: voronerf/ops/_core/native/__init__.py binds it to torch's copy.
    if cuda.nvcc is not None:
        # nvcc knows the path of its static runtime, with which the module loads on a machine without CUDA.
        linker = [str(cuda.nvcc), "-shared", "-cudart=static", *host_compiler(), "-Xlinker", "--exclude-libs,ALL"]
    elif sys.platform == "darwin":
        linker = [*compiler(), "-bundle", "-undefined", "dynamic_lookup"]
    elif WINDOWS:  # pyconfig.h names Python's library, and compiler-rt detects the processor's features
        linker = [*compiler(), "-shared", f"-L{Path(sys.base_prefix) / 'libs'}", *compiler_rt()]
    else:
        linker = [*compiler(), "-shared", "-Wl,--exclude-libs,ALL"]
    lines = [
        "rule cxx",
        f"  command = {join(compiler() + common + threads + includes + extra)} $flags -MMD -MF $out.d -c $in -o $out",
        "  depfile = $out.d",
        "  deps = gcc",
        "  description = $out",
        "rule link",
        f"  command = {join(linker)} $in -o $out",
        "  description = $out",
    ]
    if cuda.nvcc is not None:
        host = join(["-Xcompiler", "-fPIC,-fvisibility=hidden,-ffp-contract=off", *host_compiler()])
        flags = join(["-std=c++17", "-O3", "-cudart=static", *cuda.flags(), f"-I{sources.as_posix()}", "-I."])
        lines += [
            "rule nvcc",
            f"  command = {join([str(cuda.nvcc)])} {flags} {host} -MMD -MF $out.d -c $in -o $out",
            "  depfile = $out.d",
            "  deps = gcc",
            "  description = $out",
        ]
    objects = ["bindings.cpp.o"]
    # The bindings have no loops to optimise, so -O1 is enough.
    flags_of_bindings = join(["-O1", *(["-DVN_WITH_CUDA"] if cuda.nvcc is not None else [])])
    lines += ["build bindings.cpp.o: cxx bindings.cpp", f"  flags = {flags_of_bindings}"]
    for source in sorted(SOURCES.rglob("*.c*")):
        if source.parent.name == "bindings":
            continue
        name = source.relative_to(SOURCES).as_posix()  # files of different folders may have the same name
        path = quote((sources / name).as_posix())
        if source.name.endswith("_isa.cpp"):
            for isa, flags_of_isa in isas().items():
                objects.append(f"{name}.{isa}.o")
                # The portable code of tile registers is an emulation for tests; -O1 halves its compile time.
                emulation = ["-O1"] if isa == "portable" and source.name == "program_tiles_isa.cpp" else []
                lines += [f"build {objects[-1]}: cxx {path}", f"  flags = {join(flags_of_isa + emulation)}"]
        elif source.suffix == ".cpp":
            objects.append(f"{name}.o")
            lines.append(f"build {objects[-1]}: cxx {path}")
        elif source.suffix == ".cu" and cuda.nvcc is not None:
            objects.append(f"{name}.o")
            lines.append(f"build {objects[-1]}: nvcc {path}")
    lines.append(f"build {quote(module.name)}: link {' '.join(objects)}")
    return "\n".join([*lines, f"default {quote(module.name)}", ""])


def compiler_rt() -> list[str]:
    """Returns Clang's runtime library, which Clang omits if it links like MSVC."""
    asked = [*compiler(), "--rtlib=compiler-rt", "-print-libgcc-file-name"]
    found = Path(subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip())
    return [str(found)] if found.is_file() else []


def pybind11_headers() -> str:
    """Returns the include folder of pybind11, or of torch, which contains the headers too (for offline builds)."""
    try:
        import pybind11
    except ImportError:
        import importlib.util

        torch = importlib.util.find_spec("torch")
        if torch is None or torch.origin is None:
            raise SystemExit("voronerf: pybind11 is missing; pip install pybind11") from None
        return str(Path(torch.origin).parent / "include")
    return str(pybind11.get_include())


def stub_of(module: Path) -> str:
    """Returns the stub of a module, or "" (keep the existing files) if the module does not run on this machine.

    A new process imports the module; on Linux, it loads libgomp for the module instead of torch's OpenMP runtime.
    """
    code = f"""
import ctypes, importlib.util, sys
if sys.platform.startswith("linux"):
    ctypes.CDLL("libgomp.so.1", mode=ctypes.RTLD_GLOBAL)
spec = importlib.util.spec_from_file_location("_C", {str(module)!r})
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
print(module.stub, end="")
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if found.returncode != 0:
        print(f"voronerf: _C.pyi and interface.txt in voronerf/ops/_core were not updated: {found.stderr.strip()}")
    return found.stdout


def quote(path: str) -> str:
    """Quotes a path for build.ninja."""
    return path.replace("$", "$$").replace(":", "$:").replace(" ", "$ ")


def join(flags: list[str]) -> str:
    """Joins flags to a command in build.ninja."""
    return (subprocess.list2cmdline(flags) if WINDOWS else shlex.join(flags)).replace("$", "$$")


def write_if_changed(path: Path, text: str) -> None:
    """Writes a file only if its text has changed, to keep its modification time otherwise."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


if __name__ == "__main__":
    if {"bdist_wheel", "editable_wheel", "build", "build_ext"}.intersection(sys.argv):  # before setuptools' long log
        check_compiler()
    setup(
        packages=[*find_packages(include=["voronerf", "voronerf.*"]), "voronerf.kernels"],
        package_dir={"voronerf": "voronerf", "voronerf.kernels": "kernels"},
        package_data={
            "voronerf.ops._core": ["_C.pyi", "interface.txt"],
            "voronerf.app.web": ["*.html", "*.css", "*.js", "*.wgsl"],
            "voronerf": ["py.typed"],
        },
        ext_modules=[Extension("voronerf.ops._core._C", sources=[])],
        cmdclass={"build_ext": NinjaBuildExt},
    )
