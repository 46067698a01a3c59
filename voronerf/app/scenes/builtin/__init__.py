"""Scenes computed from formulas, so that everything runs with no download."""

from voronerf.app.scenes.builtin.city import city_scene
from voronerf.app.scenes.builtin.plain import builtin_scene

__all__ = ["builtin_scene", "city_scene"]
