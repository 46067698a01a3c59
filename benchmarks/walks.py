"""Writes captures of people who walk and look around: in a room, along a street, and on a roof above a city.

The people turn around twice on the way. The median viewing distance is four times the length of the walk in the room
and in the street, and thirty times its length on the roof. The files have the layout of `room.py`.

    python benchmarks/walks.py FOLDER --place street --seed 0
    voronerf train --data FOLDER --budget 40
"""

from __future__ import annotations

import argparse
import math
import random
from pathlib import Path

import torch
from room import room, write_capture

from voronerf.app.scenes.builtin.city_solids import city
from voronerf.nerf.cameras import Cameras, look_at

#: The middle of a walk, its half extent along each axis, and the mean upward slope of the viewing directions.
PLACES = {
    "room": ((0.0, 0.0, 1.5), (0.4, 0.4, 0.1), -0.25),
    "street": ((0.0, 0.5, 0.05), (0.02, 0.25, 0.005), 0.1),
    "roof": ((-0.67, 0.67, 0.67), (0.03, 0.07, 0.002), -0.2),
}
BLOCKS, SKY = 8, (0.62, 0.75, 0.9)


def walk(draw: random.Random, place: str, views: int, width: int, height: int) -> Cameras:
    """Returns cameras that move along y, sway, and turn around twice."""
    t = torch.linspace(0, 1, views)
    waves = [torch.sin(2 * math.pi * (draw.choice([2, 3, 5]) * t + draw.random())) for _ in range(5)]  # four used
    middle, reach, up = PLACES[place]
    along = torch.stack((waves[0], 2 * t - 1, waves[1]), dim=-1)
    origins = torch.tensor(middle) + along * torch.tensor(reach)
    turn = 2 * math.pi * (2 * t + draw.random()) + 0.3 * waves[2]
    glances = torch.stack((turn.cos(), turn.sin(), up + 0.15 * waves[3]), dim=-1)
    poses = look_at(origins, origins + glances, torch.tensor((0.0, 0.0, 1.0)))
    lens = torch.tensor((0.75 * width, 0.75 * width, width / 2, height / 2))
    return Cameras(poses, lens.repeat(views, 1), width, height)


def write_walk(folder: Path, place: str, seed: int, *, views: int = 96, width: int = 200, height: int = 150) -> None:
    """Writes the capture of a walk into a folder."""
    draw = random.Random(seed)
    solids, mirrors = room(draw) if place == "room" else (city((BLOCKS, BLOCKS)), 0)
    write_capture(folder, solids, mirrors, walk(draw, place, views, width, height), seed, SKY)


def main() -> None:
    """Parses the command line and writes a walk."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--place", choices=PLACES, default="street")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    write_walk(options.folder, options.place, options.seed)


if __name__ == "__main__":
    main()
