"""Scenes computed from formulas, so that everything runs with no download."""

from voronerf.data.builtin.city import city_scene
from voronerf.data.builtin.opaque import builtin_scene
from voronerf.data.builtin.rich import rich_scene

__all__ = ["builtin_scene", "city_scene", "rich_scene"]
