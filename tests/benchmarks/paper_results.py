"""What the tests of benchmarks/paper share: tiny settings and results without a training."""

TINY = {
    "scene": ("builtin",),
    "downscale": 20,
    "budget": 0.25,
    "seeds": 1,
    "rays": 48,
    "samples": 8,
    "evaluations": 2,
    "eval_views": 1,
    "final_views": 1,
    "turn": 0.1,
    "cells": 4,
}


def as_options(settings):
    """Settings as the command line takes them."""
    values = {key: value if isinstance(value, tuple) else (value,) for key, value in settings.items()}
    return [str(part) for key, value in values.items() for part in (f"--{key.replace('_', '-')}", *value)]


def synthetic(experiment, settings, score, scene="lego"):
    """Results of an experiment in which variant number i has a PSNR of score(i) and seams of 50 less that."""
    found = []
    for index, variant in enumerate(experiment.variants(settings, "builtin")):
        for seed in range(2):
            value = score(index) + 0.01 * seed
            looks = [
                {"look": n, "psnr": value, "seam": 50 - value, "step": 1, "seconds": 1.0} for n in ("after", "end")
            ]
            curve = [{"seconds": t, "psnr": value * t / 10} for t in (5.0, 10.0)]
            row = {"variant": variant.name, "scene": scene, "seed": seed, "psnr": value, "ssim": 0.5, "lpips": None}
            found.append({**row, "curve": curve, "looks": looks, "cells": 4, "width": 64, "steps": 10, "run": "none"})
    return found
