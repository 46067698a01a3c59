"""Parses every command that a page, a help or a message prints, and runs the `voronerf` commands on a small run.

Commands are read from the pages' code blocks and inline code, and from the strings of the program. Words in capitals
are placeholders. Commands that install, build or measure are not run: the tests check that their targets exist.
"""

import ast
import itertools
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch
from cli_commands import TINY, words
from scene_files import write_blender

from voronerf.app.cli import main
from voronerf.app.cli.parsing import parse
from voronerf.app.cli.program import COMMANDS
from voronerf.app.render.paths import CameraPath, write_camera_path
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import ConfigError
from voronerf.nerf import orbit_cameras

ROOT = Path(__file__).resolve().parents[3]
#: All pages except the changelog, which names removed commands.
PAGES = [*(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "SECURITY")), *(ROOT / "docs").rglob("*.md")]
#: The first words of commands in pages.
PROGRAMS = ("voronerf", "python", "make", "pip", "ns-train", "tensorboard")
#: Programs of other projects.
FOREIGN = ("tensorboard", "ns-train")
#: Option values that make a command quick.
SHORT = {"--budget": "0.1", "--frames": "2", "--resolution": "8", "--count": "5"}
ADDED = {"train": ("--budget",), "render": ("--frames",), "export": ("--resolution", "--count")}
#: Replacements for placeholders and for large scenes.
STAND_INS = {
    "DIR": "scene",
    "DATA": "scene",
    "OUT": "scene",
    "RUN": "run",
    "JOINED": "made",
    "FILE": "path.json",
    "FILE.json": "path.json",
    "walk.mp4": "scene",  # test_one_command.py finds cameras
}
#: Commands that other tests run, with the files of these tests.
ELSEWHERE = {"process": "tests/app/scenes/test_process.py", "demo": "tests/app/cli"}


def of_page(path):
    """Yields the commands of a page in order, from lines of code and from inline code."""
    prose, fence = "", None
    for line in [*re.sub(r"\\\n *", "", path.read_text()).splitlines(), ""]:
        if line.startswith("```"):
            fence = line[3:] if fence is None else None
        elif fence is None and line.strip() and not line.startswith("    "):
            prose += line + " "
            continue
        inline, prose = re.findall("`([^`]+)`", prose), ""
        code = [line.strip()] if fence in (None, "bash") else []
        for text in inline + code:
            command = " ".join(re.split(" +# ", text)[0].split())
            if command.split(" ")[0] in PROGRAMS:
                yield command


def of_strings(path):
    """Yields the commands in the strings of a module; fields of f-strings become their names in capitals."""
    tree = ast.parse(path.read_text())
    parts = {id(value) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for value in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            text = "".join(
                part.value
                if isinstance(part, ast.Constant)
                else re.findall(r"\w+", ast.unparse(part.value))[-1].upper()
                for part in node.values
                if isinstance(part, ast.FormattedValue | ast.Constant)
            )
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            text = node.value
        else:
            continue
        for name, rest in re.findall(r"\bvoronerf ([a-z][a-z-]+)((?: (?:--[a-z-]+|[A-Z]+\b|[0-9.]+\b))*)", text):
            if name in COMMANDS:
                yield f"voronerf {name}{rest}"


COLLECTED = {str(page.relative_to(ROOT)): list(of_page(page)) for page in sorted(PAGES)}
MESSAGES = sorted({command for path in (ROOT / "voronerf").rglob("*.py") for command in of_strings(path)})
EVERY = sorted({command for found in (*COLLECTED.values(), MESSAGES) for command in found})


def arguments_of(command):
    """Returns the arguments of a `voronerf` command as a list of words, or None for another program."""
    parts = shlex.split(command.replace("...", ""), comments=True)
    return parts[1:] if parts[0] == "voronerf" else None


def test_there_are_commands_to_look_at():
    named = {parts[0] for command in EVERY if (parts := arguments_of(command)) and parts[0] in COMMANDS}
    assert named == set(COMMANDS) and len(EVERY) > 80


@pytest.mark.parametrize("command", EVERY)
def test_a_printed_command_is_one(command, capsys):
    arguments, (program, *rest) = arguments_of(command), shlex.split(command)
    if arguments is not None:
        (name, *others) = arguments or ["--help"]
        assert name in COMMANDS or name.startswith("--"), f"voronerf has no command {name}"
        if "--help" in others:
            others = []
        numbers = [re.sub("^(FLOAT|SECONDS|N|X)$", "1", word) for word in others]
        wants_run = name in COMMANDS and name not in ("train", "demo", "info")
        if name in COMMANDS and (numbers or not wants_run):  # a bare name only mentions the command
            try:
                parse(name, COMMANDS[name], numbers)
            except ConfigError as error:  # a message may name an option without its value
                assert command in MESSAGES and re.search(r" needs (a|\d+) value", str(error)), error
    elif program == "make":
        assert re.search(rf"^(?!.PHONY)([a-z-]+ )*{rest[0]}\b.*:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif program == "python":
        if rest[0] == "-c":
            compile(rest[1], "<command>", "exec")
        else:
            assert (ROOT / rest[0]).is_file() or (ROOT / rest[0] / "__main__.py").is_file()
    elif program == "pip":
        extras = {name for text in re.findall(r"\[([a-z,]+)\]", command) for name in text.split(",")}
        table = (ROOT / "pyproject.toml").read_text().partition("optional-dependencies]")[2]
        assert extras <= set(re.findall(r"^(\w+) = \[", table, re.MULTILINE))
    else:
        assert program in FOREIGN


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    """A folder with a scene, a trained run and a camera path."""
    folder = tmp_path_factory.mktemp("small")
    write_blender(folder / "scene", builtin_scene(32, train_views=6, test_views=2), 0.7)
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        assert main(words("train --data scene --out run", TINY.replace("--downscale 6", ""))) == 0
    frames = orbit_cameras(2, radius=3, elevation=10, width=16, height=16, focal=20)
    write_camera_path(folder / "path.json", CameraPath(frames, fps=5))
    return folder


def shortened(name, parts):
    """Returns a command with small option values and with its placeholders filled in."""
    parts = [STAND_INS.get(word, SHORT.get(before, word)) for before, word in zip(["", *parts], parts)]
    if "--help" in parts:
        return parts
    for option in ADDED.get(name, ()):
        parts += [] if option in parts else [option, SHORT[option]]
    if name == "train" and "--data" not in parts and "--resume" not in parts:
        parts += ["--data", "scene"]
    return parts


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [*(page for page, commands in COLLECTED.items() if any(map(arguments_of, commands))), "messages"]
)
def test_printed_commands_run(page, small_run, tmp_path, monkeypatch, capsys):
    """The commands of a page run in order in one folder, which starts as a copy of the small run's folder."""
    pytest.importorskip("trimesh", reason="trimesh is not installed")
    viser = pytest.importorskip("voronerf.app.viewer", reason="viser is not installed")
    monkeypatch.setattr(viser.Viewer, "serve", lambda viewer: None)  # the viewer would serve until Ctrl-C
    monkeypatch.chdir(tmp_path)
    shutil.copytree(small_run, tmp_path, dirs_exist_ok=True)
    for number, command in enumerate(MESSAGES if page == "messages" else COLLECTED[page]):
        name, *parts = arguments_of(command) or [""]
        if name not in COMMANDS or name in ELSEWHERE or (not parts and name != "info"):
            continue
        if "cuda" in parts and not torch.cuda.is_available():
            continue
        parts = shortened(name, parts)
        out = next((after for word, after in itertools.pairwise(parts) if word == "--out"), None)
        if out is not None and "--resume" not in parts:
            shutil.rmtree(out, ignore_errors=True)
        if out is None and name == "train":
            parts += ["--out", f"unnamed-{number}"]
        for word in parts:
            is_input = re.fullmatch("(runs|scenes)/[a-z]+", word) and (word != out or "--resume" in parts)
            if is_input and not Path(word).exists():
                shutil.copytree("scene" if word.startswith("scenes") else "run", word)
        capsys.readouterr()
        try:
            status = main([name, *parts])
        except SystemExit as stop:  # --help exits
            status = stop.code
        said = capsys.readouterr().err
        assert status == 0 or (command in MESSAGES and re.search(r" needs (a|\d+) value", said)), f"{command}: {said}"
        assert json.loads(Path("run/summary.json").read_text())["complete"]
