"""Draws docs/images/scaling.png and city_gain.png from scaling.json and city.json of benchmarks/results.

python docs/scripts/scaling.py
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).resolve().parents[2]


RESULTS, IMAGES = ROOT / "benchmarks" / "results", ROOT / "docs" / "images"


def main() -> None:
    """Draws both."""
    ranks()
    city()


def city() -> None:
    """What cells gain over one network as the city grows; each seed is a point."""
    rows = json.loads((RESULTS / "city.json").read_text())["results"]
    fields = list(dict.fromkeys(row["field"] for row in rows))
    figure, axes = plt.subplots(1, len(fields), figsize=(10, 3.4), layout="constrained", sharey=True)
    styles = {"16 balanced": "C0o-", "16 x 16 balanced": "C2s-", "16 regular": "C1^", "16 random": "C3v"}
    for axis, field in zip(axes, fields):
        for method, style in styles.items():
            for number, row in enumerate(row for row in rows if (row["field"], row["method"]) == (field, method)):
                found = sorted((int(name.split()[0]), entry["gain"]) for name, entry in row["cities"].items())
                label = None if number else f"{method} cells"
                axis.plot(*zip(*found), style, markersize=5, linewidth=1, alpha=1 - 0.4 * (number > 0), label=label)
        axis.axhline(0, color="grey", linewidth=0.8)
        axis.set(xscale="log", xlabel="blocks on a side of the city", title=field, xlim=(0.9, 9))
        axis.set_xticks([1, 2, 4, 8], ["1", "2", "4", "8"])
        axis.minorticks_off()
        axis.legend(fontsize=8, loc="lower right")
    axes[0].set(ylabel="PSNR over one network, dB")
    figure.savefig(IMAGES / "city_gain.png", dpi=110)


def ranks() -> None:
    """How uneven the work of ranks is, and how much of their time many of them would compute."""
    results = json.loads((RESULTS / "scaling.json").read_text())["results"]
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
    figure.savefig(IMAGES / "scaling.png", dpi=110)


if __name__ == "__main__":
    main()
