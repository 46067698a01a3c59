import functools

import pytest
from cli_commands import TINY, words

from voronerf.app.cli import main
from voronerf.app.scenes import builtin_scene


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory):
    """Gives the tests their own cache folder, so that no test's path gets into the user's cache."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("VORONERF_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True, scope="module")
def scenes_once():
    """Computes each built-in scene once for all commands of a file of tests, to save time."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("voronerf.app.scenes.builtin_scene", functools.cache(builtin_scene))
        yield


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory):
    """The folder of a run of a few steps, which a test copies before it changes the run."""
    out = tmp_path_factory.mktemp("runs") / "tiny"
    assert main(words("train --data builtin --out", out, TINY)) == 0
    return out


@pytest.fixture
def fails(capsys):
    """Returns a check that a command exits with an error status and one line that contains the message."""

    def check(message, *parts):
        capsys.readouterr()
        assert main(words(*parts)) != 0
        text = capsys.readouterr().err
        assert text.startswith("voronerf: error: ") and text.count("\n") == 1 and message in text, text

    return check
