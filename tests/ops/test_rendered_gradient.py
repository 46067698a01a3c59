"""Tests of `rendered_gradient`, from rendered rays to network outputs, against autograd through a slow loop."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need, offsets_of
from tolerances import assert_as_exact

from voronerf.ops import composite, rendered_gradient
from voronerf.ops._core.recording import Recording
from voronerf.ops.formulas import activate

pytestmark = pytest.mark.op("rendered_gradient")

NAMES = ("colour", "opacity", "depth", "weights", "rgb", "density")
SCALED, ACTIVATED = {"density_scale": 2.5}, {"activated": True}


def case(counts, rule, names=NAMES, outside=(0, 0), backgrounds=()):
    """Returns samples of rays with ``counts`` samples each, samples of no ray, and the loss gradients ``names``."""
    r, m = len(counts), sum(counts) + sum(outside)
    raw = torch.rand(m, 4) if rule == ACTIVATED else torch.randn(m, 4)
    raw[:, 3] += 1
    arguments = {"raw": raw, "depths": 1 + torch.rand(m), "deltas": 0.3 * torch.rand(m)}
    arguments["ray_offsets"] = offsets_of(counts) + outside[0]
    if backgrounds:
        arguments["background"] = torch.rand(backgrounds)
    slopes = torch.randn(r, 3), torch.randn(r), torch.randn(r), torch.randn(m), torch.randn(m, 3), torch.randn(m)
    arguments |= {f"of_{name}": slope for name, slope in zip(NAMES, slopes) if name in names}
    return complete(arguments, rule)


def complete(arguments, rule):
    """Returns the arguments with densities and weights, which are computed from ``raw``."""
    rgb, density = activate(arguments["raw"], **rule)
    along = density, rgb, arguments["depths"], arguments["deltas"]
    weights = composite(*along, ray_offsets=arguments["ray_offsets"], backend="reference").weights
    return {**arguments, "density": density, "weights": weights}


def learnt(arguments, backend, device="cpu", dtype=torch.float32, **rule):
    """Returns the gradient that the op adds to a tensor of ones."""
    cast = {name: value.to(device, dtype if value.is_floating_point() else None) for name, value in arguments.items()}
    gradient = torch.ones_like(cast["raw"])
    rendered_gradient(gradient, **cast, **rule, backend=backend)
    return gradient.cpu() - 1


def slow(arguments, hidden=0.0, **rule):
    """Computes the gradient in float64, sample by sample."""
    arguments = {name: value.double() if value.is_floating_point() else value for name, value in arguments.items()}
    leaf = arguments["raw"].clone().requires_grad_()
    offsets, loss, none = arguments["ray_offsets"].tolist(), leaf.sum() * 0, torch.zeros(3)
    of = {name: arguments[f"of_{name}"] for name in NAMES if f"of_{name}" in arguments}
    for ray, (begin, end) in enumerate(pairwise(offsets)):
        light, depth, colour = leaf.new_ones(()), leaf.new_zeros(()), leaf.new_zeros(3)
        for i in range(begin, end):
            raw = leaf[i] if not hidden or float(light.detach()) > hidden else leaf[i].detach()
            rgb, density = (part[0] for part in activate(raw[None], **rule))
            through = torch.exp(-density * arguments["deltas"][i])
            weight, light = light * (1 - through), light * through
            colour, depth = colour + weight * rgb, depth + weight * arguments["depths"][i]
            own = {"weights": weight, "rgb": rgb, "density": density}
            loss = loss + sum((own[name] * of[name][i]).sum() for name in own if name in of)
        background = arguments.get("background", none)
        shown = colour + light * (background[ray] if background.dim() > 1 else background), 1 - light, depth
        loss = loss + sum((part * of[name][ray]).sum() for name, part in zip(NAMES, shown) if name in of)
    return torch.autograd.grad(loss, leaf)[0]


HIDDEN = {**SCALED, "hidden": 0.3}


@pytest.mark.parametrize(
    ("names", "rule"),
    [*(((name,), SCALED) for name in NAMES), ((), SCALED), *((NAMES, rule) for rule in (SCALED, ACTIVATED, HIDDEN))],
)
def test_equals_autograd_through_a_slow_loop(device, backend, names, rule):
    need("rendered_gradient", backend, device, torch.float32)
    activations = {name: value for name, value in rule.items() if name != "hidden"}
    for counts, outside, backgrounds in (((5, 0, 1, 20), (2, 3), (4, 3)), ((4, 9), (0, 0), (3,)), ((7,), (1, 0), ())):
        arguments = case(counts, activations, names, outside, backgrounds)
        exact, plain = slow(arguments, **rule), learnt(arguments, "reference", device, **rule)
        assert_as_exact(learnt(arguments, backend, device, **rule), plain, exact)
        if backend == "reference":
            torch.testing.assert_close(learnt(arguments, backend, device, torch.float64, **rule), exact)


@pytest.mark.parametrize(("counts", "m"), [((), 0), ((), 3), ((0, 0), 0), ((0, 0), 3)])
def test_rays_without_samples_change_nothing(device, backend, counts, m):
    need("rendered_gradient", backend, device, torch.float32)
    gradient = learnt(case(counts, ACTIVATED, outside=(m, 0)), backend, device, **ACTIVATED)
    assert gradient.shape == (m, 4) and not bool(gradient.any())


def test_infinite_density_and_what_is_not_a_number(device, backend):
    """Samples behind an infinite density only have the gradient ``of_density``. A NaN does not reach other rays."""
    need("rendered_gradient", backend, device, torch.float32)
    arguments = case((6, 6, 6), ACTIVATED, backgrounds=(3,))
    arguments["raw"][:6, 3] = torch.tensor([1.0, torch.inf, 2.0, torch.inf, 0.0, 1.0])
    arguments = complete(arguments, ACTIVATED)
    clean = learnt(arguments, backend, device, **ACTIVATED)
    exact = learnt(arguments, "reference", device, torch.float64, **ACTIVATED)
    torch.testing.assert_close(clean.double(), exact, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(clean[2:6, 3], arguments["of_density"][2:6], rtol=1e-5, atol=1e-5)
    arguments["raw"][8, 3] = torch.nan
    spoiled = learnt(complete(arguments, ACTIVATED), backend, device, **ACTIVATED)
    assert bool(spoiled[6:12].isnan().any())
    torch.testing.assert_close(spoiled[:6], clean[:6])
    torch.testing.assert_close(spoiled[12:], clean[12:])


def test_does_not_depend_on_the_number_of_threads():
    need("rendered_gradient", "native", torch.device("cpu"), torch.float32)
    arguments = case((7, 0, 9) * 200, SCALED, backgrounds=(3,))
    on_any_number_of_threads(lambda: [learnt(arguments, "native", **SCALED)])


def test_a_recording_reads_its_numbers_of_rows_again():
    need("rendered_gradient", "native", torch.device("cpu"), torch.float32)

    def batch(*counts):
        return {"gradient": torch.ones(sum(counts), 4), **case(counts, SCALED, backgrounds=(len(counts), 3))}

    first = batch(3, 0, 4)
    with Recording() as recording:
        taken = {name: recording.take(value) for name, value in first.items()}
        rendered_gradient(**taken, **SCALED, backend="native")
    assert recording.obstacle is None
    for counts in ((5, 2, 1, 3), (6,), (3, 0, 4)):
        arguments = batch(*counts)
        assert recording.replay(1, inputs=[*arguments.values()]) == 1
        rendered_gradient(**arguments, **SCALED, backend="native")
        assert torch.equal(recording.now(taken["gradient"]), arguments["gradient"])
