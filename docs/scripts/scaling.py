"""Draws docs/images/scaling.png from benchmarks/results/scaling.json.

python docs/scripts/scaling.py
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    """How uneven the work of ranks is, and how much of their time many of them would compute."""
    results = json.loads((ROOT / "benchmarks" / "results" / "scaling.json").read_text())["results"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for colour, diagram in zip(("C0", "C2", "C1", "C3"), ("transport", "published", "regular grid", "random")):
        for scene, style in (("lego", "-"), ("ship", "--")):
            rows = [row for row in results["imbalance"] if row["diagram"] == diagram and row["samples"] == scene]
            heaviest = [row["samples, dealt"] for row in rows]
            left.plot(
                [row["ranks"] for row in rows], heaviest, style, marker=".", color=colour, label=f"{diagram}, {scene}"
            )
    left.set(
        xscale="log", xlabel="ranks, four cells each", ylabel="samples of the heaviest rank / mean", title="measured"
    )
    left.set_xticks([2, 4, 8], ["2", "4", "8"], minor=False)
    left.minorticks_off()
    left.legend(fontsize=7)
    for link in sorted({row["link"] for row in results["extrapolated"]}):
        rows = [row for row in results["extrapolated"] if row["link"] == link]
        right.plot(
            [row["ranks"] for row in rows],
            [row["percent"] for row in rows],
            "--",
            marker=".",
            label=f"{link:g} GB/s a rank",
        )
    right.set(xscale="log", xlabel="ranks", ylabel="efficiency, %", ylim=(0, 100), title="modelled, not measured")
    right.legend(fontsize=8)
    figure.savefig(ROOT / "docs" / "images" / "scaling.png", dpi=110)


if __name__ == "__main__":
    main()
