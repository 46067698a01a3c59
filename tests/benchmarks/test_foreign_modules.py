"""Tests that modules in the styles of public code run fused, and that the results file has a row per public module."""

import json
import sys
from pathlib import Path

import foreign_modules
import pytest
import torch
from ops import foreign_imports, foreign_kinds, foreign_public, foreign_rows

RESULT = Path(foreign_modules.__file__).parent / "results" / "foreign_modules.json"


@pytest.mark.slow
@pytest.mark.parametrize("kind", foreign_kinds.KINDS)
def test_modules_of_a_kind_are_fused_and_right(kind, monkeypatch):
    monkeypatch.setattr(foreign_rows, "SIZES", range(1, foreign_kinds.W + 2))
    for row in foreign_modules.small(f"^{kind} "):
        way = foreign_modules.way(row)
        assert (
            way == "fused"
            or (kind in foreign_kinds.IN_RUNS and way == "fused in runs")
            or (kind in foreign_kinds.IN_ANY_WAY and way != "refused")
        ), row
        assert "wrong_sizes" not in row and "error_sizes" not in row, row
        for name, error in row.items():
            if name.endswith("error"):  # above ROUNDED, rounding switched a ReLU: float64 decides
                assert error <= foreign_rows.ROUNDED or row[f"{name}_float64"] < 1e-9, row


def test_wrong_results_and_refusals_are_in_the_row(monkeypatch):
    loop, row = foreign_rows._loop, foreign_rows.Row("layer", lambda: torch.nn.Linear(3, 4), (3,))
    monkeypatch.setattr(
        foreign_rows, "_loop", lambda *args: {path: value * 1.25 for path, value in loop(*args).items()}
    )
    found = foreign_rows.compare(row)
    assert found["how"] == "fused" and found["class"] == "torch.nn.modules.linear.Linear"
    assert {value for name, value in found.items() if "error" in name} == {0.2}
    mixed = foreign_rows.Row("mixed", lambda: torch.nn.BatchNorm1d(3), (3,))
    assert foreign_rows.compare(mixed)["how"].startswith("refused: VoronoiRouter: ")


def test_wrong_and_refused_batch_sizes_are_in_the_row(monkeypatch):
    routed, wrong, refused = foreign_rows.Case.routed, (2, 3, 4, 7), 5

    def spoilt(case, router, first=None):
        if first == refused and router.fuse:
            raise ValueError("five")
        scale = 1.25 if first in wrong and router.way == "grouped" else 1.0
        return {path: value * scale for path, value in routed(case, router, first).items()}

    monkeypatch.setattr(foreign_rows.Case, "routed", spoilt)
    found = foreign_rows.compare(foreign_rows.Row("layer", lambda: torch.nn.Linear(3, 4), (3,)))
    assert found["wrong_sizes"] == {"grouped": "2-4, 7"}
    assert found["error_sizes"] == {"fused": {"sizes": "5", "first": "five"}}
    ways = foreign_modules.counts([found])
    assert ways["fused"] == ways["wrong"] == ways["errors"] == 1 and ways["refused"] == 0


def test_modules_without_fuse_say_how_they_run_otherwise():
    (attention,) = foreign_modules.small("^axes weights before columns")
    assert attention["how"].startswith("refused") == (attention.get("otherwise", "").startswith("cell by cell"))


def test_files_are_imported_without_what_they_lack(tmp_path):
    (tmp_path / "model.py").write_text(
        "import no_such_module.inner as inner\nimport tinycudann as tcnn\nfrom helper import width\n"
        "def network():\n    config = dict(n_neurons=width, n_hidden_layers=1, activation='ReLU')\n"
        "    return tcnn.Network(3, 2, {**config, 'output_activation': 'None'})\n"
    )
    (tmp_path / "helper.py").write_text("width = 5\n")
    path = list(sys.path)
    with foreign_imports.repository(tmp_path) as load:
        file = load("model")
        assert file.network()(torch.ones(4, 3)).shape == (4, 2) and file.inner.anything() is not None
        with pytest.raises(ModuleNotFoundError, match="no_such_file"):
            load("no_such_file")
    assert path == sys.path and not {"model", "helper", "no_such_module", "tinycudann"} & set(sys.modules)


def test_the_script_writes_rows_and_counts(tmp_path, capsys):
    foreign_modules.main(["--filter", "norms RMSNorm|tables embed", "--json", str(tmp_path / "rows.json")])
    result = json.loads((tmp_path / "rows.json").read_text())
    assert [row["module"] for row in result["results"]] == ["RMSNorm", "embedding"]
    ways = {name: result["metadata"][name] for name in ("modules", "fused", "fused in runs", "grouped", "wrong")}
    assert ways == {"modules": 2, "fused": 1, "fused in runs": 1, "grouped": 0, "wrong": 0}
    assert result["results"][1]["between"] == ["torch.nn.functional.embedding"]
    assert '"RMSNorm"' in capsys.readouterr().out


def test_ways_are_timed_beside_masks(monkeypatch):
    monkeypatch.setattr(foreign_rows, "TIMED_SIZES", (64,))
    monkeypatch.setattr(foreign_rows, "TIME_LIMIT", 1e-3)
    times = foreign_rows.speed(foreign_rows.Row("layer", lambda: torch.nn.Linear(3, 4), (3,)))
    assert list(times) == ["64"] and list(times["64"]) == ["masks_ms", *foreign_rows.TIMED]
    assert min(times["64"].values()) > 0


def test_the_result_has_every_row_of_the_table():
    stored = json.loads(RESULT.read_text())
    rows = [(key.split(":")[0], row.module) for key, rows in foreign_public.PUBLIC.items() for row in rows]
    names = [("/".join(path.split("/")[:2]), module) for path, module in rows]
    found = [(row["repository"].removeprefix("https://github.com/"), row["module"]) for row in stored["results"]]
    assert found == names
    assert foreign_modules.counts(stored["results"]).items() <= stored["metadata"].items()
