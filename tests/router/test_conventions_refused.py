"""What VoronoiRouter refuses: modules that mix samples, and calls that leave open where samples are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from convention_listed import RAYS, mip_field, nerfacc, uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter


@pytest.fixture
def centres() -> Tensor:
    return torch.rand(4, 3) * 2 - 1


class Mixes(nn.Module):
    """A linear layer, a step that brings samples together, and another layer."""

    def __init__(self, step: Callable[[Any, Tensor], Any], **parts: nn.Module) -> None:
        super().__init__()
        self.fc, self.out, self.step = nn.Linear(3, 4), nn.Linear(4, 4), [step]
        for name, part in parts.items():
            self.add_module(name, part)

    def forward(self, x: Tensor) -> Any:
        result = self.step[0](self, self.fc(x))
        return result if isinstance(result, tuple) else self.out(result)


def attention() -> nn.Module:
    return nn.MultiheadAttention(4, 1, batch_first=True)


def transformer() -> nn.Module:
    return nn.TransformerEncoderLayer(4, 2, 16, batch_first=True)


def slope(net: Any, h: Tensor) -> Tensor:
    return torch.autograd.grad(h.square().sum() / h.shape[0], h, create_graph=True)[0]


MIXING: list[tuple[Callable[..., Any], dict[str, Callable[[], nn.Module]]]] = [
    (lambda net, h: net.layer(h[None])[0], {"layer": transformer}),
    (lambda net, h: net.layer(h[None], h[None], h[None])[0][0], {"layer": attention}),
    (lambda net, h: torch.softmax(h @ net.out(h).t(), -1) @ h, {}),
    (lambda net, h: h - h.mean(0), {}),
    (lambda net, h: h + h.roll(1, 0), {}),
    (lambda net, h: h + h[:1], {}),
    (lambda net, h: h.cumsum(0), {}),
    (lambda net, h: h.flip(0), {}),
    (lambda net, h: torch.cat([h[1:], h[:1]]), {}),
    (lambda net, h: h / h.norm(), {}),
    (lambda net, h: h[torch.argsort(h[:, 0])], {}),
    (lambda net, h: h / h.abs().max().item(), {}),
    (lambda net, h: h * (1.0 if h.max() > 0.3 else -1.0) * float(h.sum()), {}),
    (slope, {}),
    (lambda net, h: (h, h.square().mean()), {}),  # a number for the whole batch
]
ALONG_RAYS: list[tuple[Callable[..., Any], dict[str, Callable[[], nn.Module]]]] = [
    (lambda net, h: net.layer(h.mT).mT, {"layer": lambda: nn.Conv1d(4, 4, 3, padding=1)}),
    (lambda net, h: h + net.layer(h, h, h)[0], {"layer": attention}),
    (lambda net, h: torch.cumsum(h, 1), {}),
]


@pytest.mark.filterwarnings("ignore:.*cell by cell")
@pytest.mark.parametrize("number", range(len(MIXING) + len(ALONG_RAYS)))
def test_modules_that_mix_samples_are_refused(number: int, centres: Tensor) -> None:
    """Each sample sees others of the batch; or those of its ray."""
    step, parts = [*MIXING, *ALONG_RAYS][number]
    module = Mixes(step, **{name: make() for name, make in parts.items()})
    with pytest.raises((ValueError, TypeError), match=r"(?s)VoronoiRouter.*sample"):
        VoronoiRouter(module, centres, coords="first3")(uniform((40,) if number < len(MIXING) else RAYS))


class Field(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.fc = nn.Linear(7, 4)

    def forward(self, x: Tensor, z: Tensor | None = None) -> Tensor:
        return self.fc(x if z is None else torch.cat([x, z.expand(*x.shape[:-1], -1)], -1))

    @property
    def width(self) -> int:
        return 7


X = torch.zeros(6, 7)

WRONG: dict[str, tuple[Callable[[Tensor], Any], type[Exception], str]] = {
    "no coords, integrated encoding": (
        lambda c: VoronoiRouter(mip_field(), c, per_ray=["view_direction"])(uniform(RAYS, 12), uniform((9,), 9)),
        ValueError,
        "coords=",
    ),
    "slice of four": (lambda c: VoronoiRouter(Field(), c, coords=slice(0, 4))(X), ValueError, "3"),
    "slice past the end": (lambda c: VoronoiRouter(Field(), c, coords=slice(6, 9))(X), ValueError, "3"),
    "callable that gives None": (
        lambda c: VoronoiRouter(Field(), c, coords=lambda x: None)(X),
        (TypeError, ValueError),
        "coords",
    ),
    "fewer positions than samples": (
        lambda c: VoronoiRouter(Field(), c)(X, coords=torch.zeros(5, 3)),
        ValueError,
        "[56]",
    ),
    "positions of integers": (
        lambda c: VoronoiRouter(Field(), c)(X, coords=torch.zeros(6, 3, dtype=torch.int64)),
        (TypeError, ValueError),
        "int64",
    ),
    "no modules": (lambda c: VoronoiRouter.from_modules([], c, coords="first3"), ValueError, "module"),
    "module without parameters": (
        lambda c: VoronoiRouter.from_modules([nn.Linear(7, 2), nn.Identity()], c[:2], coords="first3"),
        (ValueError, TypeError),
        "parameters",
    ),
}


@pytest.mark.parametrize(("call", "kind", "says"), WRONG.values(), ids=WRONG)
def test_wrong_use_says_what_is_wrong(call: Callable[[Tensor], Any], kind: Any, says: str, centres: Tensor) -> None:
    with pytest.raises(kind, match=says) as error:
        call(centres)
    text = str(error.value)
    assert "VoronoiRouter" in text or "VoronoiDiagram" in text or "backend" in text, text


def test_as_many_rays_as_samples_must_be_said(centres: Tensor) -> None:
    """[5, 5, 3] with [5, 3]: a row for each ray, or positions that broadcast over rays? Only the caller knows."""
    field = nerfacc.VanillaNeRFRadianceField(2, 8)
    x, condition = uniform((5, 5)), uniform((5,))
    told = VoronoiRouter(field, centres, coords="first3", per_ray=["condition"])
    torch.testing.assert_close(told(x, condition), field(x, condition))
    with pytest.raises(ValueError, match="per_ray"):
        VoronoiRouter(field, centres, coords="first3")(x, condition)


def test_rays_are_found_where_shapes_say_so(centres: Tensor) -> None:
    field = nerfacc.VanillaNeRFRadianceField(2, 8)
    x, condition = uniform(RAYS), uniform(RAYS[:1])
    router = VoronoiRouter(field, centres, coords="first3")
    torch.testing.assert_close(router(x, condition), field(x, condition))
    torch.testing.assert_close(router(x, condition=condition), field(x, condition))


def test_an_error_of_the_field_itself_is_shown(centres: Tensor) -> None:
    class Picky(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.fc = nn.Linear(3, 2)

        def forward(self, x: Tensor) -> Tensor:
            if x.shape[-1] != 3:
                raise KeyError(f"wants three features, not {x.shape[-1]}")
            return F.relu(self.fc(x))

    router = VoronoiRouter(Picky(), centres, coords="first3")
    with pytest.raises(KeyError, match="wants three features, not 7"):
        router(X)
