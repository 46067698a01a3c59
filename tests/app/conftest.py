import pytest

from voronerf.app.web import page


@pytest.fixture(autouse=True)
def small_turntables(monkeypatch):
    """The still of a page, which has 24 frames, is small."""
    monkeypatch.setattr(page, "SIDE", 40)
