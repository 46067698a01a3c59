import pytest
from cli_commands import words

from voronerf.app.cli import main


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory):
    """Gives the tests their own cache folder, so that no test's path gets into the user's cache."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("VORONERF_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def fails(capsys):
    """Returns a check that a command exits with an error status and one line that contains the message."""

    def check(message, *parts):
        capsys.readouterr()
        assert main(words(*parts)) != 0
        text = capsys.readouterr().err
        assert text.startswith("voronerf: error: ") and text.count("\n") == 1 and message in text, text

    return check
