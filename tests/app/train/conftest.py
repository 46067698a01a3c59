import pytest

from voronerf.app.scenes import builtin_scene


@pytest.fixture(scope="session")
def scene():
    return builtin_scene(16)
