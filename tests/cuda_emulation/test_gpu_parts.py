"""Tests of the programs of ``make gpu-check`` on the CPU, to find mistakes before a run on a GPU."""

import importlib.util
import itertools
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import torch
from emulated import emulated
from helpers import read_json

ROOT = Path(__file__).resolve().parent.parent.parent
GPU = ROOT / "benchmarks" / "gpu"


def program(name):
    if str(GPU) not in sys.path:
        sys.path.append(str(GPU))  # as when the program runs
    spec = importlib.util.spec_from_file_location(name, GPU / f"{name}.py")
    assert spec is not None and spec.loader is not None
    loaded = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look up their module there
    spec.loader.exec_module(loaded)
    return loaded


@pytest.fixture
def parts(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    return program("gpu_parts")


@pytest.fixture
def check():
    return program("gpu_check")


@pytest.mark.slow
@pytest.mark.native
def test_the_first_call_on_the_emulated_device(tmp_path):
    """Runs the first call of `make gpu-check`, every case with small sizes, in separate processes.

    Checks that all cases are right, and what the summary and the printed verdict contain.
    """
    command = [sys.executable, str(GPU / "gpu_check.py"), "first", "--emulated", "--parts", "cases", "counters"]
    result = subprocess.run([*command, "--out", str(tmp_path)], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parts-first.tar.gz", "summary-first.json"]
    found = read_json(tmp_path / "summary-first.json")["parts"]["cases"]["found"]
    assert all(row["right"] for row in found["cases"]) and "left out" not in found
    names = [(row["part"], row["name"]) for row in found["cases"]]
    assert len(set(names)) == len(names)
    rows = [row for row in found["cases"] if "share" in row]
    assert len(rows) == 28 and all(row["seconds"] > 0 and row["floor"] > 0 for row in rows)
    assert any(row.get("graph", "").endswith("calls") for row in rows)
    counted = {row["name"]: row["most"] for row in rows if row["most"]}
    assert 0.30 < counted["nearest_centre k=512 n=128"] < 0.33 and 0.41 < counted["w64d4 bfloat16 k=16 n=128"] < 0.45
    counts = Counter(part for part, _ in names)
    assert counts.pop("small") > 90
    assert counts == {"large": 6, "captured": 10, "rows": 29, "training": 2, "profile": 2}
    shown = result.stdout[result.stdout.index("gpu-check first on") :]
    assert len(shown) < 11_000 and all(len(line) <= 100 for line in shown.splitlines())
    for row in found["cases"]:
        if row["said"] and row["part"] not in ("small", "large"):
            assert row["name"] in shown


@pytest.mark.native
def test_cases_by_name(parts, tmp_path):
    journal = parts.Journal(tmp_path / "cases.json")
    with emulated():
        cases = parts.cases_of(["small", "captured"], "cpu", journal, emulated=True)
    for each, count in (("@checked", 21), ("@racing", 14)):
        assert [case.part for case in parts.chosen(cases, list(parts.LISTS[each]))] == ["small"] * count
    found = parts.chosen(cases, ["width 64*", "adam", "capturd"])
    assert [case.name for case in found] == ["capturd", "adam", "width 64", *[case.name for case in found[3:]]]
    assert len(found) == 5
    with pytest.raises(LookupError, match="no case of this name"):
        found[0].run()


@pytest.mark.native
def test_a_row_of_a_network_is_captured(parts, monkeypatch, tmp_path):
    """Captures a network's benchmark with gradients as a CUDA graph, which the test of the first call has no time for.

    A benchmark in which the host waits for the device is not captured.
    """
    timings, journal = sys.modules["gpu_timings"], parts.Journal(tmp_path / "cases.json")
    monkeypatch.setattr(timings, "MOST_CALLS", 2)
    monkeypatch.setattr(timings, "MOST_REPEATS", 1)
    with parts.on_the_emulated_device():
        cases = {case.name: case.run for case in timings.rows("cpu", journal, 32, 32, 1e6)}
        found = cases["w64d4 float32 k=16 n=32 + backward"]()
        waits = timings.clock(lambda: torch.ones(3).sum().item(), torch.device("cpu"), 1e6)
    assert found["graph"] == "2 calls" and "share" not in found, "the limits are not known"
    assert waits["graph"].startswith("the host waits for the device") and waits["seconds"] == waits["launched"]


def test_counted_launches(parts):
    """Checks that each of the launches for ncu launches a kernel of this project."""
    with emulated() as module:
        launches = parts.counted("cpu", 256)
        for name, before, launch in launches:
            before()
            launched = module.launches()
            launch()
            assert module.launches() > launched, name
    assert len(launches) == 6


FAULTS = """
import os, sys, threading, types
sys.path.insert(0, {gpu!r})
import gpu_parts

broken = False

def synchronize():
    if broken:
        raise RuntimeError("an illegal memory access was encountered")

def breaks():
    global broken
    broken = True
    synchronize()

def spoils():  # and is right, as a timing whose capture went wrong
    global broken
    broken = True

cuda = types.SimpleNamespace(synchronize=synchronize)
sys.modules["torch"] = types.SimpleNamespace(cuda=cuda, rand=lambda *_, **__: None)
cases = [("first", lambda: None), ("breaks", breaks), ("between", lambda: None), ("dies", lambda: os.abort())]
cases += [("hangs", lambda: threading.Event().wait(60)), ("spoils", spoils), ("last", lambda: None)]
cases = [gpu_parts.Case("small", *case, 0.5) for case in cases]
gpu_parts.cases_of = lambda *_, **__: cases
gpu_parts.about = dict
sys.exit(gpu_parts.main(sys.argv[1:]))
"""


def test_a_fault_and_a_kernel_that_hangs_end_their_own_case_alone(check, tmp_path):
    """Uses real processes: a broken device stays broken until the next process."""
    (tmp_path / "faults.py").write_text(FAULTS.format(gpu=str(GPU)))
    command = [sys.executable, str(tmp_path / "faults.py"), "cases", str(tmp_path / "out"), "--parts", "small"]
    part = check.Part([command], 50, (), tmp_path / "out" / "cases.json")
    result = check.run("cases", part, tmp_path, 50.0)
    assert result["outcome"] == "failed"
    assert result["last"] == "3 of 7 cases are right, 0 left out for want of time"
    kept = read_json(tmp_path / "out" / "cases.json")["cases"]
    assert [(row["number"], row["name"], row["right"], row["said"]) for row in kept] == [
        (0, "first", True, ""),
        (1, "breaks", False, "RuntimeError: an illegal memory access was encountered"),
        (2, "between", True, ""),
        (3, "dies", False, "ended its process, status -6"),
        (4, "hangs", False, "hangs, stopped after 0.5 s"),
        (5, "spoils", False, "RuntimeError: an illegal memory access was encountered"),
        (6, "last", True, ""),
    ]


def test_cases_that_no_process_begins_any_more_are_not_tried_for_ever(check, tmp_path):
    """Checks a case after which no other process can use the device."""
    script = f"""
import sys
sys.path.insert(0, {str(GPU)!r})
import gpu_journal
if "--start" not in sys.argv:
    journal = gpu_journal.Journal(gpu_journal.Path({str(tmp_path / "cases.json")!r}))
    journal.put("at", {{"number": 4, "part": "small", "name": "fifth"}})
sys.exit(7)
"""
    part = check.Part([[sys.executable, "-c", script]], 20, (), tmp_path / "cases.json")
    result = check.run("cases", part, tmp_path, 20.0)
    assert result["outcome"] == "failed" and result["seconds"] < 10
    assert [row["said"] for row in result["found"]["cases"]] == ["ended its process, status 7"]


def test_cases_that_the_time_is_too_short_for_are_left_out(parts, tmp_path):
    """Checks three parts: the second inherits the first part's unused time, and the third has no time."""
    journal, slow = parts.Journal(tmp_path / "cases.json"), lambda: time.sleep(0.3)
    cases = [parts.Case(part, str(number), slow) for part, number in (("a", 1), ("b", 2), ("b", 3), ("c", 4))]
    assert parts.one_by_one(cases, {"a": 0.45, "b": 0.0, "c": 0.0}, lambda: None, journal) == 0
    assert [row["name"] for row in journal.found["cases"]] == ["1", "2"]
    assert [row["name"] for row in journal.found["left out"]] == ["3", "4"]


@pytest.mark.slow
def test_a_file_of_tests_that_hangs_fails_alone(parts, tmp_path, capsys):
    (tmp_path / "conftest.py").write_text("def pytest_addoption(parser):\n    parser.addoption('--require')\n")
    bodies = {
        "hangs": "import time\ndef test_cuda():\n    time.sleep(600)\n",
        "passes": "def test_cuda(pytestconfig):\n    assert pytestconfig.getoption('require') == 'native,cuda'\n",
        "wrong": "def test_cuda():\n    assert 1 + 1 == 3\n",
        "other": "def test_elsewhere():\n    assert False\n",
    }
    files = []
    for name, body in bodies.items():
        files.append(tmp_path / f"test_planted_{name}.py")
        files[-1].write_text(body)
    assert parts.tests(tmp_path / "out", files, 10.0) == 2
    said = capsys.readouterr().out.splitlines()
    outcomes = {line.split()[1].removeprefix("test_planted_"): line for line in said if "  test_planted_" in line}
    assert outcomes["hangs.py:"].startswith("FAILED  test_planted_hangs.py: stopped after 10 s")
    assert list(outcomes)[-1] == "hangs.py:", "the others are told before it"
    assert outcomes["passes.py:"].startswith("passed") and "1 passed" in outcomes["passes.py:"]
    assert outcomes["wrong.py:"].startswith("FAILED") and outcomes["other.py:"].startswith("passed")
    assert said[-1] == "2 of 4 files passed"
    kept = {row["name"]: row for row in read_json(tmp_path / "out" / "tests.json")["cases"]}
    assert kept["test_planted_passes.py"]["right"] and not kept["test_planted_hangs.py"]["right"]
    assert any(line.endswith("assert (1 + 1) == 3") for line in kept["test_planted_wrong.py"]["wrong"])


@pytest.mark.slow
def test_a_part_that_hangs_is_ended_with_all_that_it_started(check, monkeypatch, tmp_path):
    monkeypatch.setattr(check, "SHORTEST", 0.0)
    child = f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    script = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    result = check.run("hangs", check.Part([[sys.executable, "-c", script]], 2), tmp_path, 2.0)
    assert result["outcome"] == "failed" and result["last"].startswith("stopped after 2 s")
    child_pid = int((tmp_path / "pid").read_text())
    for _ in range(100):
        state = Path(f"/proc/{child_pid}/stat")
        # An ended process may stay a zombie until its new parent reaps it.
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    raise AssertionError("the child of the part still runs")


def test_the_summary_has_all_that_a_part_has_found(check, monkeypatch, tmp_path):
    """Checks that findings of an earlier run are removed, and that a partly written file is reported."""
    (tmp_path / "old.json").write_text('{"cases": ["of an earlier run"]}')
    write = "import sys; open(sys.argv[1], 'w').write(sys.argv[2]); print('done')"

    def part(name, *program):
        path = tmp_path / f"{name}.json"
        return check.Part([[sys.executable, "-c", program[0], str(path), *program[1:]]], 100, (), path)

    known = {"good": part("good", write, '{"a": [1]}'), "torn": part("torn", write, '{"a"'), "old": part("old", "pass")}
    known["late"] = check.Part(known["good"].commands, 1)
    known["absent"] = check.Part("not here", 100)
    known["second"] = check.Part([["false"], [sys.executable, "-c", "print('instead')"]], 100)
    monkeypatch.setattr(check, "parts", lambda *_, **__: known)
    assert check.main(["second", "--out", str(tmp_path / "out")]) == 0
    kept = read_json(tmp_path / "out" / "summary-second.json")["parts"]
    assert kept["good"]["found"] == {"a": [1]} and kept["torn"]["found"].startswith("torn.json: ")
    assert kept["old"]["found"] is None and kept["absent"]["outcome"] == "left out"
    assert kept["late"]["last"] == "no time left" and kept["second"]["last"] == "instead"
    assert kept["good"]["commands"] == known["good"].commands


def test_calls_fit_their_time(check, parts, monkeypatch, tmp_path):
    """Checks that the time limits of parts rise up to the limit of the call, and no tool changes the GPU's settings."""
    monkeypatch.setattr(check.shutil, "which", lambda name, **_: f"/bin/{name}")
    for call, seconds in (("first", 390), ("second", 240)):
        known = check.parts(call, tmp_path, tmp_path, ["adam"], emulated=False)
        ends = [part.until for name, part in known.items() if name != "build"]
        assert ends == sorted(ends) and ends[-1] == seconds and known["build"].until < ends[-1]
        for name, part in known.items():
            (*_, command) = part.commands
            assert ("kns=voronerf" in command) == name.endswith("check")
            assert ("regex:program_kernel|hash_encode" in command) == (name == "counters")
            if name == "counters":
                assert command[command.index("--clock-control") + 1] == "none"
        # Linking takes 20 s; imports and a CUDA context take 15 s.
        assert call == "second" or sum(parts.BUDGETS.values()) + 35 <= known["cases"].until


SANITIZED = """========= COMPUTE-SANITIZER
right  small: adam
========= Invalid __global__ read of size 4 bytes
=========     at voronerf::k(int)+0x50 in a.cu:3
=========     by thread (0,0,0) in block (0,0,0)
========= ERROR SUMMARY: 1 error
"""


def test_the_verdict_is_short_and_says_the_most_telling_first(check):
    row = {"part": "rows", "right": True, "limit": "copy", "seconds": 2e-5, "share": 0.5, "most": None, "said": ""}
    rows = [{**row, "name": "near", "most": 0.6}, {**row, "name": "near by torch.bmm", "seconds": 8e-5}]
    rows += [{**row, "name": f"sort by {way}"} for way in ("counting", "radix")]
    wrong = [{"part": "small", "name": f"case {i}", "right": False, "said": "x" * 300} for i in range(200)]
    kernel = {"name": "void voronerf::(anonymous namespace)::kernel", "microseconds": 9.0, "launches": 1.0}
    step = {"part": "profile", "name": "default", "right": True, "said": "2 ms a step", "kernels": [kernel] * 50}
    values = {
        "gpu__time_duration.sum": 2e6,
        **{"".join((check.STALLED[0], f"r{i}", check.STALLED[1])): i for i in range(9)},
    }
    torn = {"outcome": "failed", "seconds": 2.0, "last": "stopped", "found": "cases.json: torn"}
    done = {"outcome": "passed", "seconds": 1.0, "last": "fine"}
    results = {
        "cases": {**done, "found": {"cases": [*wrong, *rows, step], "left out": [{}] * 7}},
        "counters": {**done, "counted": ["w"], "found": {"launches": [{"kernel": "program_kernel", "values": values}]}},
        "memcheck": {**torn, "sanitizer": check.sanitizer_says(SANITIZED.splitlines())},
    }
    said = check.verdict("first", results)
    lines = said.splitlines()
    assert len(said) < 11_000 and all(len(line) <= 160 for line in lines)
    for part in (
        *("and 170 more that are wrong", "left out for want of time: 7 cases", "TORN memcheck: cases.json: torn"),
        "memcheck: Invalid __global__ read of size 4 bytes, at voronerf::k(int)+0x50 in a.cu:3",
        *("near: 0.25 x the time of torch.bmm", "sort: counting takes 1.00 x the time of radix"),
        *("ncu w: program_kernel", "  2 ms, r8 8.0, r7 7.0", "step default: 2 ms a step"),
    ):
        assert part in lines, part
    assert any(line.startswith("near ") and line.endswith("50.0 % of copy, by count 60") for line in lines)
    assert sum(line.endswith("9.0 us in  1.0 x kernel") for line in lines) == check.KERNELS
    assert lines.index("TORN memcheck: cases.json: torn") < next(i for i, line in enumerate(lines) if "WRONG" in line)
    long = check.cut(f"line {i:04} {'x' * 200}" for i in range(1000))
    assert len(long) < 11_000 and long.endswith("and more, in the summary")
    assert check.verdict("second", {}).startswith("gpu-check second on")


def test_launches_that_ncu_counted(check, tmp_path):
    """Parses ncu's raw page, whose rows stand among ncu's messages."""
    names = ["ID", "Kernel Name", "gpu__time_duration.sum", *(f"m{i}" for i in range(20))]
    lines = [names, ["", "", "ns", *[""] * 20], ["0", "voronerf::k(int, int)", "1,234", *["7"] * 20]]
    text = "==PROF== Connected\n" + "\n".join(",".join(f'"{each}"' for each in line) for line in lines)
    (tmp_path / "counters.csv").write_text(text)
    (launch,) = check.read(tmp_path / "counters.csv")["launches"]
    assert launch["kernel"] == "voronerf::k(int, int)" and launch["values"]["gpu__time_duration.sum"] == 1234
    (tmp_path / "counters.csv").write_text("==ERROR== no permission\n")
    assert check.read(tmp_path / "counters.csv") == "counters.csv: ==ERROR== no permission"


@pytest.mark.native
def test_gradients_at_full_size_that_are_wrong_are_found(parts, monkeypatch):
    """Checks that wrong gradients and lost output rows are found."""
    large = sys.modules["gpu_large"]
    monkeypatch.setattr(large, "SUBSET", 16)
    with emulated():
        runs = dict(large.large_cases("cpu", 300))
        whole = large.evaluate
        for precision in large.ALLOWED:
            twice = itertools.count()

            def spoilt(given, twice=twice):
                parts_of = whole(given)
                if next(twice) == 1:
                    parts_of[1] = parts_of[1] * 1.5
                return parts_of

            monkeypatch.setattr(large, "evaluate", spoilt)
            with pytest.raises(AssertionError, match="part 1 of the gradients is"):
                runs[f"w64d4 {precision}"]()

            def lost(given):
                parts_of = whole(given)
                parts_of[0][40:60] = 0
                return parts_of

            monkeypatch.setattr(large, "evaluate", lost)
            with pytest.raises(AssertionError, match=r"outputs are .* from float64"):
                runs[f"w64d4 {precision}"]()


PREBUILT = """rule cxx
  command = c++ $flags -c $in -o $out
rule link
  command = c++ $in -o $out
build bindings.cpp.o: cxx bindings.cpp
  flags = -O1
build a/b.cpp.o: cxx ../a/b.cpp
  flags = -O2
build _C.so: link bindings.cpp.o a/b.cpp.o
default _C.so
"""


def test_objects_that_are_carried_are_linked_and_not_compiled(monkeypatch, tmp_path):
    """Links with ninja, and checks that objects of other sources or for another GPU are refused."""
    prebuilt = program("prebuilt")
    monkeypatch.setattr(prebuilt, "module_name", lambda: "_C.so")
    (tmp_path / "a").mkdir()
    compiled = ["c++", "-shared", "-fPIC", "-x", "c++", "-c", "-", "-o"]
    subprocess.run([*compiled, str(tmp_path / "a/b.cpp.o")], input="int there() { return 3; }", text=True, check=True)
    text = PREBUILT.replace("c++ $in -o", "c++ -shared $in -o").replace("-O1", "-fPIC")
    source = "int there(); int twice() { return 2 * there(); }"
    build = {
        "find_cuda": lambda: None,
        "ninja_file": lambda module, cuda, folder: text,
        "bindings": lambda: source,
        "build_info": lambda cuda: "",
        "write_if_changed": lambda path, said: path.write_text(said),
        "architectures_there": lambda: ("90",),
        "ninja": lambda: [sys.executable, "-m", "ninja"],
        "stub_of": lambda module: "loads",
    }
    with pytest.raises(SystemExit, match="must hold what `prebuilt"):
        prebuilt.link(build, tmp_path)
    (tmp_path / "made").write_text(f"90 {prebuilt.digest()}")
    assert "_C.so linked" in prebuilt.link(build, tmp_path) and (tmp_path / "_C.so").exists()
    assert list(prebuilt.edges((tmp_path / "build.ninja").read_text())) == ["bindings.cpp.o", "_C.so"]
    build["stub_of"] = lambda module: ""
    with pytest.raises(SystemExit, match="does not load"):
        prebuilt.link(build, tmp_path)
    build["architectures_there"] = lambda: ("80",)
    with pytest.raises(SystemExit, match="must be for this GPU, sm_80, got sm_90"):
        prebuilt.link(build, tmp_path)
    (tmp_path / "made").write_text("90 0badf00d")
    with pytest.raises(SystemExit, match="must match csrc and setup"):
        prebuilt.link(build, tmp_path)


def test_programs_of_a_bare_machine_import_what_it_has(tmp_path):
    """Checks that imports need only torch and the standard library; pytest, tyro, rich and warp may be missing."""
    absent = ("pytest", "_pytest", "tyro", "rich", "warp", "scipy", "imageio_ffmpeg")
    code = f"""
import sys
for name in {absent!r}:
    sys.modules[name] = None
sys.path[:0] = [{str(GPU)!r}]
import gpu_parts, gpu_check, prebuilt
journal = gpu_parts.Journal(gpu_parts.Path({str(tmp_path / "cases.json")!r}))
assert len(gpu_parts.cases_of(list(gpu_parts.BUDGETS), "cpu", journal, emulated=True)) > 130
import voronerf.app.train
print("imported")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert result.stdout.endswith("imported\n"), result.stderr
