"""Tests of merged partial sums of rays against one composite of all samples."""

import pytest
import torch
from helpers import seeded

from voronerf import composite
from voronerf.ops import compose_runs, render_loss, run_gradients, run_sums
from voronerf.ops import own_samples as keep_own
from voronerf.ops._core import backends
from voronerf.ops.formulas import along_rays, compose
from voronerf.ops.ray_runs.reference import own_samples, sum_runs


@pytest.mark.parametrize("ranks", [1, 3])
def test_partial_sums_are_one_composite(ranks):
    """Merged sums give the colours and gradients of `composite` in float64, however samples are spread over ranks."""
    generator, rays, samples = seeded(), 40, 9
    density = torch.rand(rays, samples, generator=generator, dtype=torch.float64) * 3
    density[0, 2], density[1], density[2, 4] = 1e9, 0, torch.inf
    colour = torch.rand(rays, samples, 3, generator=generator, dtype=torch.float64)
    depths = torch.rand(rays, samples, generator=generator, dtype=torch.float64).sort(-1)[0]
    deltas = torch.full_like(depths, 0.1)
    owner = torch.randint(ranks, (rays, samples), generator=generator)
    slopes, background = torch.rand(2, rays, 3, generator=generator, dtype=torch.float64)

    whole = density.clone().requires_grad_(), colour.clone().requires_grad_()
    expected = composite(whole[0], whole[1], depths, deltas, background=background)
    (expected.colour * slopes).sum().backward()

    parts = density.clone().requires_grad_(), colour.clone().requires_grad_()
    index = torch.arange(rays, dtype=torch.int32).repeat_interleave(samples)
    partial_sums = []
    for rank in range(ranks):
        mask = (owner == rank).reshape(-1)
        samples_of_rays = torch.zeros(rays * samples, 3), index, depths.reshape(-1), deltas.reshape(-1)
        numbers = torch.where(torch.arange(ranks) == rank, 0, -1)
        mine = own_samples(*samples_of_rays, owner.reshape(-1), numbers, curved=False)
        partial_sums.append(sum_runs(mine, parts[1].reshape(-1, 3)[mask], parts[0].reshape(-1)[mask]))
    ray, start = torch.cat([runs.ray for runs in partial_sums]), torch.cat([runs.start for runs in partial_sums])
    order = along_rays(ray, start)
    sums = [torch.cat([getattr(runs, name) for runs in partial_sums])[order] for name in ("colour", "optical")]
    seen = compose(*(part.detach() for part in sums), ray[order], rays)
    behind = seen.loss_behind(sums[0].detach(), ray[order], slopes, background)
    torch.autograd.backward(sums, (seen.front[:, None] * slopes[ray[order]], -behind))

    colour = seen.colour + seen.through[:, None] * background
    assert torch.allclose(colour, expected.colour, rtol=1e-12, atol=1e-14)
    assert torch.allclose(1 - seen.through, expected.opacity, rtol=1e-12, atol=1e-14)
    finite = density.isfinite()
    assert torch.allclose(parts[0].grad[finite], whole[0].grad[finite], rtol=1e-10, atol=1e-13)
    assert torch.allclose(parts[1].grad, whole[1].grad, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("backend", ["native", "reference"])
@pytest.mark.parametrize(("ranks", "robust"), [(1, 0.05), (3, 0.0), (3, 0.05)])
def test_partial_sums_are_one_loss(ranks, robust, backend):
    """Merged sums give the loss, gradients and weights of `render_loss`, also for long and empty rays."""
    reason = backends.why_not("run_sums", backend, torch.device("cpu"))
    if reason is not None:
        pytest.skip(reason)
    generator, counts = seeded(), torch.tensor([5, 0, 1, 300, 40, 0, 7])
    n, rays, options = int(counts.sum()), len(counts), {"backend": backend}
    index = torch.repeat_interleave(counts).int()
    offsets = torch.cat((torch.zeros(1, dtype=torch.int64), counts.cumsum(0))).int()
    raw = torch.randn(n, 4, generator=generator)
    raw[2, 3] = 1e9  # opaque
    depths, deltas = torch.arange(n) * 0.01 + 1, torch.full((n,), 0.01)
    target, background = torch.rand(2, rays, 3, generator=generator)
    cells = torch.randint(ranks, (n,), generator=generator).int()
    rest = {"density_scale": 2.0, "hidden": 1e-3}
    leaf = raw.clone().requires_grad_()
    expected = render_loss(leaf, deltas, offsets, target, background=background, robust=robust, **rest)
    expected.loss.backward()
    positions = torch.rand(n, 3, generator=generator)

    numbers_by_rank = [torch.where(torch.arange(ranks) == rank, 0, -1).int() for rank in range(ranks)]
    kept = [(cells == rank).nonzero()[:, 0] for rank in range(ranks)]
    samples = [keep_own(positions, index, depths, deltas, cells, numbers, **options) for numbers in numbers_by_rank]
    assert all(mine.positions.equal(positions[rows]) for mine, rows in zip(samples, kept, strict=True))
    sums = [
        run_sums(raw[rows], mine, density_scale=2.0, **options)[0] for mine, rows in zip(samples, kept, strict=True)
    ]
    shown = {"background": background, "first": 0, "rays": rays, "robust": robust}
    answers, loss = compose_runs(torch.cat(sums), target, **shown, **options)
    assert torch.allclose(loss, expected.loss, rtol=1e-6)
    for mine, rows, told in zip(samples, kept, answers.split(list(map(len, sums))), strict=True):
        gradient, weights = run_gradients(raw[rows], mine, told, **rest, **options)
        assert torch.allclose(gradient, leaf.grad[rows], rtol=1e-4, atol=1e-8)
        assert torch.allclose(weights, expected.weights[rows], rtol=1e-5, atol=1e-8)
        assert torch.allclose(
            told[:, 5], expected.error[mine.ray_index[mine.run_offsets[:-1].long()].long()], rtol=1e-5
        )
    with pytest.raises(ValueError, match="compose_runs: rays must be 1 to 7, got 0"):
        compose_runs(sums[0], target, **{**shown, "first": 1}, **options)


def test_a_gap_that_another_rank_may_fill_ends_a_run():
    depths, deltas = torch.tensor([0.1, 0.19, 0.5, 0.9]), torch.full((4,), 0.1)
    samples = torch.zeros(4, 3), torch.zeros(4, dtype=torch.int32), depths, deltas
    cells, numbers = torch.tensor([0, 1, 2, 2]), torch.arange(3)
    assert own_samples(*samples, cells, numbers, curved=False).run_offsets.tolist() == [0, 2, 4]
    assert own_samples(*samples, cells, numbers * 0 - 1, curved=False).run_offsets.tolist() == [0]


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_runs_of_a_ray_that_begin_alike_keep_their_order(backend):
    """If two opaque runs of a ray have the same start depth, the first one hides the second."""
    reason = backends.why_not("compose_runs", backend, torch.device("cpu"))
    if reason is not None:
        pytest.skip(reason)
    red, green = torch.eye(3)[:2]
    for first, second in ((red, green), (green, red)):
        rest = torch.tensor([50.0, 2.0, 0.0])  # optical depth, start depth, ray
        sums = torch.stack((torch.cat((first, rest)), torch.cat((second, rest))))
        answers, loss = compose_runs(sums, first[None], first=0, rays=1, backend=backend)
        assert float(loss) < 1e-12 and answers[:, 4].tolist() == [0, 50]
