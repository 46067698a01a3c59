"""Tests of benchmarks/many_cells.py: each training, with few or many cells, has a row."""

import many_cells
from helpers import read_json


def test_trainings_of_many_cells_are_measured(tmp_path, capsys):
    path, small = tmp_path / "many.json", '{"width": 8, "depth": 1, "position_octaves": 2}'
    sizes = ["--downscale", "5", "--rays", "64", "--samples", "16", "--views", "1", "--options", small]
    many_cells.main(["--data", "builtin", "--cells", "1", "300", "--seconds", "0.3", "--json", str(path), *sizes])
    assert "| 300 | " in capsys.readouterr().out
    result = read_json(path)
    assert result["metadata"]["benchmark"] == "many_cells" and result["metadata"]["rays"] == 64
    one, many = result["results"]
    assert (one["cells"], many["cells"]) == (1, 300) and many["parameters"] == 300 * one["parameters"]
    for each in (one, many):
        assert each["psnr"] > 5 and each["us_a_sample"] * each["samples"] > 900 * each["ms"] > 0
    assert one["placing_s"] == 0 < many["placing_s"]
