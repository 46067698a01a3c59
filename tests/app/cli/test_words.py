"""What is typed wrong: one plain line, with what was meant; help by groups; and the few words that are no command."""

import os
import re
import select
import signal
import subprocess
import sys

import pytest
from cli_commands import TINY, words

from voronerf import __version__
from voronerf.app.cli import main
from voronerf.app.cli.program import COMMANDS
from voronerf.app.files import read_json
from voronerf.app.train.config import TrainConfig


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("trian", "there is no command trian; did you mean train?"),
        ("xyzzy", "there is no command xyzzy; see voronerf --help"),
        ("train --field nerff", "got 'nerff'; did you mean nerf?"),
        ("train --sampling hierarchic", "got 'hierarchic'; did you mean hierarchical?"),
        ("train --backend nativ", "got 'nativ'; did you mean native?"),
        ("train --centres blanced", "got 'blanced'; did you mean balanced?"),
        ("train --bugdet 5", "Unrecognized options: --bugdet, 5; did you mean --budget?"),
        ("cut run --out y --spher 0 0 0 1", "did you mean --sphere?"),
        ("export run --coordinates file", "--coordinates must be scene or files, got 'file'; did you mean files?"),
        ("train --steps abc", "--steps must be a whole number, got 'abc'; see voronerf train --help"),
        ("train --steps 3.5", "--steps must be a whole number, got '3.5'"),
        ("train --steps 0", "--steps must lie in 1..2^53 - 1, got 0"),
        ("train --budget x", "--budget must be a number, got 'x'"),
        ("train --budget nan", "--budget must be a positive number of seconds, got nan"),
        ("train --cells 3 x", "--cells must be whole numbers, got '3 x'"),
        ("train --split-at 0.5 x", "--split-at must be numbers, got '0.5 x'"),
        ("cut run --out y --sphere 1 2 q 4", "--sphere must be 4 numbers, got '1 2 q 4'"),
        ("export run --crop 1 2 3", "--crop must be FLOAT FLOAT FLOAT FLOAT FLOAT FLOAT or saved, got '1 2 3'"),
        ("eval", "Missing from voronerf eval: RUN"),
        ("eval run more", "Unrecognized options: more"),
        ("train --out", "Missing value for argument '--out'"),
        ("train --resume --out /nowhere/at/all", "no run at /nowhere/at/all: there is nothing to resume"),
        ("eval /nowhere/at/all", "no run at /nowhere/at/all: there is no such folder"),
        ("join /nowhere/a /nowhere/b --out y", "no run at /nowhere/a: there is no such folder"),
        ("render /nowhere/a --path /nowhere/b.json", "error: /nowhere/b.json: No such file or directory"),
        ("place a b --out y --at 0 0 0 --scale -1", "--scale, --turn, --at: scale must lie in 1e-9..1e9, got -1.0"),
        ("compare /nowhere/a /nowhere/b", "no run at /nowhere/a: there is no such folder"),
    ],
)
def test_wrong_words_are_one_line(fails, command, said):
    fails(said, command)


@pytest.mark.parametrize("width", ["50", "200"])
def test_a_box_is_one_line_on_every_terminal(fails, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", width)
    fails("--steps must be a whole number, got 'abc'; see voronerf train --help", "train --steps abc")
    fails("Unrecognized options: --bugdet, 5; did you mean --budget?", "train --bugdet 5")


def test_the_version_and_the_list_of_commands(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"voronerf {__version__}\n"
    for given in ([], ["--help"], ["-h"]):
        assert main(given) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines if re.match("  [a-z]", line)] == list(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_whole(capsys, monkeypatch, command):
    """Every option with its text, no default of None, and no line that breaks where the code does."""
    monkeypatch.setenv("COLUMNS", "10000")
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    shown = capsys.readouterr().out
    assert stop.value.code == 0 and "None" not in shown and "(default: )" not in shown
    boxes = set(re.findall(r" (\w+) options ", shown))
    if command.startswith("train"):
        assert boxes >= {"scene", "run", "field", "cell", "sampling", "optimiser", "output"}
        assert "--data STR" in shown and "farthest camera at distance 1" in shown


def test_none_stands_for_the_default(tmp_path):
    assert main(words("train --out", tmp_path, TINY, "--max-cells None --samples 8 --lpips None")) == 0
    config = TrainConfig.from_values(read_json(tmp_path / "config.json"))
    assert config.max_cells is None and config.lpips is None and config.samples == (8,)


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_ctrl_c_while_the_program_is_loaded_leaves_no_traceback():
    code = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "  # it may be ignored here
        "sys.argv = ['voronerf', '--version']; from voronerf.app.cli import _prepare, main; {}"
    )
    stop = "_prepare(); os.kill(os.getpid(), signal.SIGINT)"
    main = "main(); print(signal.getsignal(2) is signal.default_int_handler)"
    loading, started = (
        subprocess.run([sys.executable, "-c", code.format(then)], capture_output=True, text=True)
        for then in (stop, main)
    )
    assert loading.returncode == -signal.SIGINT and loading.stderr == ""
    assert started.stdout == f"voronerf {__version__}\nTrue\n"


@pytest.mark.skipif(not hasattr(select, "poll"), reason="pipes cannot be asked here")
@pytest.mark.parametrize(
    ("command", "status", "buffered"),
    [("train --help", 141, ""), ("info", 141, ""), ("info", 141, "1"), ("xyzzy", 1, "1")],
)
def test_a_closed_pipe_ends_a_command_quietly(command, status, buffered):
    reading, writing = os.pipe()
    os.close(reading)
    given = {"stdout": writing, "stderr": subprocess.PIPE, "env": {**os.environ, "PYTHONUNBUFFERED": buffered}}
    done = subprocess.run([sys.executable, "-m", "voronerf", *command.split()], text=True, **given)
    os.close(writing)
    said = "voronerf: error: there is no command xyzzy; see voronerf --help\n"
    assert (done.returncode, done.stderr) == (status, said if status == 1 else "")
