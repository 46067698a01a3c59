import pytest

from voronerf.app.web import page


@pytest.fixture(autouse=True)
def small_turntables(monkeypatch):
    """Makes the 24 still pictures of an exported web page small, which saves time."""
    monkeypatch.setattr(page, "SIDE", 40)
