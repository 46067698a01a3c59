"""Marching through a grid against stratified depths and a slow loop; all backends equal the reference bit for bit."""

from __future__ import annotations

import pytest
import torch
from op_cases import compared, need, refusals
from torch import Tensor

from voronerf.nerf import Contraction, Perspective
from voronerf.nerf.sampling import stratified_depths
from voronerf.ops import march_rays
from voronerf.ops.formulas import SPACINGS

SPHERE = Contraction(torch.tensor([0.1, -0.2, 0.3]), radius=0.7)
AXES = torch.linalg.qr(torch.tensor([[1.0, 0.2, 0.1], [-0.3, 1.0, 0.2], [0.1, -0.2, 1.0]])).Q
AHEAD = Perspective(torch.tensor([0.1, -0.2, -1.5]), AXES * AXES.diagonal().sign(), 0.4, (0.6, 0.5))

pytestmark = pytest.mark.op("march_rays")


def case(r, shape=(5, 4, 7), share=0.4):
    """Returns rays that start outside a box; some depth ranges begin or end inside the box, and some rays miss it."""
    directions = torch.nn.functional.normalize(0.4 * torch.randn(r, 3) + torch.tensor([0.0, 0.0, 1.0]), dim=-1)
    near = 0.2 + torch.rand(r)
    return {
        "origins": 0.6 * torch.rand(r, 3) - torch.tensor([0.3, 0.3, 1.6]),
        "directions": directions,
        "near": near,
        "far": near + 2.5 * torch.rand(r),
        "occupied": torch.rand(shape) < share,
        "box": torch.tensor([[-1.0, -0.8, -1.0], [1.0, 1.1, 0.9]]),
    }


def march(arguments, samples, device, backend, **options):
    moved = {name: value.to(device) if isinstance(value, Tensor) else value for name, value in options.items()}
    result = march_rays(*(tensor.to(device) for tensor in arguments.values()), samples, **moved, backend=backend)
    assert all(part.device.type == device.type for part in result)
    return type(result)(*(part.cpu() for part in result))


def same(actual, expected):
    for name, a, b in zip(actual._fields, actual, expected):
        assert a.dtype == b.dtype and torch.equal(a, b), name


def test_a_full_grid_gives_stratified_samples(device, backend):
    arguments = case(9) | {
        "occupied": torch.ones(3, 2, 4, dtype=torch.bool),
        "box": torch.tensor([[-9.0] * 3, [9.0] * 3]),
    }
    for spacing in SPACINGS:
        result = march(arguments, 33, device, backend, spacing=spacing)
        depths, deltas, _ = stratified_depths(arguments["near"], arguments["far"], 33, jitter=False, spacing=spacing)
        torch.testing.assert_close(result.depths.reshape(9, 33), depths)
        torch.testing.assert_close(result.deltas.reshape(9, 33), deltas)
        assert result.ray_offsets.tolist() == [33 * i for i in range(10)]
        assert result.ray_index.tolist() == [i // 33 for i in range(9 * 33)]
        assert result.stop.tolist() == [33] * 9
        ray = result.ray_index.long()
        places = arguments["origins"][ray] + result.depths[:, None] * arguments["directions"][ray]
        torch.testing.assert_close(result.positions, places)


@pytest.mark.parametrize("space", [None, SPHERE, AHEAD])
def test_samples_are_those_in_occupied_cells(device, backend, space):
    arguments, spacing = case(40), "disparity" if space else "linear"
    if space:
        arguments |= {"box": space.cube, "far": torch.full((40,), 6.0)}
    contract = space.points if space else lambda points: points
    result = march(arguments, 50, device, backend, spacing=spacing, contraction=space and space.numbers)
    depths, deltas, _ = stratified_depths(arguments["near"], arguments["far"], 50, jitter=False, spacing=spacing)
    world = arguments["origins"][:, None] + depths[..., None] * arguments["directions"][:, None]
    low, high = arguments["box"]
    place, sizes = (contract(world) - low) / (high - low), torch.tensor(arguments["occupied"].shape)
    cell = (place * sizes).long().clamp(min=0).minimum(sizes - 1).unbind(-1)
    kept = arguments["occupied"][cell] & ((place >= 0) & (place <= 1)).all(-1)
    assert 0 < len(result.depths) == int(kept.sum()) < 40 * 50
    assert result.ray_index.tolist() == kept.nonzero()[:, 0].tolist()
    torch.testing.assert_close(result.depths, depths[kept])
    torch.testing.assert_close(result.deltas, deltas[kept])
    torch.testing.assert_close(result.positions, contract(world[kept]))


@compared("march_rays")
@pytest.mark.parametrize(("r", "samples"), [(0, 4), (1, 1), (65, 31), (130, 32), (63, 65)])
@pytest.mark.parametrize(
    "rest", [{}, {"spacing": "disparity", "contraction": SPHERE.numbers}, {"contraction": AHEAD.numbers}]
)
def test_equals_the_reference_to_the_last_bit(device, backend, rest, r, samples):
    need("march_rays", backend, device, torch.float32)
    for shape in ((1, 1, 1), (16, 3, 33)):
        arguments = case(r, shape)
        for more in (
            {},
            {"uniforms": torch.rand(r, samples)},
            {"start": torch.randint(0, samples + 2, (r,), dtype=torch.int32)},
            {"max_samples": 3, "uniforms": torch.rand(r, samples)},
            {"max_samples": 9, "seed": torch.randint(-(2**31), 2**31, (1,), dtype=torch.int32)},
            {"capacity": 41},
            {"capacity": 5000, "max_samples": 2, "start": torch.randint(0, samples, (r,), dtype=torch.int32)},
        ):
            expected = march(arguments, samples, torch.device("cpu"), "reference", **rest, **more)
            same(march(arguments, samples, device, backend, **rest, **more), expected)


@compared("march_rays")
@pytest.mark.parametrize("rest", [{}, {"contraction": SPHERE.numbers}, {"contraction": AHEAD.numbers}])
@pytest.mark.parametrize("spacing", SPACINGS)
def test_many_rays_of_a_picture_equal_the_reference(device, backend, rest, spacing):
    need("march_rays", backend, device, torch.float32)
    rest = rest | {"spacing": spacing}
    for shape, share in (((24, 20, 28), 0.0), ((24, 20, 28), 0.002), ((24, 20, 28), 0.05), ((8, 33, 5), 0.5)):
        arguments = case(900, shape, share)
        arguments["far"][:40] = arguments["near"][:40] * (1 + 1e-5)  # very short strata
        arguments["far"][40:80] = 100.0  # long strata
        for more in (
            {},
            {"max_samples": 3},
            {"start": torch.randint(0, 70, (900,), dtype=torch.int32), "max_samples": 5},
        ):
            expected = march(arguments, 64, torch.device("cpu"), "reference", **rest, **more)
            same(march(arguments, 64, device, backend, **rest, **more), expected)


@compared("march_rays")
def test_leaps_far_from_the_origin_allow_for_the_rounding_of_positions(device, backend):
    """At 10,000 units float32 rounds positions to 1e-3 units, a hundredth of a cell and most of a stratum."""
    need("march_rays", backend, device, torch.float32)
    arguments = case(60, (24, 20, 28), 0.05)
    for name in ("origins", "box"):
        arguments[name] += 10_000
    expected = march(arguments, 2000, torch.device("cpu"), "reference")
    same(march(arguments, 2000, device, backend), expected)


def test_a_seed_stands_for_uniforms_of_its_own(device, backend):
    r, samples = 200, 40
    box = torch.tensor([[-99.0] * 3, [99.0] * 3])
    arguments = case(r) | {"occupied": torch.ones(1, 1, 1, dtype=torch.bool), "box": box}
    arguments["near"], arguments["far"] = torch.zeros(r), torch.full((r,), float(samples))  # strata of length 1
    drawn = []
    for seed in (7, 8, -(2**31)):
        result = march(arguments, samples, device, backend, seed=torch.tensor([seed], dtype=torch.int32))
        drawn.append(result.depths.reshape(r, samples) - torch.arange(samples))
    assert all(bool((part >= 0).all() and (part <= 1).all()) for part in drawn)
    near, other = drawn[0].flatten(), drawn[1].flatten()
    shares = torch.histc(near, 20, 0, 1) / len(near)
    torch.testing.assert_close(shares, torch.full((20,), 0.05), atol=0.012, rtol=0)
    neighbours = (near[:-1], near[1:]), (drawn[0][:-1].flatten(), drawn[0][1:].flatten()), (near, other)
    assert all(abs(float(torch.corrcoef(torch.stack(pair))[0, 1])) < 0.05 for pair in neighbours)


def test_waves_give_together_what_one_call_gives(device, backend):
    arguments, uniforms = case(30), torch.rand(30, 40)
    whole = march(arguments, 40, device, backend, uniforms=uniforms)
    for options in ({"max_samples": 1}, {"max_samples": 7}, {"capacity": 100}, {"capacity": 60, "max_samples": 4}):
        depths = [[] for _ in range(30)]
        start = torch.zeros(30, dtype=torch.int32)
        for _ in range(41):
            wave = march(arguments, 40, device, backend, uniforms=uniforms, start=start, **options)
            count = int(wave.ray_offsets[-1])
            assert not wave.depths[count:].any() and not wave.deltas[count:].any() and not wave.ray_index[count:].any()
            for ray, depth in zip(wave.ray_index[:count].tolist(), wave.depths[:count].tolist()):
                depths[ray].append(depth)
            start = wave.stop
            if bool((start == 40).all()):
                break
        assert start.tolist() == [40] * 30
        assert [depth for own in depths for depth in own] == whole.depths.tolist()


def test_rays_of_no_length_and_of_no_numbers_have_no_samples(device, backend):
    arguments = case(6) | {"occupied": torch.ones(2, 2, 2, dtype=torch.bool)}
    arguments["origins"][:] = 0
    arguments["near"][:], arguments["far"][:] = 0.1, 0.5
    arguments["far"][0] = arguments["near"][0]
    arguments["far"][1] = -1
    arguments["origins"][2, 1] = torch.nan
    arguments["directions"][3, 0] = torch.inf
    arguments["near"][4] = torch.nan
    result = march(arguments, 8, device, backend)
    assert result.ray_offsets[:6].tolist() == [0] * 6 and result.ray_offsets[6] > 0
    assert result.stop.tolist() == [8] * 6
    arguments["near"][:] = arguments["far"][:] = 0
    for samples in (8, 256):
        assert march(arguments, samples, device, backend).ray_offsets.tolist() == [0] * 7


def test_refuses_what_makes_no_sense():
    refuses = refusals(march_rays, **case(4), samples=8)
    refuses("occupied must have at least one cell, got [2, 0, 2]", occupied=torch.ones(2, 0, 2, dtype=torch.bool))
    refuses("samples must be at least 1, got 0", samples=0)
    seed = torch.zeros(1, dtype=torch.int32)
    refuses("seed must be None where uniforms are given, got both", uniforms=torch.zeros(4, 8), seed=seed)
    refuses("max_samples must be at least 1, got 0", max_samples=0)
    refuses("capacity must be at least 1, got 0", capacity=0)
    refuses("contraction must be a tensor, got str", contraction="sphere")
    refuses("contraction must have shape [4], got [3]", contraction=torch.zeros(3))
    refuses("contraction must have shape [5, 3], got [2, 3]", contraction=torch.zeros(2, 3))
