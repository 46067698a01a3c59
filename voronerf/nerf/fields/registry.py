"""The table of fields: the networks that can be trained by name, and their properties.

A field is any ``nn.Module`` that maps positions [n, 3] and unit directions [n, 3] to a colour [n, 3] in 0..1 and a
density [n] >= 0 per scene unit. Its class, or a function that makes it, is entered by :func:`register_field`. It may
have these attributes, all of which are optional:

    inputs                   "points" (the default), or "gaussians": positions are [n, 6], means and variances
    training_defaults        options that differ in training from the defaults of the constructor
    learning_rate(**options) static method: Adam's rate at the start of a training; default ``LEARNING_RATE``
    router_options           further arguments of ``VoronoiRouter``, such as {"fuse": True} or {"share": ["encoder.*"]}
    sparse_parameters        names of tables, as patterns, of which a step of training reads few entries. Their
                             entries without a gradient do not move, see ``voronerf.ops.adam``, but for the
                             weight decay that tables have
    ray_growth               the most rays of a training step, as a multiple of ``--rays``, where space is empty:
                             more than 1, the default, for a field whose samples cost little beside the rest of a step
    lr_hold                  fraction of a training for which the learning rate stays before it falls; default 0
    scene_options(pixel, box, contracted, seconds)
                             static method: options from the width of a pixel at the middle of the scene and the
                             corners of the space that the field sees, both in scene units, whether all of space was
                             contracted into it, and how long the training is; for those not given
    octaves(finest)          static method: position_octaves for images that show ``finest`` octaves; default all

Its options are the named parameters of its constructor. A ``forward`` with a parameter ``ray_index`` is called with
the directions [r, 3] of the rays, and with the row of them that belongs to each sample.

A class with a method ``program()`` says what it computes, as :class:`voronerf.nerf.fields.NeRF` does by a layer table
(:func:`voronerf.router.layered_program`): a router runs that for all cells in one operation and does not call
``forward``. Any other module runs its own ``forward``, which ``router_options = {"fuse": True}`` traces to a program.
Where all of a field is one operation, its colours, the loss and the gradients are part of it, whatever its activations
(:class:`voronerf.nerf.RayLoss`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, cast

from torch import nn

Inputs = Literal["points", "gaussians"]
Network = TypeVar("Network", bound=Callable[..., nn.Module])

#: Adam's learning rate at the start for a field without one: the optimiser's own default.
LEARNING_RATE = 1e-3


@dataclass(frozen=True)
class FieldType:
    """A row of the table.

    Attributes:
        name: The value of ``--field``.
        network: The class, or the function, that makes the module.
        inputs: "points", positions [n, 3], or "gaussians", means and variances [n, 6].
        options: Its options and their defaults in training; ``inspect.Parameter.empty`` for one that must be given.

    Examples:
        >>> from voronerf.nerf.fields import FIELDS
        >>> kind = FIELDS["mipnerf"]
        >>> kind.inputs, kind.cones, kind.options["width"]
        ('gaussians', True, 64)
        >>> kind.build({"width": 8, "depth": 2}).layers.out_features
        4
    """

    name: str
    network: Callable[..., nn.Module]
    inputs: Inputs
    options: Mapping[str, Any]

    def _declared(self, name: str, default: Any) -> Any:
        return getattr(self.network, name, default)

    @property
    def cones(self) -> bool:
        """Whether its rays are cones, which are cut into Gaussians."""
        return self.inputs == "gaussians"

    @property
    def router_options(self) -> Mapping[str, Any]:
        """Further arguments of the router around it."""
        return cast("Mapping[str, Any]", self._declared("router_options", {}))

    @property
    def sparse_parameters(self) -> Sequence[str]:
        """Names of tables, as patterns, of which a step of training reads few entries."""
        return cast("Sequence[str]", self._declared("sparse_parameters", ()))

    @property
    def ray_growth(self) -> float:
        """The most rays of a training step, as a multiple of those of the first, where empty space is skipped."""
        return float(self._declared("ray_growth", 1.0))

    @property
    def lr_hold(self) -> float:
        """Fraction of a training for which the learning rate stays before it falls."""
        return float(self._declared("lr_hold", 0.0))

    @property
    def scene_options(self) -> Callable[..., dict[str, Any]] | None:
        """The rule for options that come from the scene, if the field has one."""
        return cast("Callable[..., dict[str, Any]] | None", self._declared("scene_options", None))

    def learning_rate(self, options: Mapping[str, Any]) -> float:
        """Adam's rate at the start of a training with these options."""
        rule = self._declared("learning_rate", lambda **_: LEARNING_RATE)
        return float(rule(**{**self.options, **options}))

    def octaves(self, finest: int) -> int:
        """Octaves of the position's encoding for images that show ``finest`` octaves of detail."""
        return int(self._declared("octaves", lambda octaves: octaves)(finest))

    def build(self, options: Mapping[str, Any]) -> nn.Module:
        """A field with these options and the defaults of the others.

        Raises:
            ValueError: for an option without a value, and for what the constructor refuses.
        """
        arguments = {**getattr(self.network, "training_defaults", {}), **options}
        missing = [name for name, value in {**self.options, **arguments}.items() if value is inspect.Parameter.empty]
        if missing:
            raise ValueError(f"field {self.name}: {', '.join(missing)} must be given")
        try:
            return self.network(**arguments)
        except TypeError as error:
            raise ValueError(f"field {self.name}: {error}") from error


FIELDS: dict[str, FieldType] = {}
"""Every field that can be trained, by name."""


def register_field(name: str) -> Callable[[Network], Network]:
    """Enters a field into ``FIELDS``; a decorator. A name that is taken gets the new field.

    Examples:
        >>> import torch
        >>> from voronerf.nerf.fields import FIELDS, register_field
        >>> @register_field("tiny")
        ... class Tiny(torch.nn.Module):
        ...     def __init__(self, width: int = 16) -> None:
        ...         super().__init__()
        ...         self.layers = torch.nn.Sequential(
        ...             torch.nn.Linear(6, width), torch.nn.ReLU(), torch.nn.Linear(width, 4)
        ...         )
        ...
        ...     def forward(self, positions, directions):
        ...         out = self.layers(torch.cat([positions, directions], -1))
        ...         return torch.sigmoid(out[:, :3]), torch.nn.functional.softplus(out[:, 3])
        >>> FIELDS["tiny"].options
        {'width': 16}

        Now ``TrainConfig(field="tiny", width=32)`` trains it. So does ``voronerf.app.cli.main`` with ``--field tiny``,
        in a program that has run these lines.

        >>> del FIELDS["tiny"]

    Raises:
        ValueError: for a name that is not a word, or inputs that are neither points nor Gaussians.
    """
    if not name or not all(part.isalnum() for part in name.replace("_", "-").split("-")):
        raise ValueError(f"register_field: name must be a word, got {name!r}")

    def enter(network: Network) -> Network:
        inputs: Any = getattr(network, "inputs", "points")
        if inputs not in ("points", "gaussians"):
            raise ValueError(f"register_field: inputs of {name} must be 'points' or 'gaussians', got {inputs!r}")
        options = {**_options(network), **getattr(network, "training_defaults", {})}
        FIELDS[name] = FieldType(name, network, inputs, options)
        return network

    return enter


def _options(network: Callable[..., nn.Module]) -> dict[str, Any]:
    """Named parameters and their defaults; those of the base classes too where ``**options`` passes them on."""
    if not isinstance(network, type):
        return _named(network)[0]
    options: dict[str, Any] = {}
    for base in network.__mro__:
        if base is nn.Module:
            break
        if "__init__" in vars(base):
            named, passes_on = _named(base.__init__)  # type: ignore[misc]
            options = {**named, **options}
            if not passes_on:
                break
    return options


def _named(function: Callable[..., Any]) -> tuple[dict[str, Any], bool]:
    parameters = list(inspect.signature(function).parameters.values())
    by_name = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) and p.name != "self"]
    return {p.name: p.default for p in by_name}, any(p.kind is p.VAR_KEYWORD for p in parameters)
