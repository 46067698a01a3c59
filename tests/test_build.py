"""Tests of the build scripts: the commands of build.ninja, compilers behind a launcher (ccache), and the CUDA check."""

import importlib.metadata
import importlib.util
import os
import re
import runpy
import struct
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def build(monkeypatch):
    """The globals of setup.py, which runs with a stub of `setup`."""
    if not (ROOT / "setup.py").is_file():
        pytest.skip("setup.py is missing: the tests need the source tree")
    pytest.importorskip("pybind11")
    setuptools = pytest.importorskip("setuptools")
    monkeypatch.setattr(setuptools, "setup", lambda **_: None)
    monkeypatch.delenv("CXXFLAGS", raising=False)
    return runpy.run_path(str(ROOT / "setup.py"), run_name="voronerf_setup")


def commands(build, cuda):
    """Returns the command of every build.ninja rule; the compiler need not exist."""
    build["ninja_file"].__globals__["isas"] = lambda: {"portable": ["-DVN_ISA=0"]}
    lines = build["ninja_file"](Path("_C.so"), cuda).splitlines()
    rules = [line.removeprefix("rule ") for line in lines if line.startswith("rule ")]
    texts = [line.removeprefix("  command = ") for line in lines if line.startswith("  command = ")]
    return dict(zip(rules, texts, strict=True))


def test_a_launcher_before_the_compiler(build, monkeypatch):
    monkeypatch.setenv("CXX", "ccache g++")
    rules = commands(build, build["Cuda"]("built without CUDA"))
    assert rules["cxx"].startswith("ccache g++ -std=c++17 ")
    assert rules["link"].startswith("ccache g++ -")


def test_nvcc_gets_one_program_and_the_arguments(build, monkeypatch):
    cuda = build["Cuda"]("built with CUDA", Path("/cuda/bin/nvcc"), ("80",))
    monkeypatch.setenv("CXX", "/usr/bin/ccache 'the compilers/g++' -m64")
    rules = commands(build, cuda)
    assert rules["cxx"].startswith("/usr/bin/ccache 'the compilers/g++' -m64 -std=c++17 ")
    for rule in ("link", "nvcc"):
        assert rules[rule].startswith("/cuda/bin/nvcc ")
        assert " -ccbin 'the compilers/g++' -Xcompiler -m64 " in rules[rule]
        assert "ccache" not in rules[rule]


def test_files_of_one_name_in_two_rooms_make_two_objects(build):
    lines = build["ninja_file"](Path("_C.so"), build["Cuda"]("built without CUDA")).splitlines()
    objects = [line.split(":")[0] for line in lines if line.startswith("build ")]
    assert "build geometry/cell_sort.cpp.o" in objects and len(objects) == len(set(objects))


@pytest.mark.parametrize("given", ["", "-Ofast -march=native", "-ffast-math -ffp-contract=fast"])
def test_arithmetic_is_exact_whatever_flags_are_given(build, monkeypatch, given):
    monkeypatch.setenv("CXXFLAGS", given)
    command = commands(build, build["Cuda"]("built without CUDA"))["cxx"]
    assert f"{given} -fno-fast-math -ffp-contract=off -fno-math-errno $flags " in command


def test_every_module_lies_in_a_package():
    """Every folder has an ``__init__.py``; without this file a folder works in a checkout but is missing in wheels."""
    setuptools = pytest.importorskip("setuptools")
    modules = {path.parent.relative_to(ROOT).as_posix() for path in (ROOT / "voronerf").rglob("*.py")}
    packages = setuptools.find_packages(str(ROOT), include=["voronerf", "voronerf.*"])
    assert modules == {name.replace(".", "/") for name in packages} and "voronerf/app/train" in modules


def test_clang_on_linux_is_refused_before_it_builds(build, monkeypatch):
    """clang is refused on Linux: it needs symbols that torch's OpenMP library, which is GCC's, lacks."""
    answer = SimpleNamespace(stdout="Ubuntu clang version 18.1.3\nTarget: x86_64")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: answer)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("VORONERF_OPENMP", raising=False)
    wanted = r"set CXX=g\+\+, or VORONERF_OPENMP=0 for one thread \(got Ubuntu clang version 18.1.3\)"
    with pytest.raises(SystemExit, match=wanted):
        build["build_info"](build["Cuda"]("none"))
    with monkeypatch.context() as context:
        context.setenv("VORONERF_OPENMP", "0")
        assert "VN_OPENMP 0" in build["build_info"](build["Cuda"]("none"))
        assert " -fopenmp " not in commands(build, build["Cuda"]("none"))["cxx"]
    monkeypatch.setattr(sys, "platform", "darwin")
    assert "clang version 18.1.3" in build["build_info"](build["Cuda"]("none"))


def test_windows_builds_with_clang(build, monkeypatch):
    """The build commands for Windows use clang; they are not tested on Windows."""
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setitem(build["ninja_file"].__globals__, "WINDOWS", True)
    monkeypatch.setitem(build["ninja_file"].__globals__, "compiler_rt", lambda: [r"C:\Program Files\LLVM\rt.lib"])
    rules = commands(build, build["Cuda"]("built without CUDA"))
    assert rules["cxx"].startswith("clang++ -std=c++17 ") and "-fPIC" not in rules["cxx"]
    assert rules["link"].startswith("clang++ -shared ") and '"C:\\Program Files\\LLVM\\rt.lib"' in rules["link"]


def test_nvcc_is_found_where_cuda_home_has_none(build, monkeypatch, tmp_path):
    nvcc, home_nvcc = tmp_path / "path" / "nvcc", tmp_path / "home" / "bin" / "nvcc"
    for path in (nvcc, home_nvcc):
        path.parent.mkdir(parents=True)
    settings = {"VORONERF_CUDA": "1", "VORONERF_CUDA_ARCHITECTURES": "80", "PATH": str(nvcc.parent)}
    for name, value in (settings | {"CUDA_HOME": str(tmp_path / "home")}).items():
        monkeypatch.setenv(name, value)
    for path in (nvcc, home_nvcc):
        program(path)
        assert build["find_cuda"]().nvcc == path


def test_cuda_is_compiled_for_the_gpu_that_is_there(build, monkeypatch, tmp_path):
    program(tmp_path / "nvcc", "echo sm_75; echo sm_80; echo sm_89; echo sm_90")
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    for name in ("VORONERF_CUDA_ARCHITECTURES", "CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    supported = ("75", "80", "90")
    for said, auto in (("exit 1", None), ("echo 8.9; echo 8.0; echo 8.9", ("80", "89")), ("echo 13.0", supported)):
        program(tmp_path / "nvidia-smi", said)
        if auto is None and any(Path(device).exists() for device in ("/dev/nvidiactl", "/dev/dxg")):
            continue  # this machine has a GPU whose driver does not answer
        for wish, architectures in (("auto", auto), ("1", supported)):
            monkeypatch.setenv("VORONERF_CUDA", wish)
            cuda = build["find_cuda"]()
            assert cuda.architectures == (architectures or ())
            assert (cuda.nvcc is None) == (architectures is None)
            assert architectures is not None or "no GPU here; VORONERF_CUDA=1 compiles it" in cuda.outcome


def test_without_a_compiler_a_line_says_what_to_install(build, monkeypatch, tmp_path):
    program(tmp_path / "ccache")
    monkeypatch.setenv("PATH", str(tmp_path))
    wanted = (
        r"a C\+\+17 compiler \(g\+\+ or clang\+\+\) is needed, but nocompiler was not found: install the package g\+\+ "
    )
    for cxx in ("nocompiler -m64", "ccache nocompiler"):
        monkeypatch.setenv("CXX", cxx)
        with pytest.raises(SystemExit, match=wanted) as stop:
            build["check_compiler"]()
        assert "\n" not in stop.value.code
    command = [sys.executable, str(ROOT / "setup.py"), "build_ext"]
    process = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert process.returncode == 1 and process.stderr == f"{stop.value.code}\n" and not process.stdout


def test_one_word_and_none(build, monkeypatch):
    monkeypatch.setenv("CXX", "ccache")
    assert build["host_compiler"]() == ["-ccbin", "ccache"]
    for empty in ("", " "):
        monkeypatch.setenv("CXX", empty)
        assert len(build["compiler"]()) == 1
    monkeypatch.delenv("CXX")
    assert len(build["compiler"]()) == 1


REPORT = """\
ptxas info    : Compiling entry function '_Z6kernelv' for 'sm_{0}'
ptxas info    : Function properties for _Z6kernelv
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 8 registers, used 0 barriers
"""


@pytest.fixture
def check(monkeypatch, tmp_path):
    """The module cuda_check.py, which writes into the test's folder."""
    path = ROOT / ".ci" / "cuda_check.py"
    if not path.is_file():
        pytest.skip(".ci/cuda_check.py is missing: the tests need the source tree")
    spec = importlib.util.spec_from_file_location("cuda_check", path)
    check = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(check)
    monkeypatch.setattr(check, "OUT", tmp_path / "out")
    return check


def program(path, text="") -> None:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


@pytest.fixture
def reporting(check, monkeypatch, capsys, tmp_path):
    """A function that runs the check with a stub nvcc that prints a report; returns (status, printed text)."""

    def run(report, *architectures, command="cat '{}' >&2"):
        (tmp_path / "report").write_text(report)
        program(tmp_path / "nvcc", command.format(tmp_path / "report"))
        monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
        return check.main(list(architectures)), capsys.readouterr().out.rstrip()

    return run


@pytest.mark.parametrize(
    ("reported", "status", "outcome"),
    [
        (["80", "90"], 0, "held without a warning, 0 spilling."),
        (["80"], 1, "(sm_90)."),
        ([], 1, "failed: no kernel was reported."),
    ],
)
def test_cuda_check_fails_where_nothing_was_checked(reporting, reported, status, outcome):
    found, said = reporting("".join(REPORT.format(arch) for arch in reported), "80", "90")
    assert found == status and said.endswith(outcome)


def test_cuda_check_compiles_with_the_folder_that_includes_start_from(check, reporting, tmp_path):
    reporting(REPORT.format("80"), "80")
    program(tmp_path / "nvcc", f"echo \"$@\" >> '{tmp_path}/commands'")
    check.main(["80"])
    compiled = [line for line in (tmp_path / "commands").read_text().splitlines() if " -c " in line]
    assert len(compiled) == len(list((ROOT / "csrc").rglob("*.cu")))
    folder = Path(os.path.relpath(ROOT / "csrc", check.OUT)).as_posix()
    assert all(f" -I{folder} " in line for line in compiled)


def test_cuda_check_names_what_does_not_compile(reporting):
    breaks = "case \"$*\" in *cell_sort.cu*) echo 'error: no'; exit 1;; esac; cat '{}' >&2"
    status, said = reporting(REPORT.format("80"), "80", command=breaks)
    assert status == 1 and "error: no" in said and said.endswith("failed in geometry/cell_sort.cu.o.")


def test_cuda_check_leaves_the_toolkits_own_kernels_alone(reporting):
    theirs = REPORT.replace("_Z6kernelv", "_ZN3cub18CUB_300001_SM_8000EmptyKernelIvEEvv")
    theirs = theirs.replace("0 bytes spill", "8 bytes spill")
    status, said = reporting(REPORT.format("80") + theirs.format("80"), "80")
    assert status == 0 and "cub" not in said and "kernels and 1 of the toolkit's compiled for sm_80" in said


def test_cuda_check_compares_with_the_table(check, monkeypatch, tmp_path):
    row = {"registers": 40, "spilled_bytes": 8, "shared_bytes": 0, "warps": 48}
    monkeypatch.setattr(check, "TABLE", tmp_path / "table.json")
    # The table is absent; a kernel that is not in the table must have no spills.
    assert len(check.regressions("V13", {"kernel": {"sm_80": row}}, {})) == 1
    check.TABLE.write_text(check.as_text("V13", {"kernel": {"sm_80": row}}, {}))
    assert check.regressions("V13", {"kernel": {"sm_80": row}}, {}) == []
    more = {"kernel": {"sm_80": {**row, "registers": 41, "spilled_bytes": 12}}}
    assert check.regressions("V13", more, {}) == [
        "kernel (sm_80): spilled_bytes 12, above 8",
        "kernel (sm_80): registers 41, above 40",
    ]
    fewer = {"kernel": {"sm_80": {**row, "warps": 47}}}
    assert check.regressions("V13", fewer, {}) == ["kernel (sm_80): warps 47, below 48"]
    assert check.regressions("V14", more, {}) == ["kernel (sm_80): spilled_bytes 12, above 8"]
    assert [check.warps(registers, "sm_90") for registers in (8, 32, 33, 255)] == [64, 64, 51, 8]
    assert [check.warps(8, architecture) for architecture in ("sm_75", "sm_89")] == [32, 48]


def test_cuda_check_notes_the_architectures_it_was_asked_for(check, monkeypatch, reporting, tmp_path):
    monkeypatch.setattr(check, "TABLE", tmp_path / "table.json")
    old = {"registers": 40, "spilled_bytes": 0, "shared_bytes": 0, "warps": 48}
    _, said = reporting(REPORT.format("90"), "90")
    kernel = next(line for line in said.splitlines() if "kernel" in line).split(": registers")[0]
    kernels = {kernel: {"sm_100": old, "sm_90": old}, "gone": {"sm_100": old}}
    check.TABLE.write_text(check.as_text("V12", kernels, {}))
    reporting(REPORT.format("90"), "90", "--update")
    assert list(check.json.loads(check.TABLE.read_text())["kernels"][kernel]) == ["sm_90"]  # drops rows of another nvcc
    check.TABLE.write_text(check.as_text("", kernels, {}))
    reporting(REPORT.format("90"), "90", "--update")
    kept = check.json.loads(check.TABLE.read_text())["kernels"]
    assert list(kept[kernel]) == ["sm_90", "sm_100"] and "gone" not in kept
    assert kept[kernel]["sm_100"] == list(old.values()) != kept[kernel]["sm_90"]


@pytest.fixture
def installed(tmp_path):
    """A function that runs programs of a new virtual environment, in which the wheel of `make wheel` is installed.

    Nothing is downloaded or compiled: the environment links to the requirements in this one.
    """
    wheels = sorted((ROOT / "dist").glob("voronerf-*.whl"), key=os.path.getmtime)
    if not wheels:
        pytest.skip("there is no wheel in dist: make wheel")
    venv.create(tmp_path / "venv", with_pip=True, symlinks=True)
    folder = tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin")
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(tmp_path / "venv")}))
    (metadata,) = importlib.metadata.distributions(name="voronerf", path=[str(wheels[-1])])
    link_requirements(metadata, {"viewer"}, packages)
    environment = {name: text for name, text in os.environ.items() if name not in ("PYTHONPATH", "PIP_FIND_LINKS")}

    def run(program, *arguments):
        command = [str(folder / program), *map(str, arguments)]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, (command, done.stdout, done.stderr)
        return done.stdout

    run("pip", "install", "--no-index", "--disable-pip-version-check", wheels[-1])
    return run


def link_requirements(metadata, extras, packages, seen=None) -> None:
    """Links the requirements of a distribution and of the given extras into a folder, recursively."""
    requirements = pytest.importorskip("packaging.requirements", reason="packaging is not installed")
    seen = set() if seen is None else seen
    for text in metadata.requires or ():
        wanted = requirements.Requirement(text)
        chosen = [wanted.marker is None or wanted.marker.evaluate({"extra": extra}) for extra in ("", *extras)]
        if not any(chosen) or wanted.name in seen:
            continue
        if wanted.name == metadata.name:  # an extra that includes another one
            link_requirements(metadata, wanted.extras, packages, seen)
            continue
        seen.add(wanted.name)
        distribution = importlib.metadata.distribution(wanted.name)
        for name in {file.parts[0] for file in distribution.files or () if file.parts[0] not in ("..", "__pycache__")}:
            if not (packages / name).exists():
                (packages / name).symlink_to(distribution.locate_file(name))
        link_requirements(distribution, wanted.extras, packages, seen)


@pytest.mark.slow
def test_the_wheel_does_the_main_job_in_a_new_environment(installed):
    tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for command in settings["tool"]["cibuildwheel"]["test-command"]:
        said = installed(*command.split())
        assert "built with" in said or not command.endswith("info")  # built with or without CUDA
    assert "Building" not in installed("pip", "install", "--no-index", "voronerf[viewer]")
    installed("python", "-c", "import voronerf.app.viewer, sys; assert '.venv' not in voronerf.__file__")


@pytest.fixture
def machine():
    path = ROOT / ".ci" / "machine_run.py"
    if not path.is_file():
        pytest.skip(".ci/machine_run.py is missing: the tests need the source tree")
    return SimpleNamespace(**runpy.run_path(str(path)))


def launched(machine, instructions, *words):
    """Runs instructions in one warp with 64-bit arguments; returns the launch."""
    kernel = machine.Kernel([line.strip() for line in instructions.strip().splitlines()])
    launch = machine.Launch(kernel, 1, 32, 0, struct.pack(f"<{len(words)}Q", *words), range(0), 0)
    launch.run(0)
    return launch


def test_machine_code_counts_each_group_of_lanes_that_issues_an_instruction(machine):
    text = """
        S2R R0, SR_TID.X
        LDC.64 R2, c[0x0][0x210]
        IMAD.WIDE.U32 R2, R0, 0x4, R2
        ISETP.GE.AND P0, PT, R0, 0x8, PT
        BSSY B0, 0x80
        @P0 BRA 0x70
        IMAD.SHL.U32 R0, R0, 0x2, RZ
        BSYNC B0
        @!P0 VIADD R0, R0, 0xffffffff
        @!PT BRA 0x0
        STG.E desc[UR4][R2.64], R0
        EXIT
    """
    launch = launched(machine, text, 1 << 20)
    assert launch.counts == [1] * 7 + [2] + [1] * 4
    values = [2 * lane - 1 if lane < 8 else lane for lane in range(32)]
    place = (1 << 20) - machine.PROCESS.base
    assert launch.stored[4] == {place + 4 * lane: value % 2**32 for lane, value in enumerate(values)}


@pytest.mark.parametrize("a", [0, 5, 2**32 - 1, 2**32, 2**63 - 1, 2**64 - 1, 2**64 - 2**32])
@pytest.mark.parametrize("b", [0, 1, 2**32, 2**33 - 1, 2**63])
def test_machine_code_computes_with_64_bits(machine, a, b):
    text = """
        LDC.64 R4, c[0x0][0x210]
        LDC.64 R6, c[0x0][0x218]
        LDC.64 R2, c[0x0][0x220]
        IADD3 R8, P0, R4, -R6, RZ
        IADD3.X R9, R5, ~R7, RZ, P0, !PT
        LEA R10, P1, R4, R6, 0x3
        LEA.HI.X R11, R4, R7, R5, 0x3, P1
        ISETP.GE.U32.AND P2, PT, R4, R6, PT
        ISETP.GE.AND.EX P2, PT, R5, R7, PT, P2
        SEL R12, RZ, 0x1, !P2
        STG.E.128 desc[UR4][R2.64], R8
        STG.E desc[UR4][R2.64+0x10], R12
        EXIT
    """
    words = [*launched(machine, text, a, b, 1 << 20).stored[4].values()]
    assert words[0] + (words[1] << 32) == (a - b) % 2**64
    assert words[2] + (words[3] << 32) == (8 * a + b) % 2**64
    signed = [number - 2**64 if number >> 63 else number for number in (a, b)]
    assert words[4] == (signed[0] >= signed[1])


def test_machine_code_of_a_warp_needs_all_lanes(machine):
    divide = "S2R R0, SR_TID.X\nISETP.GE.AND P0, PT, R0, 0x8, PT\n@P0 EXIT"
    product = "HMMA.16816.F32.BF16 R8, R4, R6, R8\nEXIT"
    assert launched(machine, product).counts == [1, 1]
    with pytest.raises(RuntimeError, match="only some lanes"):
        launched(machine, f"{divide}\n{product}")


@pytest.mark.parametrize("text", ["FROB R0, R1", "MOV.FROB R0, R1", "SHFL.BFLY PT, R0, R1, 0x1, R2", "MOV R0, B1"])
def test_machine_code_names_an_unknown_instruction(machine, text):
    with pytest.raises(NotImplementedError, match=re.escape(f"{text} at 0x10")):
        launched(machine, f"NOP\n{text}\nEXIT")


def test_cuda_check_tells_of_more_instructions_of_a_pass(check, monkeypatch, tmp_path):
    monkeypatch.setattr(check, "TABLE", tmp_path / "table.json")
    check.TABLE.write_text(check.as_text("V13", {}, {"net forward": 1000}))
    assert check.regressions("V13", {}, {"net forward": 1010, "other forward": 5}) == []
    assert check.regressions("V14", {}, {"net forward": 1011}) == []
    assert check.regressions("V13", {}, {"net forward": 1011}) == ["net forward: 1011 instructions, above 1000"]
    assert check.merged("V13", {}, {}) == ({}, {"net forward": 1000})  # none were run
    assert check.merged("V14", {}, {}) == ({}, {})
