"""Tests of the selection of backends, and of the messages about missing backends."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest
import torch

from voronerf.ops._core import backends
from voronerf.ops._core.backends import BackendUnavailable, resolve

CPU = torch.device("cpu")


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})


def test_unknown_names_list_the_choices() -> None:
    with pytest.raises(
        ValueError, match=r"nearest_centre: backend must be one of 'auto' \| 'reference'.*got 'fastest'"
    ):
        resolve("nearest_centre", backend="fastest", device=CPU, dtype=torch.float32)
    with pytest.raises(ValueError, match=r"op must be one of .*'nearest_centre'.*got 'farthest_centre'"):
        resolve("farthest_centre", backend="auto", device=CPU, dtype=torch.float32)


def test_named_backend_never_falls_back(monkeypatch: pytest.MonkeyPatch) -> None:
    backends._choose_once.cache_clear()
    monkeypatch.delitem(backends._TABLE, ("grouped_program", "warp"))  # an op without Warp
    with pytest.raises(BackendUnavailable, match=r"there is no warp implementation of grouped_program; use backend="):
        resolve("grouped_program", backend="warp", device=CPU, dtype=torch.float32)
    with pytest.raises(BackendUnavailable, match="takes 'int32', not int64"):
        resolve("cell_sort", backend="native", device=CPU, dtype=torch.int64)
    with pytest.raises(BackendUnavailable, match=r"runs on 'cpu' \| 'cuda', not on meta"):
        resolve("nearest_centre", backend="native", device=torch.device("meta"), dtype=torch.float32)


def test_auto_takes_what_supports_the_call() -> None:
    function = resolve("cell_sort", backend="auto", device=CPU, dtype=torch.int64)
    assert function.__module__ == "voronerf.ops.cell_sort.reference"
    function = resolve("nearest_centre", backend="auto", device=torch.device("meta"), dtype=torch.float32)
    assert function.__module__ == "voronerf.ops.nearest_centre.reference"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
@pytest.mark.parametrize("backend", backends.BACKENDS)
def test_cuda_without_a_device_says_so(backend: str) -> None:
    with pytest.raises(BackendUnavailable, match="torch sees no CUDA device; use device='cpu'"):
        resolve("nearest_centre", backend=backend, device=torch.device("cuda"), dtype=torch.float32)


def test_table_agrees_with_resolve() -> None:
    rows = backends.table()
    assert [(row.op, row.backend) for row in rows] == [
        (op, name) for op in backends.ops() for name in backends.BACKENDS
    ]
    for row in rows:
        assert row.available or row.reason
        assert "\n" not in row.reason
        for dtype in row.dtypes:
            for device in row.devices:
                kind = getattr(torch, dtype, torch.float32)  # float32 for "any" and "plain torch"
                resolve(row.op, backend=row.backend, device=torch.device(device), dtype=kind)


@pytest.mark.native
def test_describe_records_the_build() -> None:
    described = backends.describe()
    native = described["native"]
    assert (described["torch"], described["threads"]) == (torch.__version__, torch.get_num_threads())
    assert native["instruction set"] in ("portable", "neon", "avx2", "avx512", "avx512_bf16", "amx")
    assert native["bfloat16 products"].startswith("in ")
    assert native["compiler"]
    assert native["cuda"].startswith("built with")


def test_import_needs_neither_extension_nor_warp() -> None:
    code = """
import sys
sys.modules["voronerf.ops._core._C"] = None  # as if it were not built
import torch, voronerf
assert "warp" not in sys.modules
sys.modules["warp"] = None  # as if it were not installed
from voronerf.ops._core import backends
points = torch.zeros(2, 3)
run = backends.resolve("nearest_centre", backend="auto", device=points.device, dtype=points.dtype)
assert run.__module__ == "voronerf.ops.nearest_centre.reference", run
for backend, remedy in (("native", "pip install -e ."), ("warp", "voronerf[warp]")):
    try:
        backends.resolve("nearest_centre", backend=backend, device=points.device, dtype=points.dtype)
    except backends.BackendUnavailable as error:
        assert remedy in str(error) and "\\n" not in str(error), error
    else:
        raise SystemExit(f"{backend} did not raise")
rows = {(row.op, row.backend): row for row in backends.table()}
assert not rows["nearest_centre", "native"].available
assert not backends.describe()["native"]["available"]
from voronerf.app.cli import main
assert main(["info"]) == 1
"""
    result = run_python(code)
    assert result.returncode == 0, result.stderr
    last = result.stderr.splitlines()[-1]
    assert last.startswith("voronerf: error: voronerf in ") and "During handling" not in result.stderr


def test_sources_without_their_compiled_module_say_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If a checkout shadows the result of ``pip install .``, the message says where the compiled module is."""
    monkeypatch.delitem(sys.modules, "voronerf.ops._core.native")
    monkeypatch.setitem(sys.modules, "voronerf.ops._core._C", None)
    backends._warn_once.cache_clear()
    here = Path(backends.__file__).parents[3]
    monkeypatch.setattr(sys, "path", [str(here), str(tmp_path)])
    (folder := tmp_path / "voronerf/ops/_core").mkdir(parents=True)
    for remedy in (
        "install a wheel, or build the module with `pip install -e .` (needs a C++17 compiler)",
        f"run Python in another folder to use the installation in {tmp_path}, or build the module with "
        "`pip install -e .`",
    ):
        said = rf"voronerf in {here} cannot load its compiled module \(.*_C.*\); {re.escape(remedy)}"
        with pytest.warns(RuntimeWarning, match=rf"^{said}. Until then the much slower plain PyTorch is used") as told:
            reasons = {backends.missing("native", CPU) for _ in range(3)}
        assert len(told) == 1 and re.fullmatch(said, *reasons)
        (folder / f"_C{EXTENSION_SUFFIXES[0]}").touch()


@pytest.mark.slow
def test_an_old_warp_is_refused() -> None:
    code = """
import sys, types
warp = types.ModuleType("warp")
warp.__version__ = "1.9.2"
sys.modules["warp"] = warp
import torch
from voronerf.ops._core import backends
reason = backends.missing("warp", torch.device("cpu"))
assert reason.startswith("NVIDIA Warp 1.9.2 is too old; install it with `pip install 'voronerf[warp]'`"), reason
"""
    result = run_python(code)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("stale", ["", "module.interface = 0"])
def test_a_compiled_module_of_another_version_is_refused(stale: str) -> None:
    code = f"""
import sys, types
module = types.ModuleType("voronerf.ops._core._C")
{stale}
sys.modules["voronerf.ops._core._C"] = module
import torch, warnings
from voronerf.ops._core import backends
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    reasons = [backends.missing("native", torch.device("cpu")) for _ in range(3)]
assert len(told) == 1 and str(told[0].message).startswith("the compiled module was built from another version"), told
reason = reasons[0]
assert reason is not None and reason.startswith("the compiled module was built from another version"), reason
assert reason.endswith("rebuild it with `pip install -e .`"), reason
points = torch.zeros(2, 3)
run = backends.resolve("nearest_centre", backend="auto", device=points.device, dtype=points.dtype)
assert run.__module__ == "voronerf.ops.nearest_centre.reference", run
assert backends.describe()["native"]["reason"] == reason
"""
    result = run_python(code)
    assert result.returncode == 0, result.stderr


def test_require_turns_skips_into_failures(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(backend: str, device: torch.device) -> str | None:
        return None if backend == "reference" else "it is not here"

    monkeypatch.setattr(backends, "missing", missing)
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text())
    pytester.makepyfile("def test_it(backend):\n    assert backend == 'reference'\n")
    skipped = pytester.runpytest_inprocess("-rs")
    skipped.assert_outcomes(passed=1, skipped=2)
    skipped.stdout.fnmatch_lines("*native: it is not here*")
    required = pytester.runpytest_inprocess("--require", "native")
    required.assert_outcomes(passed=1, skipped=1, errors=1)
    required.stdout.fnmatch_lines("*--require native: it is not here*")
    unknown = pytester.runpytest_inprocess("--require", "metal")
    unknown.stderr.fnmatch_lines("*--require takes native,cuda,warp, got metal*")


def test_an_op_is_tested_on_the_devices_of_each_implementation(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backends, "missing", lambda backend, device: None)
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text())
    test = "@pytest.mark.op('{0}')\ndef test_{0}(device, backend):\n    pass\n"
    pytester.makepyfile("import pytest\n" + "".join(map(test.format, ("adam", "balance_centres"))))
    collected = [line.partition("::test_")[2] for line in pytester.runpytest_inprocess("--collect-only", "-q").outlines]
    pairs = ("reference-cpu", "native-cpu", "reference-cuda")
    expected = [*(f"adam[{pair}]" for pair in (*pairs, "native-cuda")), *(f"balance_centres[{pair}]" for pair in pairs)]
    assert [line for line in collected if line] == expected


def test_auto_runs_networks_natively_on_every_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "missing", lambda backend, device: None)
    choose = backends._choose_once.__wrapped__
    for op in ("grouped_mlp", "grouped_linear", "routed_mlp"):
        for device in ("cpu", "cuda"):
            assert choose(op, "auto", device, None, torch.float32) == "native"
        assert choose(op, "auto", "cuda", None, torch.float64) == "reference"


def test_auto_takes_warp_on_cuda_where_native_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    absent = lambda backend, device: "built without CUDA" if backend == "native" and device.type == "cuda" else None  # noqa: E731
    monkeypatch.setattr(backends, "missing", absent)
    choose = backends._choose_once.__wrapped__
    for op in ("nearest_centre", "cell_sort", "grouped_mlp", "render_loss"):
        kind = torch.int32 if op == "cell_sort" else torch.float32
        assert choose(op, "auto", "cuda", None, kind) == "warp"
        assert choose(op, "auto", "cpu", None, kind) == "native"
    for op in ("adam", "composite"):  # the reference
        assert choose(op, "auto", "cuda", None, torch.float32) == "reference"
        assert choose(op, "warp", "cuda", None, torch.float32) == "warp"


def test_what_auto_takes_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = {"native": "built without CUDA"}
    monkeypatch.setattr(backends, "missing", lambda backend, device: gone.get(backend))
    cuda = torch.device("cuda")
    assert backends.automatic(cuda) == "warp (native: built without CUDA)"
    gone["warp"] = "not installed"
    assert backends.automatic(cuda) == "reference (native: built without CUDA; warp: not installed)"
    gone["reference"] = "no device"
    assert backends.automatic(cuda) == "nothing (no device)"
    gone.clear()
    assert backends.automatic(cuda) == "native"


@pytest.mark.warp
def test_what_warp_has_no_kernel_of_runs_as_plain_torch_with_its_operations_on_warp() -> None:
    run = backends.resolve_composed("render_opaque", backend="warp", device=CPU, dtype=torch.float32)
    assert run.func.__module__ == "voronerf.ops.render_opaque.reference" and run.keywords == {"backend": "warp"}
    assert resolve("adam", backend="warp", device=CPU, dtype=torch.float32).__module__ == "voronerf.ops.adam.reference"
    assert "warp" not in backends.implemented("adam")


@pytest.mark.slow
def test_a_source_folder_that_is_not_installed_says_so() -> None:
    """A source folder that is not installed lacks ``voronerf.kernels``; the message says how to install."""
    code = f"""
import sys
sys.meta_path = [finder for finder in sys.meta_path if "editable" not in repr(finder).lower()]
sys.path.insert(0, {str(Path(__file__).parent.parent)!r})
import torch
from voronerf.ops._core import backends
reason = backends.missing("warp", torch.device("cpu"))
assert reason == "the Warp kernels are not installed; run `pip install -e .`", reason
assert backends.describe()["warp"] == {{"available": False, "reason": reason}}
assert len(backends.table()) == len(backends.ops()) * len(backends.BACKENDS)
"""
    result = run_python(code)
    assert result.returncode == 0, result.stderr
