"""What changes over a run: the learning rate and the rays of a step."""

from __future__ import annotations

import math

from voronerf.app.train.config import TrainConfig

#: The most steps that the learning rate rises for. While it is small the densities stay low, and an occupancy grid,
#: which forgets in some thirty steps, would empty itself for good.
WARMUP_STEPS = 100
#: The fraction of the run that it rises for, at most.
WARMUP = 0.02
#: The share of a step's samples that are to be left once empty space is known, if more rays can bring them, and the
#: samples of a ray, in a box and in contracted space, beyond which it grows with them: these go with larger tables,
#: which larger steps keep cheap.
FILL, FILL_SAMPLES, CONTRACTED_FILL_SAMPLES = 0.25, 64, 128


def learning_rate(config: TrainConfig, done: float, step: int) -> float:
    """``lr`` until ``lr_hold`` of the fraction 0..1 that is done, then exponential decay to ``lr * lr_final``, after a
    linear rise over `WARMUP` of the run, `WARMUP_STEPS` at most."""
    assert config.lr is not None and config.lr_hold is not None
    rise = 1.0
    if done < WARMUP and step < WARMUP_STEPS:
        rise = 0.01 + 0.99 * max(done / WARMUP, step / WARMUP_STEPS)
    fallen = max(0.0, done - config.lr_hold) / (1 - config.lr_hold)
    return config.lr * rise * math.exp(math.log(config.lr_final) * fallen)


def next_rays(config: TrainConfig, rays: int, samples: int) -> int:
    """Rays of the next step, after one whose ``rays`` had so many samples in occupied space; see ``ray_growth``."""
    assert config.samples is not None and config.ray_growth is not None
    most = FILL_SAMPLES if config.contraction == "none" else CONTRACTED_FILL_SAMPLES
    share = FILL * max(config.samples / most, 1.0)
    wanted = rays * share * config.rays * config.samples / max(samples, 1)
    return int(min(max(wanted, config.rays), config.rays * config.ray_growth))
