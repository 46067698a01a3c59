"""What benchmarks/paper.py concludes: verdicts that follow the figures, and published figures beside their own rows."""

from dataclasses import replace

import pytest
from paper import claims, experiments, report, runs
from paper.balance import balance_verdict
from paper.experiments import EXPERIMENTS


@pytest.fixture
def settings(tmp_path):
    return runs.Settings(scene=("builtin",), downscale=20, cells=4, out=tmp_path)


def synthetic(experiment, settings, score, scene="lego"):
    """Results of an experiment in which variant number i has a PSNR of score(i) and seams of 50 less that."""
    found = []
    for index, variant in enumerate(experiment.variants(settings, "builtin")):
        for seed in range(2):
            value = score(index) + 0.01 * seed
            looks = [{"look": n, "psnr": value, "seam": 50 - value} for n in ("after", "end")]
            curve = [{"seconds": t, "psnr": value * t / 10} for t in (5.0, 10.0)]
            row = {"variant": variant.name, "scene": scene, "seed": seed, "psnr": value, "ssim": 0.5, "lpips": None}
            found.append({**row, "curve": curve, "looks": looks, "cells": 4, "width": 64, "steps": 10})
    return found


@pytest.mark.parametrize(
    ("gains", "wanted", "expected"),
    [
        ([], 0, "not measured"),
        ([0.2, 0.1], 0, "holds for every seed"),
        ([0.2], 0, "holds (one seed)"),
        ([0.5, -0.1], 0, "holds in the mean, not for every seed"),
        ([0.1, -0.5], 0, "does not hold"),
        ([0.0, 0.0], 0, "does not hold"),
        ([2.5, 2.1], 2, "holds for every seed"),
        ([2.5, 1.9], 2, "holds in the mean, not for every seed"),
        ([1.0, 0.5], 2, "the order holds for every seed, by less than 2"),
        ([1.0, -0.5], 2, "the order holds in the mean, by less than 2"),
        ([-1.0], 2, "does not hold (one seed)"),
    ],
)
def test_verdicts(gains, wanted, expected):
    assert claims.verdict(gains, wanted) == expected


def test_gains_pair_scenes_and_seeds():
    rows = claims.Rows(
        [{"variant": v, "scene": s, "seed": n, "psnr": p}
         for v, s, n, p in (("a", "x", 0, 5.0), ("a", "x", 1, 7.0), ("b", "x", 0, 4.0), ("b", "y", 1, 1.0))]
    )  # fmt: skip
    assert rows.gains("a", "b") == [1.0] and rows.gains("a", "b", "y") == [] and rows.mean("a") == 6.0
    assert rows.gains("a", "none") == [] and rows.scenes == ["x", "y"]
    unmeasured = claims.Rows([{"variant": v, "scene": "x", "seed": 0, "lpips": None} for v in "ab"])
    assert unmeasured.values("a", metric="lpips") == [] and unmeasured.gains("a", "b") == []


def test_a_lead_grows_or_does_not():
    def run(variant, seed, *curve):
        points = [{"seconds": t, "psnr": p} for t, p in curve]
        return {"variant": variant, "scene": "x", "seed": seed, "curve": points}

    def claim(*rows):
        return claims.growing_claim("", "", claims.Rows(rows), "a", "b", "x")

    for better, worse, verdict in (
        ([20, 24], [20, 22], "holds (one seed)"),
        ([22, 23], [20, 22.5], "does not hold (one seed)"),
        ([18, 21], [20, 22], "does not hold: there is no lead at the end"),
    ):
        assert claim(run("a", 0, *zip((5, 10), better)), run("b", 0, *zip((5, 10), worse))).verdict == verdict
    row = {"curve": [{"seconds": 2.0, "psnr": 1.0}, {"seconds": 4.0, "psnr": 3.0}]}
    assert [claims.at_share(row, share) for share in (0.25, 0.5, 0.75, 1)] == [None, 1.0, 2.0, 3.0]
    # seed 0 has a lead at the end alone; it is not set against the earlier lead of seed 1
    first = run("a", 0, (9, 30), (10, 30)), run("b", 0, (10, 20))
    found = claim(*first, run("a", 1, (5, 23), (10, 22)), run("b", 1, (5, 20), (10, 20)))
    assert found.verdict == "does not hold (one seed)" and found.here.endswith("+2.00 at 100 %")


@pytest.mark.parametrize(
    ("gains", "expected"),
    [
        ([], "not measured"),
        ([0.2, -0.1], "holds for every seed (within 0.2 dB)"),
        ([-0.2], "holds (one seed) (within 0.2 dB)"),
        ([1.0, -1.0], "in the mean only (within 0.2 dB)"),
        ([0.3, 0.0], "in the mean only (within 0.2 dB)"),
        ([1.0, 0.1], "does not hold (within 0.2 dB)"),
        ([-0.3], "does not hold (one seed) (within 0.2 dB)"),
    ],
)
def test_alike(gains, expected):
    assert claims.equal_claim("", "", gains, 0.2).verdict == expected


def test_claims_of_every_experiment_follow_the_figures(settings):
    judged = 0
    for name, experiment in EXPERIMENTS.items():
        rising = synthetic(experiment, settings, lambda i: 20 + 3 * i)
        falling = synthetic(experiment, settings, lambda i: 40 - 3 * i)
        verdicts = [[c.verdict for c in experiment.claims(claims.Rows(rows), settings)] for rows in (rising, falling)]
        assert len(verdicts[0]) == len(verdicts[1])
        assert all(a != b for a, b in zip(*verdicts) if "within" not in a), name
        judged += len(verdicts[0])
        alone = claims.Rows([row for row in rising if row["variant"] == rising[0]["variant"]])
        found = [claim.verdict for claim in experiment.claims(alone, settings)]
        assert found == ["not measured"] * len(verdicts[0]), name
    assert judged > 20


def test_limits_set_two_scenes_against_each_other_seed_by_seed(settings):
    experiment = EXPERIMENTS["limits"]

    def judged(hurt, helped, *without):
        rows = []
        for scene in ("translucent", "builtin"):
            scores = {experiments.NEVER: 30 - helped[scene], experiments.TOO_EARLY: 30 - hurt[scene]}
            for row in synthetic(experiment, settings, lambda i: 30.0, scene):
                row["psnr"] = scores.get(row["variant"], 30.0) * (1 + row["seed"])
                rows += [row] if (scene, row["seed"]) not in without else []
        return {claim.claim: claim for claim in experiment.claims(claims.Rows(rows), settings)}

    hurt, helped = {"translucent": 3.0, "builtin": 1.0}, {"translucent": 1.0, "builtin": 1.5}
    found = judged(hurt, helped)
    more, less = list(found)[-2:]
    assert "hurts more" in more and "help less" in less and len(found) == 4
    assert (found[more].here, found[more].verdict) == ("+3.00 dB (+2.00 to +4.00)", "holds for every seed")
    assert (found[less].here, found[less].verdict) == ("+0.75 dB (+0.50 to +1.00)", "holds for every seed")
    other = judged({"translucent": 1.0, "builtin": 3.0}, {"translucent": 2.0, "builtin": 1.5})
    assert other[more].verdict == other[less].verdict == "does not hold"
    # seed 1 of one scene is not set against seed 0 of the other
    part = judged(hurt, helped, ("builtin", 0))
    assert (part[more].here, part[less].here) == ("+4.00 dB", "+1.00 dB")
    none = ("builtin", 0), ("translucent", 1)
    apart = judged(hurt, helped, *none)
    assert apart[more].verdict == apart[less].verdict == "not measured"
    published = {claim.claim.split(":")[0]: claim.published for claim in list(found.values())[:2]}
    assert published == {"translucent": "in translucent scenes", "builtin, a control": "-"}


def test_seams_are_compared_at_the_looks_that_both_have():

    def row(variant, seed, **seams):
        looks = [{"look": name} | ({} if value is None else {"seam": value}) for name, value in seams.items()]
        return {"variant": variant, "scene": "x", "seed": seed, "looks": looks}

    def fewer(*rows):
        return list(claims.fewer_seams(claims.Rows(rows), "x", "a", "b", ("after", "late")))

    assert fewer(row("a", 0, after=0.4, late=0.2), row("b", 0, after=0.3, late=0.0)) == [pytest.approx(50)]
    assert fewer(row("a", 0, after=0.4, late=0.2), row("b", 0, after=None, late=0.1)) == [pytest.approx(50)]
    assert fewer(row("a", 0, after=0.4), row("b", 0, late=0.1)) == []
    two = fewer(*(row(v, s, late=seam) for v, s, seam in (("a", 0, 0.1), ("a", 1, 0.3), ("b", 0, 0.1), ("b", 1, 0.2))))
    assert two == [pytest.approx(0), pytest.approx(50)]
    assert fewer(row("a", 0, late=0.0), row("b", 0, late=0.0)) == []


@pytest.mark.parametrize(
    ("before", "after", "start"),
    [(0.2, 0.0017, "holds"), (0.5, 0.003, "the factor holds: 167"), (0.2, 0.02, "evener by a factor of 10"),
     (0.2, 0.3, "does not hold"), (0.001, 0.0015, "does not hold"), (0.001, 0.001, "does not hold")],
)  # fmt: skip
def test_balance_verdict(before, after, start):
    assert balance_verdict(before, after).startswith(start)


def test_published_figures_stand_beside_ours(settings):
    paper = replace(settings, cells=12)
    hierarchical = "27.355 / 0.9451 / 0.091", "31.234 / 0.9752 / 0.0417", "25.603 / 0.917 / 0.134", "27.401 / 0.945"
    kilo = "27.080 / 0.938 / 0.098", "27.765 / 0.952 / 0.078"
    for name, expected in (("sampling", hierarchical), ("kilonerf", kilo)):
        experiment = EXPERIMENTS[name]
        rows = synthetic(experiment, paper, lambda i: 20.0 + i)
        text = "\n".join(report.score_table(rows, experiment.published))
        assert "published: 400 x 400, 24 h, RTX 2080 Ti" in text
        assert all(figure in text for figure in expected)
        line = next(line for line in text.splitlines() if "16 x 16" in line or "NeRF, hierarchical: 12" in line)
        assert "20.00" not in line and " to " in line and line.count("|") == text.splitlines()[0].count("|")
        other = synthetic(experiment, paper, lambda i: 20.0 + i, "fern")
        elsewhere = report.score_table(other, experiment.published)
        assert "published" not in elsewhere[0] and not any("27.355" in line for line in elsewhere)
