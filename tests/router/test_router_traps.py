"""Common mistakes in the use of VoronoiRouter, and the messages about these mistakes."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from helpers import refuses
from router_loop import Built, masked_loop
from torch import Tensor, nn

from voronerf import NeRF, VoronoiDiagram
from voronerf.router import VoronoiRouter


def net(features: int = 3) -> nn.Module:
    return nn.Sequential(nn.Linear(features, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 4))


def router_of(module: nn.Module, generator: torch.Generator, k: int = 8, **options: Any) -> VoronoiRouter:
    return VoronoiRouter(
        module, torch.rand(k, 3, generator=generator), **{"coords": "first3", "way": "loop", **options}
    )


class Field(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.table = nn.Linear(3, 16), nn.Embedding(10, 16)
        self.head = nn.utils.parametrizations.weight_norm(nn.Linear(16, 2))
        self.register_buffer("scale", torch.ones(1))

    def forward(self, x: Tensor) -> Tensor:
        return self.head(self.encoder(x) + self.table((x[:, 0] * 9).long())) * self.scale


def test_apply_initialises_cell_by_cell(generator: torch.Generator) -> None:
    router = router_of(net(), generator, k=16)

    def init(module: nn.Module) -> None:
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.constant_(module.bias, 0.25)

    parameters = list(router.parameters())
    whole = nn.ModuleDict({"field": router})  # like a model that holds the router
    assert whole.apply(init) is whole
    assert all(a is b for a, b in zip(parameters, router.parameters(), strict=True))
    weight = router.module[2].weight
    assert weight.requires_grad
    bound = math.sqrt(6 / 128)
    assert weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.03)
    assert bound > weight.abs().max() > 0.99 * bound
    assert not torch.equal(weight[0], weight[1])
    assert bool((router.module[4].bias == 0.25).all())


def test_apply_with_shared_parameters_buffers_and_parametrizations(generator: torch.Generator) -> None:
    router = router_of(Field(), generator, share=["encoder.*"])

    def init(module: nn.Module) -> None:
        for parameter in module.parameters(recurse=False):
            nn.init.normal_(parameter)
        if isinstance(module, Field):
            module.scale.fill_(2.0)

    router.apply(init)
    assert router.module.encoder.weight.shape == (16, 3)
    assert router.module.scale.item() == 2.0
    assert not torch.equal(router.cell(0).table.weight, router.cell(1).table.weight)
    assert torch.equal(router.cell(0).encoder.weight, router.cell(1).encoder.weight)
    x = torch.rand(50, 3, generator=generator)
    torch.testing.assert_close(router(x), masked_loop(router, x)[0])

    def replace(module: nn.Module) -> None:
        if isinstance(module, nn.Embedding):
            module.weight = nn.Parameter(torch.zeros(3, 3))

    refuses("apply: fn must keep names and shapes of parameters, got another 'table", router.apply, replace)


def test_an_optimiser_that_was_made_before_wrapping_is_told(generator: torch.Generator) -> None:
    field, x = net(), torch.rand(20, 3, generator=generator)
    optimizer = torch.optim.Adam(field.parameters())
    router = router_of(field, generator)

    def step() -> None:
        router(x).sum().backward()
        optimizer.step()

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(64):  # no warning yet, since gradients may be accumulated
            step()
    rule = r"no optimizer has changed the parameters.*construct it from router.parameters\(\)"
    with pytest.warns(UserWarning, match=rule) as told:
        step()
    assert told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(65):  # no second warning
            step()


def test_a_fused_optimiser_with_the_state_of_other_cells_is_stopped(generator: torch.Generator) -> None:
    """A fused step would write beyond the end of the old state."""
    router, x = router_of(net(), generator, k=1), torch.rand(20, 3, generator=generator)
    old, other = torch.optim.Adam(router.parameters(), fused=True), torch.optim.Adam(net().parameters(), fused=True)
    router(x).sum().backward()
    old.step()
    router.subdivide(VoronoiDiagram(torch.rand(4, 3, generator=generator)), torch.zeros(4, dtype=torch.int64))
    assert not other._optimizer_step_pre_hooks
    router(x).sum().backward()
    with pytest.raises(ValueError, match=r"\(Adam\) holds the state of other cells.*subdivide\(..., optimizer="):
        old.step()
    new = torch.optim.Adam(router.parameters(), fused=True)
    new.step()
    new.step()


@pytest.mark.parametrize("given", [True, False])
def test_each_of_several_optimisers_is_stopped(given: bool, generator: torch.Generator) -> None:
    router, x = router_of(net(), generator, k=1), torch.rand(20, 3, generator=generator)
    first, *others = router.parameters()
    right, stale = torch.optim.SGD([first], 0.1, momentum=0.9), torch.optim.Adam(others)
    router(x).sum().backward()
    stale.step()
    parents, finer = torch.zeros(4, dtype=torch.int64), VoronoiDiagram(torch.rand(4, 3, generator=generator))
    router.subdivide(finer, parents, optimizer=right if given else None)
    router(x).sum().backward()
    right.step()
    with pytest.raises(ValueError, match=r"\(Adam\) holds the state of other cells"):
        stale.step()


def test_optimisers_that_train_something_are_not_told(generator: torch.Generator) -> None:
    fields, other, x = [net() for _ in range(3)], net(), torch.rand(20, 3, generator=generator)
    routers = [router_of(field, generator) for field in fields]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torch.optim.Adam(other.parameters()).step()
        right = torch.optim.Adam(routers[0].parameters())
        for _ in range(65):
            routers[0](x).sum().backward()
            right.step()
        both = torch.optim.Adam([*fields[1].parameters(), *routers[1].parameters()])
        routers[1](x).sum().backward()
        both.step()
        fields[2](x).sum().backward()  # trains the plain module of the third router
        torch.optim.SGD(fields[2].parameters(), 0.1).step()


@pytest.mark.parametrize(("prefix", "strict"), [("", True), ("module.", False)])
def test_a_plain_checkpoint_is_told_apart(prefix: str, strict: bool, generator: torch.Generator) -> None:
    router, plain = router_of(net(), generator), net()
    state = {prefix + name: value for name, value in plain.state_dict().items()}
    with pytest.raises(ValueError, match=r"of a plain Sequential, without cells.*router.load_cell\(i, module\)"):
        router.load_state_dict(state, strict=strict)
    whole = nn.ModuleDict({"field": router})
    with pytest.raises(ValueError, match="of a plain Sequential"):
        whole.load_state_dict({"field." + name: value for name, value in state.items()}, strict=strict)
    router.load_cell(3, plain)
    own = router.state_dict()
    router.load_state_dict(own)
    with pytest.raises(RuntimeError, match="Missing key"):
        router.load_state_dict({"other": torch.zeros(1)})


class Model(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer, self.bound, self.step = nn.Linear(3, 4), 2.0, 0
        self.register_buffer("box", torch.zeros(2, 3))

    def forward(self, x: Tensor) -> Tensor:
        return self.layer(x)

    density = forward

    def update_step(self, step: int) -> None:
        self.step = step

    @property
    def width(self) -> int:
        raise RuntimeError("is not to be run by a message")


def test_attributes_and_methods_of_the_module_are_pointed_to(generator: torch.Generator) -> None:
    router = router_of(Model(), generator, methods=["density"])
    rule = r"update_step of Model is not routed; pass methods=\['density', 'update_step'\]"
    with pytest.raises(AttributeError, match=rf"{rule}.* if it evaluates samples, else call router.mod"):
        router.update_step(3)
    router.module.update_step(3)
    for name in ("bound", "layer", "box", "width"):
        with pytest.raises(AttributeError, match=f"{name} of Model is router.module.{name}, whose"):
            getattr(router, name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        router.nothing  # noqa: B018
    assert not hasattr(router, "bound")


def made_inside(net: Any, x: Tensor) -> Tensor:
    last = nn.Linear(8, 4)
    if net.kept:
        net.last = last
    return last(net.layer(x))


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("fuse", [True, False])
def test_layers_that_are_made_inside_of_forward(kept: bool, fuse: bool, generator: torch.Generator) -> None:
    router = router_of(Built(made_inside, layer=(3, 8), kept=kept), generator, fuse=fuse, way="fused")
    with pytest.raises(TypeError, match="Built makes layers or draws numbers inside of its forward"):
        router(torch.rand(100, 3, generator=generator))


class RunningMean(nn.Linear):
    def __init__(self) -> None:
        super().__init__(3, 4)
        self.register_buffer("mean", torch.zeros(4))

    def forward(self, x: Tensor) -> Tensor:
        h = super().forward(x)
        self.mean.mul_(0.9).add_(0.1 * h.detach().mean(0))
        return h - self.mean


class Gaussian(nn.Linear):
    def forward(self, x: Tensor) -> Tensor:
        return torch.distributions.Normal(super().forward(x), 1.0, validate_args=True).log_prob(x[:, :2])


def test_refusals_name_a_written_buffer_and_a_distribution_that_checks(generator: torch.Generator) -> None:
    with pytest.raises(TypeError, match="RunningMean writes into its buffer 'mean'; write it outside of forward"):
        router_of(RunningMean(), generator, way="fused")(torch.rand(100, 3, generator=generator))
    with pytest.raises(ValueError, match="mixes or selects them; pass validate_args=False to the distribution"):
        router_of(Gaussian(3, 2), generator, fuse=True, way="fused")(torch.rand(100, 3, generator=generator))


class Forecast(nn.Module):
    """Two recurrent layers with dropout between them, or a packed sequence."""

    def __init__(self, packed: bool) -> None:
        super().__init__()
        self.layers, self.packed = nn.LSTM(3, 5, num_layers=2, dropout=0.5, batch_first=True), packed

    def forward(self, x: Tensor) -> Tensor:
        x = x.view(len(x), 2, 3)
        if self.packed:
            lengths = torch.full((len(x),), 2)
            x = nn.utils.rnn.pack_padded_sequence(x, lengths, batch_first=True)
        return self.layers(x)[1][0][-1]


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
@pytest.mark.parametrize("packed", [False, True])
def test_recurrent_layers_with_dropout_and_packed_sequences(packed: bool, generator: torch.Generator) -> None:
    router, x = router_of(Forecast(packed), generator, way="fused"), torch.rand(50, 6, generator=generator)
    assert not torch.equal(router(x), router(x)), "dropout"
    router.eval()
    expected = masked_loop(router, x)[0]
    torch.testing.assert_close(router(x), expected, rtol=1e-4, atol=1e-5)
    assert router.explain().split("\n")[-1].startswith("forward: cell by cell" if packed else "forward: grouped")
    if not packed:
        with pytest.raises(ValueError, match=r"torch\.lstm .*draws random numbers"):
            router_of(Forecast(False), generator, fuse=True, way="fused")(x)


class Scaled(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer, self.a = nn.Linear(3, 4), nn.Parameter(torch.ones(4))


def _function(module: Scaled) -> Any:
    return lambda x: module.layer(x)


KEPT: dict[str, tuple[Any, str]] = {
    "view": (lambda m: m.a[:2], "a view of the parameter `a`"),
    "data": (lambda m: m.a.data, "a view of the parameter `a`"),
    "list": (lambda m: [1, m.a[:2]], "a view of the parameter `a`"),
    "dict": (lambda m: {"x": (m.layer.weight.t(),)}, r"a view of the parameter `layer\.weight`"),
    "function": (_function, "a function that refers to the module"),
    "functions": (lambda m: [_function(m)], "a function that refers to the module"),
    "default": (lambda m: lambda x, layer=m.layer: layer(x), "a function that refers to the module|the part `layer`"),
    "method": (lambda m: (lambda old: lambda x: old(x))(m.layer.forward), "refers to the part `layer`"),
}


@pytest.mark.parametrize("case", KEPT)
def test_parameters_that_are_kept_past_their_names_are_refused(case: str, generator: torch.Generator) -> None:
    field, (make, said) = Scaled(), KEPT[case]
    field.kept = make(field)
    with pytest.raises(TypeError, match=rf"but a Scaled keeps in `kept` .*{said}"):
        router_of(field, generator)
    with pytest.raises(TypeError, match=r"but `1`, a Scaled, keeps in `kept` "):
        router_of(nn.Sequential(nn.ReLU(), field), generator)


def test_a_buffer_that_is_a_view_of_a_parameter_is_refused(generator: torch.Generator) -> None:
    field = Scaled()
    field.register_buffer("part_of_a", field.a.detach()[:2])
    refuses("keeps in `part_of_a` a view of the parameter `a`", router_of, field, generator, error=TypeError)


def test_what_a_copy_takes_along_is_not_refused(generator: torch.Generator) -> None:
    field = Scaled()
    field.method, field.copied, field.free = field.layer.forward, field.a.detach().clone(), lambda x: x + 1
    router_of(field, generator)


def encoding(x: Tensor, raw: bool, together: bool) -> Tensor:
    waves = [torch.stack([torch.sin(2.0**i * x), torch.cos(2.0**i * x)], -1 if together else -2) for i in range(4)]
    return torch.cat([x] * raw + [wave.flatten(-2) for wave in waves], -1)


@pytest.mark.parametrize("k", [1, 8])
@pytest.mark.parametrize("together", [True, False])
def test_an_encoding_without_position_is_told_once(k: int, together: bool, generator: torch.Generator) -> None:
    x = torch.rand(64, 16, 3, generator=generator)
    router = router_of(net(24), generator, k=k)
    with pytest.warns(UserWarning, match=r"'first3' takes sines and cosines.*coords=positions") as told:
        router(encoding(x, raw=False, together=together))
    assert told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        router(encoding(x, raw=False, together=together))
        router_of(net(24), generator, k=k)(encoding(x, raw=False, together=together), coords=x)
        router_of(net(27), generator, k=k)(encoding(x, raw=True, together=together))
        router_of(net(4), generator)(F.pad(x * torch.tensor([0.0, 1, 1]), (0, 1), value=1.0))


def test_directions_are_told(generator: torch.Generator) -> None:
    x = torch.rand(600, 3, generator=generator)
    d = F.normalize(x - 0.5, dim=1)
    for arguments in (d, torch.cat([d, x], 1)):
        with pytest.warns(UserWarning, match="'first3' takes unit vectors, such as directions"):
            router_of(net(arguments.shape[1]), generator)(arguments)


def test_centres_in_other_units_are_told_once(generator: torch.Generator) -> None:
    x = torch.rand(2000, 3, generator=generator)
    for options in ({}, {"fuse": True}):
        router = VoronoiRouter(net(), 100 * torch.rand(8, 3, generator=generator), coords="first3", **options)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            router(x[:100])  # too few samples for a warning
        with pytest.warns(UserWarning, match=r"2,000 of 2,000 samples are in one of 8.*from_points\(positions, 8\)"):
            router(x)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            router(x)


def test_centres_of_a_table_in_other_units_are_told_in_training(generator: torch.Generator) -> None:
    x, d = torch.rand(2000, 3, generator=generator), F.normalize(torch.rand(2000, 3, generator=generator), dim=1)
    router = VoronoiRouter(NeRF(width=16, depth=2), 100 * torch.rand(8, 3, generator=generator))
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("error")
        router(x, d)
    with pytest.warns(UserWarning, match=r"2,000 of 2,000 samples are in one of 8") as told:
        router(x, d)
    assert told[0].filename == __file__


def test_centres_that_fit_are_not_told(generator: torch.Generator) -> None:
    x = torch.rand(2000, 3, generator=generator)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        VoronoiRouter(net(), VoronoiDiagram.from_points(x, 8, generator=generator), coords="first3", way="loop")(x)
        router_of(net(), generator, k=1)(x)
        spread = router_of(net(), generator)
        spread(x)
        spread(x * 0 + 0.5)  # the first large batch has shown that the centres fit
