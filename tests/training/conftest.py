from __future__ import annotations

import pytest

from voronerf.data import Scene, builtin_scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return builtin_scene(16)
