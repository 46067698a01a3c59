"""Tests of mistyped commands (one line with a suggestion), grouped help, and words that are not commands."""

import os
import re
import select
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from cli_commands import TINY, words

from voronerf import __version__
from voronerf.app.cli import main
from voronerf.app.cli.parsing import parse
from voronerf.app.cli.program import COMMANDS
from voronerf.app.files import read_json
from voronerf.app.train.config import TrainConfig


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("trian", "there is no command trian; did you mean train?"),
        ("xyzzy", "there is no command xyzzy; see voronerf --help"),
        ("train --field nerff", "got 'nerff'; did you mean nerf?"),
        ("train --centres blanced", "got 'blanced'; did you mean balanced?"),
        ("train --precision BF16", "got 'BF16'; did you mean bf16?"),
        ("help train", "there is no command help; did you mean voronerf --help?"),
        ("--steps 5", "there is no command --steps; did you mean voronerf train --steps 5?"),
        ("train --max_steps 5", "did you mean --steps?"),
        ("train --Out-Dir x", "did you mean --out?"),
        ("train --iterations 5", "did you mean --steps?"),
        ("train --input x", "did you mean --data?"),
        ("train --source-path x", "did you mean --data?"),
        ("train --cuda", "did you mean --device?"),
        ("train --gpu", "did you mean --device?"),
        ("train --zzz 5", "Unrecognized options: --zzz, 5; see voronerf train --help"),
        ("train --epochs 5", "did you mean --steps?"),
        ("train --model-path x", "did you mean --out?"),
        ("train --batch-size 9", "did you mean --rays?"),
        ("train -data x", "did you mean --data?"),
        ("train --hlep", "did you mean --help?"),
        ("eval --run", "see voronerf eval --help"),
        ("eval r --no-occupanc", "did you mean --no-occupancy?"),
        ("train --occupancy false", "Unrecognized options: false; see voronerf train --help"),
        ("train --data my own photos", "Unrecognized options: own, photos; see voronerf train --help"),
        ("process --out y clip.mp4", "SOURCE needs a value; see voronerf process --help"),
        ("info r s", "Unrecognized options: s; see voronerf info --help"),
        ("steps 5", "there is no command steps; see voronerf --help"),
        ("--data=x", "did you mean voronerf train --data=x?"),
        ("train --backend cuda:1", "native or warp, got 'cuda:1'; did you mean --device cuda:1?"),
        ("eval r --backend cpu", "got 'cpu'; did you mean --device cpu?"),
        ("eval r --backend nativ", "--backend must be auto, reference, native or warp, got 'nativ'; did you mean"),
        ("train --device gpu:1", "a GPU that is present, got 'gpu:1'; did you mean cuda:1?"),
        ("train --backend GPU", "got 'GPU'; did you mean --device cuda?"),
        ("train --device 0", "got '0'; did you mean cuda:0?"),
        ("train --device mps", "--device must be auto, cpu or cuda, got 'mps'"),
        ("train --data buildin", "buildin: there is no such folder; did you mean builtin?"),
        ("train --steps 3.5", "--steps must be a whole number, got '3.5'"),
        ("train --cells 3 x", "--cells must be whole numbers, got '3 x'"),
        ("train --split-at 0.5 x", "--split-at must be numbers, got '0.5 x'"),
        ("cut run --out y --sphere 1 2 q 4", "--sphere must be 4 numbers, got '1 2 q 4'"),
        ("export run --crop 1 2 3", "--crop must be 6 numbers or saved, got '1 2 3'; see voronerf export --help"),
        ("train --no-gpu", "--no-gpu; did you mean --device cpu?"),
        ("train --no-helpp", "did you mean --help?"),
        ("train --no-dat x", "did you mean --data?"),
        ("train --budget 90s", "did you mean --budget 90 (seconds)?"),
        ("train --budget 10m", "--budget must be a number, got '10m'; did you mean --budget 600 (seconds)?"),
        ("train --budget 10 min", "did you mean --budget 600 (seconds)?"),
        ("train --budget=1h30m", "did you mean --budget 5400 (seconds)?"),
        ("train --budget 1:30:00", "did you mean --budget 5400 (seconds)?"),
        ("train --budget 1,000", "did you mean --budget 1000 (seconds)?"),
        ("train --checkpoint_every 5m", "did you mean --checkpoint-every 300 (seconds)?"),
        ("train --steps 10min", "--steps must be a whole number, got '10min'; see voronerf train --help"),
        ("train --steps 1,000", "did you mean --steps 1000?"),
        ("train --steps 30.000", "--steps must be a whole number, got '30.000'; see voronerf train --help"),
        ("train --steps 3e4", "did you mean --steps 30000?"),
        ("train --rays 1.5k", "did you mean --rays 1500?"),
        ("render r --fps 23,976", "--fps must be a number, got '23,976'; see voronerf render --help"),
        ("train --lr 0,02", "did you mean --lr 0.02?"),
        ("train --cells 4x4", "got '4x4'; did you mean --cells 16 or, for levels, --cells 4 4?"),
        ("train --cells 4,4", "did you mean --cells 4 4?"),
        ("train --cells 1,000", "did you mean --cells 1000?"),
        ("train --samples 64,128", "got '64,128'; did you mean --samples 64 128?"),
        ("train --samples [64,128]", "did you mean --samples 64 128?"),
        ("cut run --out y --box -1,-1,-1,1,1,1", "did you mean --box -1 -1 -1 1 1 1?"),
        ("cut run --out y --box -1, -1, -1, 1, 1, 1", "did you mean --box -1 -1 -1 1 1 1?"),
        ("export run --crop 1,2,3", "--crop must be 6 numbers or saved, got '1,2,3'; see voronerf export --help"),
        ("place a b --out y --at \u22121 0 0.5", "did you mean --at -1 0 0.5?"),
        ("render run --size 1280,720", "got '1280,720'; did you mean 1280x720?"),
        ("render run --size 9000x9000", "got '9000x9000'\n"),
        ("train --data=~/x", "~ only at the start of a word without quotes; did you mean voronerf train --data ~/x?"),
        ("eval ~/x --views 1", "did you mean voronerf eval ~/x --views 1?"),
        ("render r --path ~/x --out=~/y.mp4", "did you mean voronerf render r --path ~/x --out ~/y.mp4?"),
        ("eval r --lpips=~/x", "no run at r"),  # the program itself expands this path
        ("train \u2013data x", "the dash of \u2013data is not a hyphen; did you mean voronerf train --data x?"),
        ("train \u2014steps=5 \u2014data x", "did you mean voronerf train --steps=5 --data x?"),
        ("train \u2013dta x", "did you mean --data?"),
        ("\u2013-version", "did you mean voronerf --version?"),
        ("\u2014data x", "did you mean voronerf train --data x?"),
        ("train --budget \u201c60\u201d", "quotes of \u201c60\u201d are not straight quotes; did you mean voronerf"),
        ("train --data \u201cmy photos\u201d", "did you mean voronerf train --data 'my photos'?"),
        ("train --data \u00abx\u00bb --steps 5", "did you mean voronerf train --data x --steps 5?"),
        ("train --data=\u201emy photos\u201c", "did you mean voronerf train '--data=my photos'?"),
        ("train --data Anna\u2019s", "Anna\u2019s: there is no such folder"),
        *((f"train --format {name}", "did you mean transforms?") for name in ("nerfstudio-data", "instant-ngp", "ngp")),
        ("train --format dnerf", "did you mean blender?"),
        ("train --format nerf_synthetic", "did you mean blender?"),
        ("train --data https://a.org/x.zip", "https://a.org/x.zip: is not a folder; download the scene, unpack it"),
        ("eval", "error: eval needs RUN; see voronerf eval --help"),
        ("cut run --box 0 0 0 1 1 1", "error: cut needs --out PATH; see voronerf cut --help"),
        ("eval run more", "Unrecognized options: more; did you mean --data or --lpips?"),
        ("train --out", "--out needs a value; see voronerf train --help"),
        ("cut run --box 1 2", "--box needs 6 values; see voronerf cut --help"),
        ("join /nowhere/a /nowhere/b --out y", "no run at /nowhere/a: there is no such folder"),
        ("render /nowhere/a --path /nowhere/b.json", "error: /nowhere/b.json: No such file or directory"),
    ],
)
def test_wrong_words_are_one_line(fails, command, said):
    fails(said, command)


@pytest.mark.parametrize(
    ("command", "meant"),
    [
        ("train R --steps 5", "train --data R --steps 5"),
        ("train --steps 5 'my photos'", "train --steps 5 --data 'my photos'"),
        ("train --data=R S", "train --data=R --out S"),
        ("train R --eval_views 3", "train --data R --eval_views 3"),
        ("demo y", "demo --out y"),
        ("eval R S --lpips x", "eval R --data S --lpips x"),
        ("eval --run R", "eval R"),
        ("eval --views 3 -run R", "eval --views 3 R"),
        ("export --run=R --mesh x.glb", "export R --mesh x.glb"),
        ("info --run R", "info R"),
        ("compare --runs R S", "compare R S"),
        ("join --run R --run S --out y", "join R S --out y"),
        ("process --source clip.mp4 --out y", "process clip.mp4 y"),
    ],
)
def test_a_command_that_was_meant_is_told_whole(fails, command, meant):
    fails(f"; did you mean voronerf {meant}?", *map(Path, shlex.split(command)))
    name, *rest = shlex.split(meant)
    assert callable(parse(name, COMMANDS[name], rest))  # the suggestion is a valid command


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("runs", "there is no checkpoint in it; did you mean runs/fox?"),
        ("runs/Fox", "there is no such folder; did you mean runs/fox?"),
        ("runs/fox/checkpoints", "there is no checkpoint in it; did you mean runs/fox?"),
        ("runs/fox/config.json", "it is a file; did you mean runs/fox?"),
        ("clip.mp4", "it is a file"),
    ],
)
def test_a_path_beside_a_run(fails, tmp_path, monkeypatch, path, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs/fox/checkpoints").mkdir(parents=True)
    for file in ("runs/fox/config.json", "clip.mp4"):
        (tmp_path / file).write_text("{}")
    fails(f"no run at {path}: {said}", "eval", path)
    fails("--out must be a folder, got the file clip.mp4", "train --data builtin:16 --steps 1 --out clip.mp4")


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("scans/x.zip", "is not a folder; unpack the archive first\n"),
        ("scans/x.tar.gz", "is not a folder; unpack the archive first\n"),
        ("scans/x.ply", "is not a folder; points, splats and meshes have no photographs to learn from\n"),
        ("scans/x.json", "is not a folder; only transforms.json and transforms_train.json name a scene\n"),
        ("scans/x.JPG", "is not a folder; a scene needs several pictures: voronerf process FOLDER DIR makes one\n"),
        ("scans/x y.mov", "must be a video in a supported container (mov,matroska,avi,mpegts,mpeg): moov atom not"),
        ("scans/x", "is not a folder\n"),
        ("fox/images/1.txt", "is not a folder; did you mean fox?\n"),
    ],
)
def test_a_file_that_is_no_scene(fails, tmp_path, monkeypatch, file, said):
    monkeypatch.chdir(tmp_path)
    for folder in ("fox/images", "scans"):
        (tmp_path / folder).mkdir(parents=True)
    for name in (file, "fox/transforms.json"):
        (tmp_path / name).touch()
    fails(f"{file}: {said}", "train --data", Path(file))


def test_characters_of_existing_files(fails, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("\u201cx\u201d", "~"):
        (tmp_path / name).mkdir()
        fails(f"{name}: is not a scene", "train --data", name)


def test_a_folder_of_settings(fails, tmp_path):
    fails(f"--config {tmp_path}: it is a folder\n", "train --config", tmp_path)
    (tmp_path / "config.json").touch()
    fails(f"it is a folder; did you mean {tmp_path / 'config.json'}?", f"train --config={tmp_path}")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"cels": [3]}', "unknown cels; did you mean cells?"),
        ('{"buget": 3, "stpes": 4, "zzz": 5}', "unknown buget, stpes, zzz; did you mean budget, steps?"),
        ('{"split-at": [0.5]}', "unknown split-at; did you mean split_at?"),
        ('{"max_num_iterations": 9}', "unknown max_num_iterations; did you mean steps?"),
        ('{"zzz": 9}', "settings: unknown zzz\n"),
        ('{"centres": "blanced"}', "got 'blanced'; did you mean balanced?"),
        ('{"field": "kilo_nerf"}', "got 'kilo_nerf'; did you mean kilonerf?"),
        ('{"backend": "cuda"}', "got 'cuda'; did you mean --device cuda?"),
    ],
)
def test_names_in_a_file_of_settings(fails, tmp_path, text, said):
    file = tmp_path / "settings.json"
    file.write_text(text)
    fails(said, "train --config", file)


@pytest.mark.parametrize("width", ["50", "200"])
def test_a_box_is_one_line_on_every_terminal(fails, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", width)
    fails("--steps must be a whole number, got 'abc'; see voronerf train --help", "train --steps abc")
    fails("Unrecognized options: --bugdet, 5; did you mean --budget?", "train --bugdet 5")
    fails(
        "error: place needs OBJECT-RUN, --out PATH and --at FLOAT FLOAT FLOAT; see voronerf place --help", "place run"
    )


def test_the_version_and_the_list_of_commands(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"voronerf {__version__}\n"
    for arguments in ([], ["--help"], ["-h"]):
        assert main(arguments) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines if re.match("  [a-z]", line)] == list(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_whole(capsys, monkeypatch, command):
    """The help describes every option, shows no default of None, and joins the lines of a docstring's paragraph."""
    monkeypatch.setenv("COLUMNS", "10000")
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    shown = capsys.readouterr().out
    assert stop.value.code == 0 and "None" not in shown and "(default: )" not in shown
    boxes = set(re.findall(r" (\w+) options ", shown))
    if command.startswith("train"):
        assert boxes >= {"scene", "run", "field", "cell", "sampling", "optimiser", "output"}
        assert all(text in shown for text in ("--data STR", "farthest camera at distance 1", "seconds"))


def test_none_stands_for_the_default(tmp_path):
    assert main(words("train --out", tmp_path, TINY, "--max-cells None --samples 8 --lpips None")) == 0
    config = TrainConfig.from_values(read_json(tmp_path / "config.json"))
    assert config.max_cells is None and config.lpips is None and config.samples == (8,)


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_ctrl_c_while_the_program_is_loaded_leaves_no_traceback():
    code = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "  # the parent may ignore it
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


#: Runs three commands in children of one process that has loaded the program; each child ends as Python does.
CLOSED_PIPE = """
import io, os, sys
from voronerf.app.cli import _prepare, main
_prepare()
import voronerf.app.cli.program
for command, buffered in (("info", True), ("info", False), ("xyzzy", False)):
    if not os.fork():
        sys.stdout = sys.stdout if buffered else io.TextIOWrapper(open(1, "wb", 0), write_through=True)
        sys.exit(main([command]))
    print(command, os.waitstatus_to_exitcode(os.wait()[1]), file=sys.stderr, flush=True)
"""


@pytest.mark.skipif(not hasattr(select, "poll"), reason="pipes cannot be asked here")
def test_a_closed_pipe_ends_a_command_quietly():
    reading, writing = os.pipe()
    os.close(reading)
    options = {"stdout": writing, "stderr": subprocess.PIPE, "env": {**os.environ, "PYTHONUNBUFFERED": ""}}
    done = subprocess.run([sys.executable, "-c", CLOSED_PIPE], text=True, **options)
    os.close(writing)
    said = "voronerf: error: there is no command xyzzy; see voronerf --help"
    assert done.stderr.splitlines() == ["info 141", "info 141", said, "xyzzy 1"]
