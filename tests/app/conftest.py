import pytest

from voronerf.app.web import page


@pytest.fixture(autouse=True)
def small_turntables(monkeypatch):
    """Makes the still pictures of a page small, since a page has 24."""
    monkeypatch.setattr(page, "SIDE", 40)
