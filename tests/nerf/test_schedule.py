"""Tests of a training's schedules: the learning rate, and the number of rays per step."""

import pytest

from voronerf.nerf.schedule import learning_rate, next_rays, relative_length


def test_a_long_run_warms_up_in_a_hundred_steps():
    for step, rate in ((0, 0.005), (50, 0.5 * 0.505), (100, 0.5), (2_000, 0.5)):
        assert learning_rate(0.5, 0.0, step) == pytest.approx(rate)


def test_the_learning_rate_holds_and_falls():
    for hold, rates in (
        (0.25, (1, 0.05 ** (1 / 3), 0.05 ** (2 / 3), 0.05)),
        (1.0, (1, 1, 1, 1)),
        (0.0, (0.05**0.25, 0.05**0.5, 0.05**0.75, 0.05)),
    ):
        result = [learning_rate(0.5, done, 1_000, hold=hold) / 0.5 for done in (0.25, 0.5, 0.75, 1.0)]
        assert result == pytest.approx(rates)


def test_steps_on_large_images_keep_more_samples():
    for samples, boxed, contracted in ((32, 0.25, 0.25), (64, 0.25, 0.25), (128, 0.5, 0.25), (256, 1.0, 0.5)):
        for inside, share in ((False, boxed), (True, contracted)):
            options = {"rays": 100, "samples": samples, "growth": 8, "contracted": inside}
            assert next_rays(100, int(100 * samples * share / 2), **options) == 200
            assert (next_rays(100, 0, **options), next_rays(100, 10**9, **options)) == (800, 100)


def test_the_length_of_a_training_is_known_or_estimated():
    assert [relative_length(0, 0.0, steps) for steps in (100, 3_500, 7_000, 10**6)] == [1, 1, 2, 8]
    assert [relative_length(step, 0.5) for step in (0, 400, 2_150, 3_900)] == [1, 1, 1, 2]
    assert relative_length(50, 0.0) == 1
