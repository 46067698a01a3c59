"""Attacks on training: interruptions at any moment, full disks, little memory, and absurd settings."""

from __future__ import annotations

import dataclasses
import faulthandler
import os
import random
import resource
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_type_hints

import torch
from attempts import REFUSED, RIGHT, Failed, fork_command
from commands import judged, run
from hostile import NUMBERS, TEXTS
from input_files import FIELDS, TINY

from voronerf.app.files import read_json_lines
from voronerf.app.train.checkpoint import checkpoint_path, checkpoint_paths, last_checkpoint
from voronerf.app.train.config import CHOICES, TrainConfig

#: Options for the networks of interrupted trainings.
VARIANTS = (
    *FIELDS.values(),
    ["--field", "mipnerf", "--no-occupancy"],
    [*FIELDS["nerf"], "--sampling", "hierarchical", "--samples", "8", "6"],
    [*FIELDS["nerf"], "--assignment", "stochastic"],
    [*FIELDS["nerf"], "--cells", "2", "2", "--split-at", "0.3", "0.6", "--init", "random"],
)
#: Signals that end a training; None stands for a full disk.
SIGNALS = (*[signal.SIGKILL] * 6, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGINT, None)
#: The number of interruptions of a training.
KILLS = 5


def killed_training(rng: random.Random, folder: Path, inputs: Path) -> Counter[str]:
    """Kills and resumes a training at random moments; its result must equal an undisturbed training bit for bit."""
    os.chdir(inputs)
    options = [*("--data", "blender"), *TINY, *rng.choice(VARIANTS)]
    options += ["--steps", str(rng.choice((30, 60))), "--checkpoint-every", rng.choice(("1e-9", "0.02", "0.1"))]
    whole, part = folder / "whole", folder / "part"
    began = time.monotonic()
    _ends_well(_train(whole, options))
    length = time.monotonic() - began
    for _ in range(KILLS):
        number = rng.choice(SIGNALS)
        if number is None:  # simulates a full disk by a limit of file sizes
            pid = _train(part, options, rng.randrange(1, 200_000))
        else:
            pid = _train(part, options)
            time.sleep(rng.uniform(0, length))
            os.kill(pid, number)
        _ends(pid, number)
    _ends_well(_train(part, options))
    same_runs(whole, part)
    return Counter({RIGHT: KILLS})


def _train(out: Path, options: list[str], file_size: int | None = None) -> int:
    """Forks a process that begins or resumes a training, with a limit of file sizes; returns its id."""

    def begin() -> int:
        if file_size is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))
        status, _, err = run("train", "--out", out, *(["--resume"] if checkpoint_paths(out) else []), *options)
        if status == 1:  # a full disk must be reported with the file's name
            return 1 if "File too large" in err and str(out) in err and err.startswith("voronerf: ") else 70
        return status

    return fork_command(begin)


def _ends(pid: int, number: int | None) -> None:
    """Waits for a training and checks its status; ``number`` is the signal that was sent."""
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    # A signal before the start of the training has its default effect.
    allowed = (0, 1) if number is None else (0, -number) if number == signal.SIGKILL else (0, 130, -number)
    if status not in allowed:
        raise Failed(f"a training that got {number or 'a full disk'} ended with status {status}")


def _ends_well(pid: int) -> None:
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if status != 0:
        raise Failed(f"a training that was left alone ended with status {status}")


def same_runs(whole: Path, part: Path) -> None:
    """Compares the last checkpoints and the scores of two runs."""
    first, second = last_checkpoint(whole), last_checkpoint(part)
    for name in sorted(first.tensors.keys() | second.tensors.keys()):
        a, b = first.tensors.get(name), second.tensors.get(name)
        if a is None or b is None or not torch.equal(a.nan_to_num(), b.nan_to_num()):
            raise Failed(f"{name} differs after a resume")
    for key in ("step", "skipped"):
        if first.values[key] != second.values[key]:
            raise Failed(f"{key} differs after a resume: {first.values[key]} and {second.values[key]}")
    scores = [[(line["step"], line["psnr"]) for line in read_json_lines(at / "metrics.jsonl")] for at in (whole, part)]
    if scores[0] != scores[1]:
        raise Failed(f"scores differ after a resume: {scores}")
    left = [path for path in part.rglob("*") if path.name.endswith(".partial")]
    if left:
        raise Failed(f"{left} were left behind")


def stressed_command(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Runs a command with absurd settings, little memory, or an unwritable folder."""
    os.chdir(inputs)
    return rng.choice((settings, settings, settings, memory, places))(rng, folder)


#: Settings that are not varied: valid requests for more work, and settings of the attack itself.
WORK = ("steps", "budget", "evaluations", "eval_views", "out", "device")


def settings(rng: random.Random, folder: Path) -> str:
    """Runs a training with extreme values of one or two settings."""
    hints = get_type_hints(TrainConfig)
    names = [entry.name for entry in dataclasses.fields(TrainConfig) if entry.name not in WORK]
    options: list[str] = []
    for name in rng.sample(names, k=rng.choice((1, 1, 2))):
        option = f"--{name.replace('_', '-')}"
        if hints[name] is bool:
            options.append(option)
        else:
            options += [option, _value(rng, name, hints[name])]
    out = folder / "run"
    verdict = judged("train", "--data", "blender", "--out", out, *TINY, *rng.choice(list(FIELDS.values())), *options)
    began = bool(checkpoint_paths(out)) or (out / "metrics.jsonl").exists()  # the training may have diverged
    if verdict == REFUSED and out.exists() and not began:
        raise Failed(f"{[str(path) for path in out.rglob('*')]} were written before {options} were refused")
    return verdict


def _value(rng: random.Random, name: str, kind: Any) -> str:
    if name in CHOICES and rng.random() < 0.7:
        return rng.choice(CHOICES[name])
    if rng.random() < 0.3:
        return rng.choice((*TEXTS[:7], "1e5", "0x10", "1_000", " 3"))
    return str(rng.choice([number for number in NUMBERS if "float" in str(kind) or isinstance(number, int)]))


#: Signs that memory was exhausted inside another library, which ended the process (Pillow by SIGSEGV), or in Python's
#: ``Thread.start``, which hangs (python/cpython#140746).
BENEATH = ("PanicException", "out of memory", "memory allocation", "allocate", "in _getdecoder\n", "in start\n")


def memory(rng: random.Random, folder: Path) -> str:
    """Runs a training with an address space limit (``ulimit -v``) above the current size."""
    extra = rng.randrange(1 << 20, 1 << 29)
    large = rng.choice(("--width 64", "--width 2000", "--rays 20000", "--samples 500", "--seed 1"))
    command = ("train", "--data", "blender", "--out", folder / "run", *TINY, *FIELDS["nerf"])
    said, ends = folder / "said", (RIGHT, None, REFUSED)

    def limited() -> int:
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT), 2)
        faulthandler.enable(2)
        sys.unraisablehook = lambda _: None  # Matplotlib's callbacks cannot raise a MemoryError
        faulthandler.dump_traceback_later(20, exit=True, file=2)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + extra, taken + extra))
        try:
            return ends.index(judged(*command, *large.split()))
        except BaseException as error:
            os.write(2, f"{type(error).__name__}: {error}".encode())
            raise

    status = os.waitstatus_to_exitcode(os.waitpid(fork_command(limited), 0)[1])
    if status in (0, 2):
        return ends[status]
    text = said.read_text(errors="replace")
    if "Failed: " in text or not any(words in text for words in BENEATH):
        raise Failed(f"ended with status {status}: {text[:1000]}")
    return REFUSED


def places(rng: random.Random, folder: Path) -> str:
    """Runs a training whose --out is a file, a link, or a folder with other contents."""
    out = folder / "run"
    kinds: tuple[Callable[[], object], ...] = (
        lambda: out.write_text("mine"),
        lambda: out.symlink_to("/dev/full"),
        lambda: out.symlink_to(out),
        lambda: (out / "config.json").mkdir(parents=True),
        lambda: shutil.copytree(Path.cwd() / "blender", out),
        lambda: checkpoint_path(out).mkdir(parents=True),
    )
    rng.choice(kinds)()
    return judged("train", "--data", "blender", "--out", out, *TINY, *FIELDS["nerf"])
