"""The table of fields: the names and the properties of the networks that can be trained.

A field is any ``nn.Module`` that maps positions [n, 3] and unit directions [n, 3] to a colour [n, 3] in 0..1 and a
density [n] >= 0 per scene unit. :func:`register_field` registers its class, or a function that returns a field. The
class may have these optional attributes:

    inputs                   "points" (the default), or "gaussians": positions are [n, 6], means and variances
    training_defaults        options whose training defaults differ from the defaults of the constructor
    learning_rate(**options) static method: Adam's initial learning rate; default ``LEARNING_RATE``
    router_options           further arguments of ``VoronoiRouter``, such as {"fuse": True} or {"share": ["encoder.*"]}
    sparse_parameters        name patterns of sparse tables: a training step reads few of their entries. Entries without
                             a gradient change only by the weight decay of tables; see ``voronerf.ops.adam``
    ray_growth               the maximum number of rays of a training step, as a multiple of ``--rays``; a step gets
                             more rays as more empty space is skipped. Default 1; more for a field whose samples are
                             cheap relative to the rest of a step
    lr_hold                  fraction of a training for which the learning rate stays constant; default 0
    scene_options(pixel, box, contracted, seconds)
                             static method: defaults of options. Its arguments are the width of a pixel at the middle
                             of the scene and the corners of the field's space, both in scene units, whether space is
                             contracted, and the training time in seconds
    octaves(finest)          static method: ``position_octaves`` for images that show ``finest`` octaves; default
                             ``finest``

The options of a field are the named parameters of its constructor. If ``forward`` has a parameter ``ray_index``, it
gets the directions [r, 3] of the rays, and as ``ray_index`` the row of each sample's direction.

A class may describe its computation by a method ``program()``, as :class:`voronerf.nerf.fields.NeRF` does by a layer
table (:func:`voronerf.router.layered_program`). A router then runs the program for all cells in one op and does not
call ``forward``. Any other module runs its own ``forward``, which ``router_options = {"fuse": True}`` traces to a
program. If a single program computes the whole field, this program is fused with colours, loss and gradients, whatever
the activations of the field are (:class:`voronerf.nerf.RayLoss`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, cast

from torch import nn

Inputs = Literal["points", "gaussians"]
Network = TypeVar("Network", bound=Callable[..., nn.Module])

#: Adam's initial learning rate for a field that defines none: the optimiser's default.
LEARNING_RATE = 1e-3


@dataclass(frozen=True)
class FieldType:
    """The entry of a field in the table.

    Attributes:
        name: The name of the field, the value of ``--field``.
        network: The class of the module, or a function that returns the module.
        inputs: "points" for positions [n, 3], or "gaussians" for means and variances [n, 6].
        options: The options and their defaults in training; ``inspect.Parameter.empty`` for a required option.

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
        """True if rays are cones, and the inputs of the field are Gaussians."""
        return self.inputs == "gaussians"

    @property
    def router_options(self) -> Mapping[str, Any]:
        """Further arguments of the router that holds the field."""
        return cast("Mapping[str, Any]", self._declared("router_options", {}))

    @property
    def sparse_parameters(self) -> Sequence[str]:
        """Name patterns of sparse tables: a training step reads few of their entries."""
        return cast("Sequence[str]", self._declared("sparse_parameters", ()))

    @property
    def ray_growth(self) -> float:
        """The maximum number of rays of a step if empty space is skipped, as a multiple of the first step's rays."""
        return float(self._declared("ray_growth", 1.0))

    @property
    def lr_hold(self) -> float:
        """The fraction of a training for which the learning rate stays constant before it falls."""
        return float(self._declared("lr_hold", 0.0))

    @property
    def scene_options(self) -> Callable[..., dict[str, Any]] | None:
        """The function that computes options from the scene; None if the field has none."""
        return cast("Callable[..., dict[str, Any]] | None", self._declared("scene_options", None))

    def learning_rate(self, options: Mapping[str, Any]) -> float:
        """Returns Adam's initial learning rate for a training with these options."""
        rule = self._declared("learning_rate", lambda **_: LEARNING_RATE)
        return float(rule(**{**self.options, **options}))

    def octaves(self, finest: int) -> int:
        """Returns the octaves of the position encoding for images that show ``finest`` octaves of detail."""
        return int(self._declared("octaves", lambda octaves: octaves)(finest))

    def build(self, options: Mapping[str, Any]) -> nn.Module:
        """Returns a field with these options, and with defaults for all other options.

        Raises:
            ValueError: A required option is missing, or the constructor rejects the options.
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
"""The fields that can be trained, by name."""


def register_field(name: str) -> Callable[[Network], Network]:
    """Returns a decorator that registers a field in ``FIELDS``; an existing entry of this name is replaced.

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

        After these lines, ``TrainConfig(field="tiny", width=32)`` trains the field, and so does
        ``voronerf.app.cli.main`` with ``--field tiny`` in the same program.

        >>> del FIELDS["tiny"]

    Raises:
        ValueError: The name is not a word, or the inputs are neither points nor Gaussians.
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
    """Returns a constructor's named parameters and defaults; ``**options`` adds the parameters of base classes."""
    if not isinstance(network, type):
        return _named_parameters(network)[0]
    options: dict[str, Any] = {}
    for base in network.__mro__:
        if base is nn.Module:
            break
        if "__init__" in vars(base):
            named, passes_on = _named_parameters(base.__init__)  # type: ignore[misc]
            options = {**named, **options}
            if not passes_on:
                break
    return options


def _named_parameters(function: Callable[..., Any]) -> tuple[dict[str, Any], bool]:
    """Returns the named parameters with their defaults, and whether the function takes ``**options``."""
    parameters = list(inspect.signature(function).parameters.values())
    by_name = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) and p.name != "self"]
    return {p.name: p.default for p in by_name}, any(p.kind is p.VAR_KEYWORD for p in parameters)
