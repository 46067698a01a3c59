from __future__ import annotations

import pytest
import torch
from helpers import all_pairs
from op_cases import offsets_of
from tolerances import assert_as_exact

from voronerf.ops import RenderLoss, composite, render_loss

pytestmark = pytest.mark.op("render_loss")

SCALE = 10.0


def rays(counts, dtype=torch.float64, outside=(0, 0)):
    """Returns raw outputs, lengths and offsets of packed samples, and the targets and backgrounds of the rays."""
    m, r = sum(counts) + sum(outside), len(counts)
    raw, deltas = 3 * torch.randn(m, 4, dtype=dtype), torch.rand(m, dtype=dtype) / 10
    offsets = offsets_of(counts) + outside[0]
    return raw, deltas, offsets, torch.rand(r, 3, dtype=dtype), torch.rand(r, 3, dtype=dtype)


def step_by_step(raw, deltas, offsets, target, background, activated=False):
    """Computes activations (unless ``activated``), compositing and the loss in separate steps."""
    colour, density = raw[:, :3], raw[:, 3]
    if not activated:
        colour, density = torch.sigmoid(colour), SCALE * torch.nn.functional.softplus(density)
    seen = composite(density, colour, deltas, deltas, ray_offsets=offsets, background=background, backend="reference")
    off = (seen.colour - target).square()
    gradient = torch.autograd.grad(off.mean(), raw, retain_graph=True)[0] if raw.requires_grad else raw
    return RenderLoss(off.mean(), seen.colour, seen.weights, density, off.sum(-1), gradient)


def rule(activated):
    return {"activated": True} if activated else {"density_scale": SCALE}


def evaluate(device, arguments, dtype, backend, hidden=0.0, activated=False):
    """Returns all results, the gradient last."""
    raw, deltas, offsets, target, background = (t.to(device) for t in arguments)
    wide = torch.promote_types(dtype, torch.float32)
    rest = deltas.to(wide), offsets, target.to(wide)
    background = background.to(wide)
    if backend is None:
        result = step_by_step(raw.to(dtype).requires_grad_(), *rest, background, activated)
    else:
        options = {**rule(activated), "hidden": hidden, "backend": backend}
        result = render_loss(raw.to(dtype), *rest, background=background, **options)
    return [part.detach() for part in result]


COUNTS = [[0], [1], [3, 0, 17, 1, 0], [15], [16], [33], [127], [128], [129], [300, 0, 1000], [7] * 150]


@pytest.mark.parametrize(
    *all_pairs({"counts": COUNTS, "outside": [(0, 0), (3, 2)], "activated": [False, True]}), ids=repr
)
def test_is_activations_composite_and_squared_error(device, backend, counts, outside, activated):
    arguments = rays(counts, outside=outside)
    if activated:
        arguments[0][:, 3].mul_(SCALE).clamp_(min=-0.5)  # some densities are negative, which no activation returns
    of = {"activated": activated}
    exact = evaluate(device, arguments, torch.float64, None, **of)
    plain = evaluate(device, arguments, torch.float32, "reference", **of)
    for actual, same, right in zip(evaluate(device, arguments, torch.float32, backend, **of), plain, exact):
        assert_as_exact(actual, same, right)


@pytest.mark.parametrize("hidden", [0.0, 0.3])
def test_no_density_has_a_gradient_where_light_arrives(device, backend, hidden):
    """A density of 0, as from a ReLU, has weight 0, but its gradient is nonzero if light arrives."""
    raw = torch.tensor([[0.9, 0.5, 0.1, 0.0], [0.2, 0.2, 0.2, 20.0], [0.9, 0.5, 0.1, 0.0]], device=device)
    rest = torch.full((3,), 0.5, device=device), offsets_of([3]).to(device), torch.zeros(1, 3, device=device)
    result = render_loss(raw, *rest, activated=True, hidden=hidden, backend=backend)
    assert result.weights[[0, 2]].tolist() == [0, 0] and torch.equal(result.density, raw[:, 3])
    assert float(result.gradient[0, 3]) == pytest.approx(0.5 * 2 * 0.2 * (0.7 + 0.3 - 0.1) / 3, rel=1e-3)
    assert abs(float(result.gradient[2, 3])) < 1e-4 and (hidden == 0 or not result.gradient[2].any())


@pytest.mark.parametrize("scale", [0.02, 0.5])
def test_robust_loss_is_squared_for_small_errors_and_grows_linearly(device, backend, scale):
    """The loss equals Charbonnier's formula in float64, for rays on, near and far from the target."""
    raw, deltas, offsets, target, background = rays([40, 0, 3, 90])
    seen = step_by_step(raw, deltas, offsets, target, background).colour
    target = seen + torch.tensor([0.0, 1e-4, 0.1, 0.4], dtype=seen.dtype)[:, None]
    leaf = raw.clone().requires_grad_()
    error = step_by_step(leaf, deltas, offsets, target, background).colour.sub(target).square().sum(-1)
    exact = (2 * scale * ((error + scale**2).sqrt() - scale)).mean() / 3
    (expected,) = torch.autograd.grad(exact, leaf)
    arguments = [
        t.to(device, t.dtype if t.dtype == torch.int32 else torch.float32) for t in (raw, deltas, offsets, target)
    ]
    rule = {"background": background.float().to(device), "density_scale": SCALE, "robust": scale, "backend": backend}
    actual = render_loss(*arguments, **rule)
    torch.testing.assert_close(actual.loss.double().cpu(), exact.detach(), rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(actual.error.double().cpu(), error.detach(), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(actual.gradient.double().cpu(), expected, rtol=1e-3, atol=1e-7)
    assert float(actual.loss) < float(error.mean()) / 3


def test_backgrounds(device, backend):
    raw, deltas, offsets, target, _ = (t.to(device) for t in rays([4, 0, 9], torch.float32))
    rest = {"density_scale": SCALE, "backend": backend}
    one = torch.rand(3, device=device)
    shared = render_loss(raw, deltas, offsets, target, background=one, **rest)
    separate = render_loss(raw, deltas, offsets, target, background=one.expand(3, 3), **rest)
    assert all(torch.equal(a, b) for a, b in zip(shared, separate))
    assert torch.equal(shared.colour[1], one)
    black = render_loss(raw, deltas, offsets, target, **rest)
    assert torch.equal(black.colour[1], torch.zeros(3, device=device))


@pytest.mark.parametrize("counts", [[40, 0, 3, 90], [300]])
@pytest.mark.parametrize("activated", [False, True])
def test_what_little_light_reaches_has_no_gradient(device, backend, counts, activated):
    arguments = rays(counts, outside=(1, 2))
    if activated:
        arguments[0][:, 3] = SCALE * arguments[0][:, 3].abs()
    *plain, whole = evaluate(device, arguments, torch.float32, backend, activated=activated)
    *others, result = evaluate(device, arguments, torch.float32, backend, hidden=0.3, activated=activated)
    assert all(torch.equal(a, b) for a, b in zip(plain, others))
    light = plain[2] / -torch.expm1(-plain[3] * arguments[1].to(plain[3]))
    seen = (light > 0.3) & (torch.arange(len(light), device=light.device) > 0)
    assert 0 < int(seen.sum()) < len(light) - 3
    assert torch.equal(result, whole * seen[:, None])


def test_what_is_not_a_number_spoils_its_own_ray_alone(device, backend):
    raw, deltas, offsets, target, background = (t.to(device) for t in rays([4, 5, 3], torch.float32))
    spoiled = raw.clone()
    spoiled[6, 3] = torch.nan
    rest = {"background": background, "density_scale": SCALE, "backend": backend}
    clean = render_loss(raw, deltas, offsets, target, **rest)
    result = render_loss(spoiled, deltas, offsets, target, **rest)
    assert result.colour[1].isnan().all() and result.loss.isnan()
    for ray in (0, 2):
        assert torch.equal(result.colour[ray], clean.colour[ray])
    gradient = result.gradient
    assert gradient[7:9].isnan().all()  # the light that reaches the samples behind the NaN is unknown
    assert gradient[:4].isfinite().all() and gradient[9:].isfinite().all()


@pytest.mark.parametrize("counts", [[3, 0, 17, 1, 0, 40, 2], [300, 5, 200, 0, 1000], [0, 9, 0], [4] * 150])
@pytest.mark.parametrize("robust", [0.0, 0.05])
def test_unseen_rays_have_no_colour_to_learn(device, backend, counts, robust):
    """Loss, error and gradient of unseen rays are 0, even if their targets and colours are NaN."""
    raw, deltas, offsets, target, background = rays(counts, torch.float32, outside=(2, 3))
    r, triples = len(counts), (len(counts) + 1) // 4
    first, leaf = r - 3 * triples, raw.double().requires_grad_()
    whole = step_by_step(leaf, deltas.double(), offsets, target.double(), background.double())
    error = (whole.colour - target).square().sum(-1)[:first]
    exact = (2 * robust * ((error + robust**2).sqrt() - robust) if robust else error).sum() / (3 * r)
    exact.backward()
    rest = {"density_scale": SCALE, "robust": robust, "backend": backend}
    arguments = [tensor.to(device) for tensor in (deltas, offsets, target)]
    expected = render_loss(raw.to(device), *arguments, background=background.to(device), **rest)
    arguments[2][first:] = torch.nan
    values = raw.to(device)
    actual = render_loss(values, *arguments, background=background.to(device), triples=triples, **rest)
    torch.testing.assert_close(actual.loss.double().cpu(), exact.detach(), rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(actual.gradient.double().cpu(), leaf.grad, rtol=1e-3, atol=1e-6)
    begins = int(offsets[first])
    assert not actual.gradient[begins:].any() and not actual.error[first:].any()
    assert torch.equal(actual.error[:first], expected.error[:first])
    assert all(torch.equal(part, other) for part, other in zip(actual[1:4], expected[1:4]))
    values[begins:] = torch.nan
    other = render_loss(values, *arguments, background=background.to(device), triples=triples, **rest)
    assert torch.equal(other.loss, actual.loss) and torch.equal(other.gradient, actual.gradient)


@pytest.mark.parametrize("activated", [False, True])
def test_infinite_density_is_opaque_and_has_no_gradient(device, backend, activated):
    raw, deltas, offsets, target, background = (t.to(device) for t in rays([4], torch.float32))
    raw[1, 3] = torch.inf
    result = render_loss(raw, deltas, offsets, target, background=background, **rule(activated), backend=backend)
    assert result.weights[2:].tolist() == [0, 0]
    assert result.gradient.isfinite().all() and result.gradient[1:, 3].tolist() == [0, 0, 0]
