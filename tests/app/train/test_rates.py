"""What changes over a run: the learning rate and the rays of a step."""

import pytest
from tiny_runs import small, stopping

from voronerf.app.train.config import TrainConfig
from voronerf.app.train.rates import learning_rate, next_rays
from voronerf.app.train.trainer import Trainer


def test_a_long_run_warms_up_in_a_hundred_steps(tmp_path, scene):
    trainer = Trainer(small(tmp_path, steps=100_000, lr_final=1.0, lr=0.5), scene)
    for step, rate in ((0, 0.005), (50, 0.5 * 0.505), (100, 0.5), (2_000, 0.5)):
        trainer.step = step
        assert trainer.learning_rate() == pytest.approx(rate)


def test_the_learning_rate_of_hash_grids_stays_for_a_quarter():
    for field, rates in (
        ("hashgrid", (1, 0.01 ** (1 / 3), 0.01 ** (2 / 3), 0.01)),
        ("nerf", (0.1**0.5, 0.1, 0.1**1.5, 0.01)),
    ):
        config = TrainConfig(field=field, lr=0.5, lr_final=0.01)
        found = [learning_rate(config, done, 1_000) / 0.5 for done in (0.25, 0.5, 0.75, 1.0)]
        assert found == pytest.approx(rates)


def test_the_occupancy_grid_of_a_long_run_keeps_the_scene(tmp_path, scene):
    """A warm-up of thousands of steps keeps densities so low that the grid empties itself."""
    settings = {"field": "hashgrid", "width": None, "depth": None, "rays": 512, "samples": 32}
    config = small(tmp_path, steps=100_000, occupancy=True, occupancy_resolution=32, **settings)
    trainer = stopping(config, scene, 200)
    trainer.advance()
    assert trainer.occupancy.share > 0.05


def test_a_step_takes_more_rays_where_space_is_empty(tmp_path, scene):
    """A quarter of the samples of the first steps, 64 rays of 12, by at most four times the rays."""
    config = small(tmp_path, occupancy=True, occupancy_resolution=8, ray_growth=4, steps=12, cells=())
    trainer, rays = Trainer(config, scene), []
    for kept in (512, 128, 32, 0):
        trainer.occupancy.density.view(-1)[kept:] = trainer.occupancy.occupied.view(-1)[kept:] = 0
        trainer.train_step()
        rays.append(trainer.rays)
    assert rays[0] == 64 and 64 <= rays[1] < rays[2] <= 256 and rays[3] == 256


def test_steps_on_large_images_keep_more_samples():
    for samples, boxed, contracted in ((32, 0.25, 0.25), (64, 0.25, 0.25), (128, 0.5, 0.25), (256, 1.0, 0.5)):
        for contraction, share in (("none", boxed), ("sphere", contracted)):
            config = TrainConfig(rays=100, samples=samples, contraction=contraction)
            assert next_rays(config, 100, int(100 * samples * share / 2)) == 200
