"""From a video or a folder of images to a scene: COLMAP finds the cameras, by pycolmap.

Its stages leave what they found in `OUT/colmap`, where a stopped process goes on and COLMAP's own program can look:

    features   `database.db`: the features of each image; `masks`: where images are not transparent, nor masked
    pairs      `few.db`: the largest features of each image, matched between all; `pairs.json`: those that share some
    matches    `database.db`: matches of those pairs
    cameras    `global` and, if that model has faults or loses cameras, `incremental`. Each is made again, by
               `trusted.db`, if it contradicts pairs of images (:mod:`voronerf.app.scenes.folds`). The best becomes
               `OUT/sparse/0`, without cameras that few points hold or that lie far from the others

Matching the largest features first is the preemptive matching of Wu 2013, "Towards Linear-time Incremental Structure
from Motion", section 4; the global mapper is that of Pan et al. 2024, "Global Structure-from-Motion Revisited".
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shutil
import signal
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from PIL import Image

from voronerf.app.files import write_text
from voronerf.app.scenes.colmap import FILES, ColmapImage, ColmapModel, depth_bounds, points_seen, read_model
from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import listed_images
from voronerf.app.scenes.folds import (
    STILL,
    Matches,
    Pair,
    contradicted_pairs,
    is_folded,
    spreads,
    still_pairs,
    strong_pairs,
    trusted_pairs,
    wide_pairs,
)
from voronerf.app.scenes.gather import Progress, emptied, gather
from voronerf.app.scenes.images import read_header, read_image
from voronerf.app.scenes.lenses import MODELS
from voronerf.app.scenes.soundness import camera_faults, lost_cameras, some_of
from voronerf.app.scenes.transforms import Shot, write_transforms
from voronerf.app.wording import did_you_mean

MATCHINGS = ("auto", "exhaustive", "sequential")
MAPPERS = ("auto", "global", "incremental")
#: Of transparent images, the alpha from which features count.
OPAQUE = 128
#: "auto" matches at most so many images all with all.
FEW_IMAGES = 40
#: Of the largest features of an image that choose its pairs; with how many images it is matched, and how many matches
#: of the largest features make a pair. Images are also matched with this many that follow by name.
LARGEST_FEATURES, NEIGHBOURS, LEAST_MATCHES, FOLLOWING = 800, 20, 10, 2
#: Pairs are matched in parts of so many, between blocks of so many images, so that a part reads few images' features.
PART, BLOCK = 256, 16
#: Of so many images the pixels are tried as they are. Where these give less than a quarter of the features that are
#: asked for, all images are enlarged to twice their sides, as SIFT does it, which takes four times as long.
TRIED = 4
#: "sequential" matches an image with so many that follow, and with as many at distances of powers of two.
SEQUENTIAL = 10
#: Shares of the images with a camera: below the first a model is refused, below the second other mappers are tried.
LEAST_SHARE, GOOD_SHARE = 0.5, 0.9
#: A camera is held by so many points that at least three images see. COLMAP asks for as many matches of two images.
LEAST_HELD = 15
#: Mean error of the points of a sound model: pixels, and, of larger images, the share of the longer side. A phone's
#: images of 4,032 pixels have 2.04, and fields are as good as with 1.39.
LARGEST_ERROR, ERROR_SHARE = 2.0, 1 / 800
#: The global mapper places cameras by the longest tracks, until each image has so many; triangulation adds the others.
TRACKS = 200
#: The name of the mapper's thread, which cannot be stopped.
MAPPER = "mapper"
#: The name of the stages' folder until its settings are written.
BEGUN = ".colmap"
#: Reduced images are written while their longer side has so many pixels.
LEAST_SIDE = 256

#: The start of the names of COLMAP's logs, and what they say when a stage of the global mapper begins.
LOG, BEGINS = "log.", re.compile(r"=== Running (?:iterative )?(.+) ===")

Size = tuple[int, int]
Item = TypeVar("Item")


class Settings(NamedTuple):
    """The settings of all stages; a folder that was begun with others is refused."""

    source: str
    frames: int
    matching: str
    camera_model: str
    max_features: int
    size: int


@dataclass(frozen=True)
class Model:
    """The model that a mapper made."""

    folder: Path  # of its files
    images: list[ColmapImage]  # that have a sound camera, in the order of their names
    lost: dict[str, str]  # names of the other images, and what is wrong with their cameras
    error: float  # mean distance of the points from where they were seen, in pixels
    faults: list[str]  # what is wrong with it, as parts of a line
    contradicted: int = 0  # pairs of images that match well over much of both, and that its cameras contradict
    strong: int = 0  # pairs that match well over much of both

    @property
    def folded(self) -> bool:
        """Whether something that looks alike from several sides has misled the mapper."""
        return is_folded(self.contradicted, self.strong)


def process(
    source: Path,
    out: Path,
    *,
    frames: int = 150,
    matching: str = "auto",
    camera_model: str = "SIMPLE_RADIAL",
    mapper: str = "auto",
    max_features: int = 4096,
    size: int = 1600,
    verbose: bool = False,
    say: Callable[[str], None] = print,
    progress: Progress = lambda stage, done, total: None,
) -> None:
    """Makes a scene: `out/images`, reduced copies, a COLMAP model in `out/sparse/0` and `out/transforms.json`.

    Images of one size share a camera. `out/colmap` keeps what each stage found, and a process with the same settings
    goes on there. `out/sparse/0` appears when all is done.

    Args:
        source: a video, or a folder of PNG, JPEG, WebP, TIFF, BMP or, with pillow-heif, HEIC images; if it has none,
            those of its folder `images`, or of all its folders, are taken. Transparent parts have no features: the
            surroundings of an object on a turntable, which stand still, must be so. Nor have parts that are black in
            the mask of an image `0.jpg`: `0.jpg.png` or `0.png` in a folder `masks` in or beside that of the images.
            Masks go along to `out/masks`.
        out: the folder to make. It must not exist, be empty, or be that of a process that was stopped.
        frames: of a video, evenly spread; all of a video that has fewer.
        matching: which images are matched: "exhaustive", all with all; "sequential", with those next to them by name;
            "auto", those whose largest features match, and the next two by name.
        camera_model: COLMAP's name of the model of the lens.
        mapper: "global", "incremental", or "auto": global, and incremental too if its model has faults or loses
            cameras. A model that contradicts pairs of images is made again, without pairs that may mislead.
        max_features: of an image.
        size: of an image's longer side in pixels, to which it is reduced where features are searched. With 3,200, which
            is COLMAP's default, phones' images take twice the time, and fields are no better.
        verbose: show what COLMAP says.
        say: takes a line about each step.
        progress: takes the name of a stage, how much of it is done and how much there is; 0 where that is not known.
    """
    names = [name for name, _ in MODELS.values() if name != "EQUIRECTANGULAR"]
    for argument, value, known in (
        ("matching", matching, MATCHINGS),
        ("mapper", mapper, MAPPERS),
        ("camera_model", camera_model, names),
    ):
        if value not in known:
            end = did_you_mean(value, known)
            raise ValueError(f"process: {argument} must be one of {', '.join(known)}, got {value!r:.60}{end}")
    if max_features < 100:
        raise ValueError(f"process: max_features must be at least 100, got {max_features}")
    if size < 64:
        raise ValueError(f"process: size must be at least 64, got {size}")
    if not source.exists():
        raise SceneError(f"{source}: there is no such video or folder")
    settings = Settings(str(source.resolve()), frames, matching, camera_model, max_features, size)
    work = _begin(out, settings)
    if not (images := out / "images").is_dir():
        _begin_images(source, out, frames, say, progress)
    os.environ.setdefault("GLOG_logbuflevel", "-1")  # COLMAP reads it when it is loaded: its log is not held back
    stopping = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError:
        raise ImportError("voronerf process needs pycolmap: pip install 'voronerf[colmap]'") from None
    with contextlib.suppress(ValueError):  # in another thread than the main one
        signal.signal(signal.SIGTERM, stopping)  # importing pycolmap installs glog's handler, which prints a stack
    log, level = pycolmap.logging, pycolmap.logging.Level
    log.minloglevel, log.logtostderr, log.alsologtostderr = level.INFO.value, False, verbose
    log.stderrthreshold = level.FATAL.value
    log.set_log_destination(level.INFO, work / LOG)
    for other in (level.WARNING, level.ERROR):  # which are in that log, too
        log.set_log_destination(other, "")
    files, masks = listed_images(images), out / "masks"
    sizes = {path.name: read_header(path).size for path in files}
    counts = [f"{count} of {width} x {height}" for (width, height), count in Counter(sizes.values()).most_common()]
    shared = "one camera" if len(counts) == 1 else f"{len(counts)} cameras, one for each size: {some_of(counts)}"
    say(f"{len(files)} images with {shared}; {work} keeps what COLMAP finds")
    stages = Stages(pycolmap, work, images, progress)
    if masks.is_dir() or any(read_header(path).alpha for path in files):
        _write_masks(files, masks, work / "masks")
    _match(stages, sizes, settings)
    matches = _read_matches(stages)
    still, pairs = still_pairs(matches)
    if still > STILL * pairs:
        say(
            f"check the images: {still} of {pairs} pairs differ by a shift alone, so that a background stands still; "
            "the surroundings of an object on a turntable must be transparent (PNG)"
        )
    models = _find_models(stages, matches, mapper, len(files), say)
    if not models:
        raise SceneError(f"{source}: COLMAP finds no model: the images must overlap, be sharp and differ in place")
    best = _best(models, len(files))
    few = len(best.images) < LEAST_SHARE * len(files)
    faults = best.faults or ["less than half of the images have a camera"] * few
    if faults:
        raise SceneError(
            f"{out}: no sound model of {len(files)} images: {'; '.join(faults)}. Try --matching exhaustive, "
            f"--max-features 8192, another --camera-model, or more images; {work} has what was found"
        )
    for factor in (2, 4):
        _write_reduced(files, out / f"images_{factor}", factor)
    shown = [
        Shot(
            f"images/{each.name}",
            torch.from_numpy(each.pose),
            each.camera.lens,
            each.camera.width,
            each.camera.height,
            f"masks/{each.name}.png" if (masks / f"{each.name}.png").is_file() else "",
        )
        for each in best.images
    ]
    with contextlib.suppress(SceneError):  # for a lens that only COLMAP has
        write_transforms(out / "transforms.json", shown)
    _write_sound(pycolmap, best, out / "sparse" / "0")
    if best.folded:
        say(f"check the cameras: the model {_contradiction(best)}")
    say(f"wrote {out}: cameras of {len(best.images)} of {len(files)} images; voronerf train --data {out}")


def _begin(out: Path, settings: Settings) -> Path:
    """The folder of the stages, new or that of a process with the same settings that was stopped."""
    work = out / "colmap"
    noted = work / "settings.json"
    if noted.is_file():
        before, asked = json.loads(noted.read_text()), settings._asdict()
        if other := [name for name, value in asked.items() if before.get(name) != value]:
            name = other[0]
            raise SceneError(
                f"{work}: was begun with --{name.replace('_', '-')} {before.get(name)}, not {asked[name]}; give the "
                "same, or another folder"
            )
        if (out / "sparse" / "0").exists():
            raise SceneError(f"{out}: is a scene already")
        return work
    part = out / BEGUN
    if out.exists() and (not out.is_dir() or any(path != part for path in out.iterdir())):
        raise SceneError(f"{out}: must not exist yet, be an empty folder, or be that of a process that was stopped")
    write_text(emptied(part) / noted.name, json.dumps(settings._asdict(), indent=1))
    os.replace(part, work)
    return work


def _begin_images(source: Path, out: Path, frames: int, say: Callable[[str], None], progress: Progress) -> None:
    """Makes `out/images` and, where there are masks, `out/masks`; or nothing, as if never begun."""
    part, masks = emptied(out / ".images"), out / "masks"
    try:
        gather(source, part, masks, frames, say=say, progress=progress)
    except BaseException:
        for begun in (part, masks):
            shutil.rmtree(begun, ignore_errors=True)
        with contextlib.suppress(OSError):
            os.replace(out / "colmap", out / BEGUN)  # a kill leaves no folder of the stages without settings
            shutil.rmtree(out / BEGUN)
            out.rmdir()
        raise
    os.replace(part, out / "images")


@dataclass(frozen=True)
class Stages:
    """The files and settings that all stages work on."""

    colmap: Any  # the module pycolmap
    work: Path  # the folder of what the stages leave
    images: Path  # the folder of the images
    progress: Progress  # as of :func:`process`

    def in_parts(self, name: str, items: Sequence[Item], size: int, work: Callable[[Sequence[Item]], None]) -> None:
        """Does the work of a stage in parts, so that it can be shown and stopped; COLMAP passes over what is done."""
        for first in range(0, len(items), size):
            self.progress(name, first, len(items))
            with _told(name):
                work(items[first : first + size])
        self.progress(name, len(items), len(items))


@contextlib.contextmanager
def _told(stage: str) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise SceneError(f"pycolmap: {stage}: {' '.join(str(error).split())[:300]}") from None


def _match(stages: Stages, sizes: dict[str, Size], settings: Settings) -> None:
    """Finds the features of images, given by their names and sizes, and matches them."""
    colmap, database, names = stages.colmap, stages.work / "database.db", list(sizes)
    extraction = colmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = settings.max_features
    extraction.max_image_size = settings.size
    reader = colmap.ImageReaderOptions(camera_model=settings.camera_model)
    if (masks := stages.work / "masks").is_dir():
        reader.mask_path = masks
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0

    def extract(some: Sequence[str], where: Path = database) -> None:
        with colmap.Database.open(where) as opened:
            cameras = {(each.width, each.height): each.camera_id for each in opened.read_all_cameras()}
        for size, alike in itertools.groupby(sorted(some, key=sizes.__getitem__), sizes.__getitem__):
            reader.existing_camera_id = cameras.get(size, -1)
            colmap.extract_features(
                where,
                stages.images,
                image_names=list(alike),
                camera_mode=colmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=extraction,
            )

    def match(where: Path, name: str, pairs: Sequence[Pair]) -> None:
        listed, block = stages.work / "part.txt", {image: number // BLOCK for number, image in enumerate(names)}

        def match_part(some: Sequence[Pair]) -> None:
            listed.write_text("".join(f"{a} {b}\n" for a, b in some))
            pairing = colmap.ImportedPairingOptions(match_list_path=listed)
            colmap.match_image_pairs(where, pairing_options=pairing, verification_options=verification)

        stages.in_parts(name, sorted(pairs, key=lambda pair: [block[image] for image in pair]), PART, match_part)
        listed.unlink(missing_ok=True)

    tried, some = stages.work / "tried.db", names[:: -(-len(names) // TRIED)]
    tried.unlink(missing_ok=True)
    extraction.sift.first_octave = 0
    stages.progress("features", 0, len(names))
    with _told("features"):
        extract(some, tried)
    with colmap.Database.open(tried) as opened:
        if opened.num_keypoints() < len(some) * settings.max_features / 4:
            extraction.sift.first_octave = -1
    tried.unlink()
    stages.in_parts("features", names, 4, extract)
    with colmap.Database.open(database) as opened:
        matched = opened.num_matched_image_pairs() > 0
    if not matched:  # SIFT gives up to twice as many as it is asked for, and matching takes their product
        _keep_largest(colmap, database, database, settings.max_features)
    if settings.matching == "sequential":
        steps = {*range(1, SEQUENTIAL + 1), *(2**i for i in range(SEQUENTIAL))}
        pairs = [pair for step in sorted(steps) for pair in zip(names, names[step:])]
    else:
        pairs = list(itertools.combinations(names, 2))
        if settings.matching == "auto" and len(names) > FEW_IMAGES:
            few, chosen = stages.work / "few.db", stages.work / "pairs.json"
            if not chosen.is_file():
                if not few.is_file():
                    _keep_largest(colmap, database, few, LARGEST_FEATURES)
                match(few, "pairs", pairs)
                write_text(chosen, json.dumps(_choose_pairs(colmap, few)))
            pairs = [(a, b) for a, b in json.loads(chosen.read_text())]
    match(database, "matches", pairs)


def _keep_largest(colmap: Any, database: Path, few: Path, most: int) -> None:
    """Copies a database with the largest features of each image alone; to itself, as well."""
    part = _copied(database, few.with_suffix(".part"))
    with colmap.Database.open(part) as opened:
        kept = {}
        for image in opened.read_all_images():
            places, described = opened.read_keypoints(image.image_id), opened.read_descriptors(image.image_id)
            # A feature is x, y and a scale, or x, y and an affine shape of 2 x 2.
            a, *rest = places[:, 2:].T
            area = np.abs(a * rest[2] - rest[0] * rest[1]) if len(rest) == 3 else a**2
            top = np.argsort(-area, kind="stable")[:most]
            kept[image.image_id] = places[top], type(described)(data=described.data[top], type=described.type)
        opened.clear_keypoints()
        opened.clear_descriptors()
        for number, (places, described) in kept.items():
            opened.write_keypoints(number, places)
            opened.write_descriptors(number, described)
    os.replace(part, few)


def _choose_pairs(colmap: Any, few: Path) -> list[Pair]:
    """The names of the images that are worth matching with all features: each with its best, and the next by name."""
    with colmap.Database.open(few) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        numbers, matches = opened.read_two_view_geometry_num_inliers()
    shared: dict[str, list[tuple[int, str]]] = {name: [] for name in names.values()}
    for number, count in zip(numbers, matches):
        a, b = (names[image] for image in colmap.pair_id_to_image_pair(number))
        if count >= LEAST_MATCHES:
            shared[a].append((count, b))
            shared[b].append((count, a))
    pairs = {tuple(sorted((a, b))) for a, best in shared.items() for _, b in sorted(best, reverse=True)[:NEIGHBOURS]}
    ordered = sorted(shared)
    for step in range(1, FOLLOWING + 1):
        pairs.update(zip(ordered, ordered[step:]))
    return sorted((a, b) for a, b in pairs)


def _find_models(stages: Stages, matches: Matches, mapper: str, count: int, say: Callable[[str], None]) -> list[Model]:
    """The models of a mapper or, with "auto", of as many as it takes for a good one of so many images."""
    spread = spreads(matches)
    strong, models = strong_pairs(matches, wide_pairs(matches, spread)), list[Model]()
    for name, again in itertools.product(MAPPERS[1:], (False, True)):
        folded = bool(models) and models[-1].folded
        good = any(_sound(model, GOOD_SHARE * count) and not (model.folded or model.lost) for model in models)
        if good or mapper not in ("auto", name) or (again and not folded):
            continue
        database, about = stages.work / "database.db", f"{name} mapping"
        if again:
            trusted = trusted_pairs(matches, spread)
            database = _keep_pairs(stages.colmap, database, trusted)
            about += f" by {len(trusted)} pairs of {len(matches.pairs)}"
        try:
            model = _map(stages, f"{name}_again" if again else name, database, matches, strong)
        except SceneError as error:  # such as a model whose focal lengths are not finite
            say(f"{about}: no model: {error}")
            continue
        say(f"{about}: {_described(model, count)}")
        models += [model] if model is not None else []
    return models


def _read_matches(stages: Stages) -> Matches:
    """The matches that fit two cameras."""
    colmap, pairs = stages.colmap, {}
    with colmap.Database.open(stages.work / "database.db") as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        features = {name: opened.read_keypoints(number)[:, :2] for number, name in names.items()}
        for pair, count in zip(*opened.read_two_view_geometry_num_inliers()):
            if count:
                a, b = colmap.pair_id_to_image_pair(pair)
                found = np.asarray(opened.read_two_view_geometry(a, b).inlier_matches)
                pairs[names[a], names[b]] = found.astype(np.int64)
    return Matches(features, pairs)


def _keep_pairs(colmap: Any, database: Path, pairs: Collection[Pair]) -> Path:
    """A copy of a database, beside it, with the matches of some pairs alone; one that is there is kept."""
    kept = database.with_name("trusted.db")
    if kept.is_file():
        return kept
    part = _copied(database, kept.with_suffix(".part"))
    with colmap.Database.open(part) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        fitted = {(numbers[a], numbers[b]): opened.read_two_view_geometry(numbers[a], numbers[b]) for a, b in pairs}
        opened.clear_two_view_geometries()
        for (a, b), geometry in sorted(fitted.items()):
            opened.write_two_view_geometry(a, b, geometry)
    os.replace(part, kept)
    return kept


def _sound(model: Model, least: float) -> bool:
    """Whether a model has no faults, and so many cameras."""
    return not model.faults and len(model.images) >= least


def _best(models: Sequence[Model], count: int) -> Model:
    """The best of models of so many images: sound, not folded, with the most cameras, few lost, and the least error.

    A pair that a model contradicts weighs as much as a camera: it tells that others are wrong, too.
    """

    def worth(model: Model) -> tuple[float, ...]:
        cameras, folded = len(model.images) - model.contradicted, model.contradicted * model.folded
        return _sound(model, LEAST_SHARE * count), -folded, cameras, -len(model.lost), -model.error

    return max(models, key=worth)


def _map(stages: Stages, name: str, database: Path, matches: Matches, strong: Sequence[Pair]) -> Model | None:
    """The largest model of a mapper, which its name begins with, or None if it finds none."""
    colmap, folder = stages.colmap, stages.work / name
    mapper, _, again = name.partition("_")
    if not folder.is_dir():
        part = emptied(stages.work / f".{name}")
        errors: list[Exception] = []
        placed: list[None] = []

        def find() -> None:
            try:
                if mapper == "global":
                    options = colmap.GlobalPipelineOptions(random_seed=0)
                    options.mapper.track_required_tracks_per_view = TRACKS
                    colmap.global_mapping(database, stages.images, part, options)
                else:
                    options = colmap.IncrementalPipelineOptions(random_seed=0)
                    colmap.incremental_mapping(
                        database, stages.images, part, options, next_image_callback=lambda: placed.append(None)
                    )
            except Exception as error:
                errors.append(error)

        # In a thread, since Ctrl-C does not reach COLMAP.
        thread = threading.Thread(target=find, name=MAPPER, daemon=True)
        thread.start()
        while thread.is_alive():
            thread.join(0.5)
            logs = sorted(stages.work.glob(f"{LOG}*")) if mapper == "global" else []
            begun = BEGINS.findall(logs[-1].read_text(errors="replace")) if logs else []
            stages.progress(": ".join((f"{mapper} mapping {again}".rstrip(), *begun[-1:])), len(placed), 0)
        with _told("mapping"):
            for failure in errors:
                raise failure
        os.replace(part, folder)
    models = [path for path in folder.iterdir() if (path / "images.bin").is_file()]
    if not models:
        return None
    largest = max(models, key=lambda path: len(read_model(path).images))
    model = read_model(largest)
    lost = _lost(model)
    images = [image for image in model.images if image.name not in lost]
    origins = torch.from_numpy(np.stack([image.pose[:3, 3] for image in model.images]))
    bounds = [bound for image in images if (bound := depth_bounds(image, points_seen(image, model))) is not None]
    faults = camera_faults(origins, torch.tensor(bounds), ((image.camera.lens, image.camera.width) for image in images))
    error = float(colmap.Reconstruction(largest).compute_mean_reprojection_error())
    side = max(max(image.camera.width, image.camera.height) for image in model.images)
    if error > max(LARGEST_ERROR, ERROR_SHARE * side):
        faults.append(f"its points are off by {error:.2f} pixels")
    return Model(largest, images, lost, error, faults, *contradicted_pairs(matches, strong, images))


def _lost(model: ColmapModel) -> dict[str, str]:
    """The images of a model whose cameras few points hold or that lie far from the others, and which of both it is."""
    far = lost_cameras(torch.from_numpy(np.stack([image.pose[:3, 3] for image in model.images])))
    lost = {}
    for image, apart in zip(model.images, far.tolist()):
        held = len(points_seen(image, model))
        if apart:
            lost[image.name] = "far from the others"
        elif held < LEAST_HELD:
            lost[image.name] = f"held by {held} points"
    return lost


def _described(model: Model | None, images: int) -> str:
    if model is None:
        return "no model"
    rest = "".join(f"; {fault}" for fault in [*model.faults, *[_contradiction(model)] * model.folded])
    if model.lost:
        rest += f"; without the cameras of {some_of([f'{name} ({why})' for name, why in model.lost.items()])}"
    return f"{len(model.images)} of {images} images, points off by {model.error:.2f} pixels{rest}"


def _contradiction(model: Model) -> str:
    """What a folded model is wrong about, as a part of a line."""
    what = f"contradicts {model.contradicted} of {model.strong} pairs of images that match well over much of both"
    return f"{what}: something may look alike from several sides"


def _write_sound(colmap: Any, model: Model, folder: Path) -> None:
    """Writes the cameras, images and points of a model, without what is lost."""
    reconstruction = colmap.Reconstruction(model.folder)
    for image in list(reconstruction.images.values()):
        if image.name in model.lost:
            reconstruction.deregister_frame(image.frame_id)
    part = emptied(folder.with_name(f".{folder.name}"))
    reconstruction.write_binary(part)
    for path in part.iterdir():
        if path.stem not in FILES:  # of rigs: each image has its pose
            path.unlink()
    os.replace(part, folder)


def _write_masks(files: Sequence[Path], masks: Path, folder: Path) -> None:
    """Writes masks as COLMAP reads them: black where an image is transparent, or masked already."""
    if folder.is_dir():
        return
    part = emptied(folder.with_name(f".{folder.name}"))
    for path in files:
        pixels = read_image(path, 1)
        opaque = pixels[..., 3] >= OPAQUE if pixels.shape[-1] == 4 else np.ones(pixels.shape[:2], dtype=bool)
        if (mask := masks / f"{path.name}.png").is_file():
            with Image.open(mask) as drawn:
                opaque &= np.asarray(drawn)
        Image.fromarray(opaque).save(part / f"{path.name}.png")
    os.replace(part, folder)


def _write_reduced(files: Sequence[Path], folder: Path, factor: int) -> None:
    """Writes the images reduced by area, unless they are there or would be too small."""
    if folder.is_dir() or max(max(read_header(path).size) for path in files) // factor < LEAST_SIDE:
        return
    part = emptied(folder.with_name(f".{folder.name}"))
    for path in files:
        with Image.open(path) as image:
            kept = {} if path.suffix.lower() == ".png" else {"quality": 95, "exif": image.getexif()}
            indexed = image.mode in ("P", "1")
            shown = image.convert("RGBA" if read_header(path).alpha else "RGB") if indexed else image
            shown.reduce(factor).save(part / path.name, **kept)
    os.replace(part, folder)


def _copied(database: Path, part: Path) -> Path:
    """Copies a database over what a killed process left, whose write-ahead log SQLite would replay."""
    for left in part.parent.glob(f"{part.name}*"):
        left.unlink()
    shutil.copyfile(database, part)
    return part
