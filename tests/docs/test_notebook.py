"""Tests that the notebook of examples/ runs unchanged in its own kernel, and is committed with outputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
pytest.importorskip("ipykernel", reason="ipykernel is not installed")

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_the_notebook_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("VORONERF_NOTEBOOK_SECONDS", "1")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path))
    notebook = nbformat.read(ROOT / "examples" / "quickstart.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    check_outputs(notebook)


def test_the_notebook_is_committed_with_its_outputs() -> None:
    """The outputs are committed; `jupyter nbconvert --execute --inplace examples/quickstart.ipynb` renews them."""
    path = ROOT / "examples" / "quickstart.ipynb"
    text = path.read_text()
    assert len(text) < 400_000 and str(Path.home()) not in text and str(ROOT) not in text
    check_outputs(nbformat.read(path, as_version=4))


def check_outputs(notebook: Any) -> None:
    """Fails unless every cell ran without an error and showed its pictures."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
    assert all(output.output_type != "error" and output.get("name") != "stderr" for output in outputs)
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 2
    assert any("16 cells at" in output.get("text", "") for output in outputs)
