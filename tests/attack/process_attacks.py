"""Attacks with hostile scenes, and with hostile folders of a stopped `voronerf process`."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import sqlite3
from pathlib import Path

from attempts import Failed
from commands import judged
from hostile import VALUES, damaged, json_text, mutated, nested
from input_files import FEATURES
from scene_attacks import other_picture, stranger_scene

NUMBERS = (-1, 0, 1, 2, 5, 1000, 2**31 - 1, 2**32, 2**62, -(2**63))


def stranger_files(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Attacks with a hostile scene or, if pycolmap is installed, with a hostile folder of a stopped process."""
    attempt = stranger_folder if (inputs / "stopped").is_dir() and rng.random() < 0.5 else stranger_scene
    return attempt(rng, folder, inputs)


def stranger_folder(rng: random.Random, folder: Path, inputs: Path) -> str:
    """Continues a process in a changed folder: the command must succeed or refuse it in one line."""
    out = Path(shutil.copytree(inputs / "stopped", folder / "out"))
    outside = Path(shutil.copytree(inputs / "outside", folder / "outside"))
    for done in ("global", "masks"):
        if rng.random() < 0.4:
            shutil.rmtree(out / "colmap" / done)
    change = rng.choice((settings, link, link, database, database, database, model, picture, file))
    change(rng, out, outside)
    before = contents(outside)
    verdict = judged("process", inputs / "photographs", out, *FEATURES)
    if contents(outside) != before:
        raise Failed("something outside of the folder was changed")
    return verdict


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


def settings(rng: random.Random, out: Path, outside: Path) -> None:
    """Changes the settings, or replaces them by other JSON or by random bytes."""
    path = out / "colmap" / "settings.json"
    values = (mutated(rng, json.loads(path.read_text())), nested(rng.choice((1, 3, 5000))), rng.choice(VALUES))
    path.write_bytes(rng.choice((*map(json_text, values), damaged(rng, path.read_bytes()), rng.randbytes(99))))


def link(rng: random.Random, out: Path, outside: Path) -> None:
    """Replaces a file or a folder by a link out of the folder; the stages may write through this link."""
    of_stages = "database.db", "tried.db", "tried.db-journal", "part.txt", "trusted.part", "global", ".global", "masks"
    names = (*(f"colmap/{each}" for each in of_stages), "colmap", "masks", ".images_2", "sparse", "sparse/.0")
    name = rng.choice(names)
    there, target = out / name, outside / "moved"
    there.parent.mkdir(exist_ok=True)
    if there.exists():
        there.rename(target)
    elif rng.random() < 0.5:
        target.mkdir()
        (target / "mine").write_bytes(b"mine")
    else:
        target.write_bytes(rng.choice((b"", b"mine")))
    there.symlink_to(target if rng.random() < 0.8 else rng.choice(("/dev/zero", "/nowhere", there.name)))


def database(rng: random.Random, out: Path, outside: Path) -> None:
    """Damages the database, or changes one of its values or tables by SQL."""
    path = out / "colmap" / "database.db"
    if rng.random() < 0.3:
        path.write_bytes(rng.choice((damaged(rng, path.read_bytes()), rng.randbytes(5000))))
        return
    with contextlib.closing(sqlite3.connect(path)) as opened, contextlib.suppress(sqlite3.Error):
        if rng.random() < 0.5:
            opened.execute("DELETE FROM two_view_geometries")  # COLMAP then verifies the matches again
            opened.commit()
        tables = ("cameras", "frames", "images", "keypoints", "descriptors", "matches", "two_view_geometries", "rigs")
        table = rng.choice([table for table in tables if opened.execute(f"SELECT 1 FROM {table}").fetchone()])
        name = rng.choice([row[1] for row in opened.execute(f"PRAGMA table_info({table})")])
        number, value = opened.execute(f"SELECT rowid, {name} FROM {table} LIMIT 1").fetchone()
        if isinstance(value, bytes):
            value = rng.choice((rng.randbytes(len(value)), damaged(rng, value), b"", None, "text"))
        elif isinstance(value, str):
            value = rng.choice((f"../../outside/{value}", f"{value}\n", "", "a b", "é" * 3000, "\x1b[2J"))
        else:
            value = rng.choice((*NUMBERS, (value or 0) + 1, "text", None))
        rows = rng.choice((f" WHERE rowid = {number}", ""))
        if rng.random() < 0.2:
            opened.execute(rng.choice((f"DROP TABLE {table}", f"DELETE FROM {table}{rows}")))
        else:
            opened.execute(f"UPDATE {table} SET {name} = ?{rows}", (value,))
        opened.commit()


def model(rng: random.Random, out: Path, outside: Path) -> None:
    """Damages or overwrites a file of the mapper's model."""
    files = sorted(out.glob("colmap/global/0/*"))
    for path in rng.sample(files, min(len(files), rng.choice((1, 1, 3)))):
        data = path.read_bytes()
        number = rng.choice(NUMBERS).to_bytes(8, "little", signed=True)
        at = rng.randrange(max(1, min(len(data), 3000)))
        other = (damaged(rng, data), rng.randbytes(len(data)), data[:at] + number + data[at + 8 :])
        path.write_bytes(rng.choice(other))


def picture(rng: random.Random, out: Path, outside: Path) -> None:
    """Replaces an image, a mask or a mask for COLMAP."""
    path = rng.choice(sorted([*out.glob("images/*"), *out.glob("masks/*"), *out.glob("colmap/masks/*")]))
    data = other_picture(rng, path.read_bytes())
    path.unlink()
    if data is None:
        os.mkfifo(path)
    else:
        path.write_bytes(data)


def file(rng: random.Random, out: Path, outside: Path) -> None:
    """Puts a folder, a pipe or random bytes in place of a file or a folder."""
    names = "settings.json", "database.db", "database.db-journal", "tried.db", "part.txt", "global", "masks", "log.zzz"
    path = out / rng.choice((*(f"colmap/{name}" for name in names), "masks", "images", ".images", "images_2"))
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    kind = rng.randrange(4)
    if kind == 0:
        path.mkdir()
    elif kind == 1:
        os.mkfifo(path)
    else:
        path.write_bytes(rng.randbytes(rng.choice((0, 1, 4096))))
