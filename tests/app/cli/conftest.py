import pytest
from cli_commands import words

from voronerf.app.cli import main


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory):
    """No test leaves the paths that it names to others, or to the user."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("VORONERF_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def fails(capsys):
    """Fails unless the command prints a single line that contains the message, and has an exit status."""

    def check(message, *parts):
        capsys.readouterr()
        assert main(words(*parts)) != 0
        text = capsys.readouterr().err
        assert text.startswith("voronerf: error: ") and text.count("\n") == 1 and message in text, text

    return check
