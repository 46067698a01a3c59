"""Makes a scene from videos or a folder of images; COLMAP (through pycolmap) finds the cameras.

The stages keep their results in `OUT/colmap`. A stopped process continues from these results, and COLMAP's own program
can open them:

    features   `database.db`: the features of each image; `masks`: pixels that are neither transparent nor masked
    pairs      `few.db`: the largest features, matched between all images; `pairs.json`: the pairs to match
    matches    `database.db`: the matches of these pairs
    cameras    `global` and, if this model has faults or lacks cameras, `incremental`. A mapper runs again, on
               `trusted.db`, if its model contradicts pairs of images (:mod:`voronerf.app.scenes.folds`). The best model
               becomes `OUT/sparse/0`, without cameras that see few points or lie far from the others

Matching the largest features first is the preemptive matching of Wu 2013, "Towards Linear-time Incremental Structure
from Motion", section 4. The global mapper is by Pan et al. 2024, "Global Structure-from-Motion Revisited".
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import re
import shutil
import signal
import threading
from collections import Counter
from collections.abc import Callable, Collection, Sequence
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
from voronerf.app.scenes.gather import Progress, cameras_of, emptied, files_of, gather, read_mask
from voronerf.app.scenes.images import read_header, read_image
from voronerf.app.scenes.lenses import MODELS
from voronerf.app.scenes.results import (
    check_database,
    check_files,
    check_model,
    named_errors,
    read_pairs,
    read_result,
)
from voronerf.app.scenes.soundness import camera_faults, lost_cameras, some_of
from voronerf.app.scenes.transforms import Shot, write_transforms
from voronerf.app.wording import did_you_mean

MATCHINGS = ("auto", "exhaustive", "sequential")
MAPPERS = ("auto", "global", "incremental")
#: The minimum alpha of pixels with features.
OPAQUE = 128
#: The largest number of images for which "auto" matches all pairs.
FEW_IMAGES = 40
#: Selection of pairs: the number of largest features per image, the maximum number of partners of an image, the minimum
#: number of matches of these features in a pair, and the number of next images by name that are always partners.
LARGEST_FEATURES, NEIGHBOURS, LEAST_MATCHES, FOLLOWING = 800, 20, 10, 2
#: The number of pairs that COLMAP matches in one call, and the number of images in a block. Pairs are sorted by the
#: blocks of their images, so that a call reads the features of few images.
PART, BLOCK = 256, 16
#: The number of images on which features are tried without upsampling. If these images have fewer than a quarter of the
#: requested features, all images are enlarged to twice their width and height, as in the original SIFT. This takes four
#: times as long.
TRIED = 4
#: "sequential" matches an image with this number of next images, and with the same number of images at distances of
#: powers of two.
SEQUENTIAL = 10
#: Fractions of the images that have a camera: below the first, a model is refused; below the second, other mappers are
#: tried.
LEAST_SHARE, GOOD_SHARE = 0.5, 0.9
#: A camera is lost if it sees fewer points than this. Only points that at least three images see count. COLMAP requires
#: the same number of matches between two images. If an image shares its lens with no other image, its points also
#: determine the lens; its camera is lost too if it sees fewer than `ALONE_HELD` times the images' median.
LEAST_HELD, ALONE_HELD = 15, 0.25
#: The largest mean reprojection error that is no fault of a model: in pixels, and as a fraction of the longer side,
#: whichever is larger. With a phone's images of 4,032 pixels, trained fields are as good at 2.04 as at 1.39.
LARGEST_ERROR, ERROR_SHARE = 2.0, 1 / 800
#: The number of tracks per image that the global mapper uses to place cameras, longest first; triangulation adds the
#: other tracks.
TRACKS = 200
#: The name of the mapper's thread, which cannot be interrupted.
MAPPER = "mapper"
#: The files with the settings, and with the folder or the video of each image.
RECORD, PLACES = "settings.json", "places.json"
#: The temporary name of the stages' folder, until its settings are written.
BEGUN = ".colmap"
#: Reduced images are written only if their longer side has at least this number of pixels.
LEAST_SIDE = 256

#: The prefix of COLMAP's log files, and the pattern of a log line at the start of a stage of the global mapper.
LOG, BEGINS = "log.", re.compile(r"=== Running (?:iterative )?(.+) ===")

Size = tuple[int, int]
Item = TypeVar("Item")


class Settings(NamedTuple):
    """The settings of :func:`process` that decide its results; a folder with results of other settings is refused.

    Attributes:
        source: the paths of the sources.
        files: a checksum of the names and sizes of their files.
        frames, matching, camera_model, max_features, size: see :func:`process`.
    """

    source: str
    files: str
    frames: int
    matching: str
    camera_model: str
    max_features: int
    size: int

    @classmethod
    def of(cls, sources: Sequence[Path], **options: Any) -> Settings:
        """Returns the settings for these sources and options of :func:`process`; options without effect are dropped."""
        sizes = [
            (os.path.relpath(file, source), file.stat().st_size) for source in sources for file in files_of(source)
        ]
        listed = hashlib.sha256(json.dumps(sizes).encode(errors="surrogateescape")).hexdigest()
        paths = os.pathsep.join(str(path.resolve()) for path in sources)
        return cls(paths, listed, **{name: value for name, value in options.items() if name in cls._fields})

    def is_done(self, out: Path) -> bool:
        """Returns whether a folder has a scene of these settings.

        Raises:
            SceneError: the folder has results of other settings.
        """
        work = out / "colmap"
        stored = read_result(work / RECORD, dict)
        if changed := [name for name, value in self._asdict().items() if stored.get(name) != value]:
            name = changed[0].replace("_", "-")
            if name == "files":
                raise SceneError(f"{work}: was started with other files in {self.source}; choose another folder")
            raise SceneError(
                f"{work}: was started with --{name} {stored.get(changed[0])!s:.60}, got {getattr(self, changed[0])}; "
                "give the same value, or another folder"
            )
        return (out / "sparse" / "0").exists()


@dataclass(frozen=True)
class Model:
    """A sparse model (cameras and points) from one of COLMAP's mappers.

    Attributes:
        folder: the folder of its files.
        images: the images whose cameras are kept, sorted by name.
        lost: the reason why a camera was dropped, by its image's name.
        error: the mean reprojection error in pixels.
        faults: phrases that describe the model's faults, to be joined in one message.
        contradicted: the number of strong pairs (:mod:`voronerf.app.scenes.folds`) that its cameras contradict.
        strong: the number of strong pairs of its images.
    """

    folder: Path
    images: list[ColmapImage]
    lost: dict[str, str]
    error: float
    faults: list[str]
    contradicted: int = 0
    strong: int = 0

    @property
    def folded(self) -> bool:
        """Returns whether the model is folded: an object that looks alike from several sides has misled the mapper."""
        return is_folded(self.contradicted, self.strong)


def process(
    source: Path | Sequence[Path],
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

    Images share a camera if they have the same size and, by their EXIF tags, the same make, model and focal length. If
    the tags tell no focal length, they must also come from the same folder or video. `out/colmap` keeps the results of
    each stage, from which a process with the same settings continues. `out/sparse/0` is written last.

    Args:
        source: a video or several videos, or a folder of PNG, JPEG, WebP, TIFF, BMP or, with pillow-heif, HEIC images.
            If the folder itself has no images, its subfolder `images` or else all its subfolders are read; if it has
            none anywhere, its videos are read. Colours of videos are converted to sRGB. Pixels that are
            transparent, or black in a mask, have no features. The mask of `0.jpg` is `0.jpg.png` or `0.png` in a folder
            `masks`, in or beside the images' folder, and is copied to `out/masks`. The static surroundings of an object
            on a turntable must be transparent or masked.
        out: the folder to make; an existing folder must be empty or belong to a stopped process.
        frames: the number of evenly spaced frames to take from the videos; all frames if they have fewer.
        matching: selection of image pairs: "exhaustive", all pairs; "sequential", neighbours by name; "auto", images
            whose largest features match, and the next two images by name.
        camera_model: COLMAP's name of the lens model.
        mapper: "global", "incremental", or "auto": global, and also incremental if the global model has faults or lacks
            cameras. If a model contradicts pairs of images, its mapper runs again on trusted pairs alone.
        max_features: the maximum number of features per image.
        size: the longer side in pixels to which images are reduced for finding features. COLMAP's default, 3,200,
            doubles the time for phones' images, but does not improve the trained fields.
        verbose: show COLMAP's log.
        say: called with each line of text for the user.
        progress: called with the name of a stage, the number of finished items, and the number of all items, 0 if
            unknown.
    """
    names = [name for name, _ in MODELS.values() if name != "EQUIRECTANGULAR"]
    for argument, value, choices in (
        ("matching", matching, MATCHINGS),
        ("mapper", mapper, MAPPERS),
        ("camera_model", camera_model, names),
    ):
        if value not in choices:
            hint = did_you_mean(value, choices)
            raise ValueError(f"process: {argument} must be one of {', '.join(choices)}, got {value!r:.60}{hint}")
    if max_features < 100:
        raise ValueError(f"process: max_features must be at least 100, got {max_features}")
    if size < 64:
        raise ValueError(f"process: size must be at least 64, got {size}")
    sources = [source] if isinstance(source, Path) else list(source)
    for path in sources:
        if not path.exists():
            raise SceneError(f"{path}: there is no such video or folder")
        if len(sources) > 1 and not path.is_file():
            raise SceneError(f"{path}: several sources must be videos, got a folder; put all pictures into one folder")
    options = {"matching": matching, "camera_model": camera_model, "max_features": max_features, "size": size}
    settings = Settings.of(sources, frames=frames, **options)
    work = _begin(out, settings)
    places = work / PLACES
    if not (images := out / "images").is_dir():
        _begin_images(sources, out, frames, say, progress)
    os.environ.setdefault("GLOG_logbuflevel", "-1")  # read when COLMAP is loaded: turns off log buffering
    stopping = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError:
        raise ImportError("voronerf process needs pycolmap: pip install 'voronerf[colmap]'") from None
    with contextlib.suppress(ValueError):  # outside the main thread
        signal.signal(signal.SIGTERM, stopping)  # replaces glog's handler, which prints a stack trace
    log, level = pycolmap.logging, pycolmap.logging.Level
    log.minloglevel, log.logtostderr, log.alsologtostderr = level.INFO.value, False, verbose
    log.stderrthreshold = level.FATAL.value
    log.set_log_destination(level.INFO, work / LOG)
    for other in (level.WARNING, level.ERROR):  # the INFO log has these lines, too
        log.set_log_destination(other, "")
    files, masks = listed_images(images), out / "masks"
    sizes = {path.name: read_header(path).size for path in files}
    cameras = cameras_of(files, read_result(places, dict) if places.is_file() else {})
    counts = [f"{count} of {label}" for label, count in Counter(cameras.values()).most_common()]
    shared = "one camera" if len(counts) == 1 else f"{len(counts)} cameras: {some_of(counts)}"
    say(f"{len(files)} images with {shared}; {work} keeps COLMAP's results")
    stages = Stages(pycolmap, work, images, progress)
    if masks.is_dir() or any(read_header(path).alpha for path in files):
        _write_masks(files, masks, work / "masks")
    with named_errors("pycolmap: matches"):
        _match(stages, sizes, cameras, settings)
        matches = _read_matches(stages)
    still, pairs = still_pairs(matches)
    if still > STILL * pairs:
        say(
            f"check the images: {still} of {pairs} pairs show a static background; "
            "the surroundings of an object on a turntable must be transparent (PNG)"
        )
    models = _find_models(stages, matches, mapper, len(files), say)
    if not models:
        raise SceneError(f"{sources[0]}: COLMAP finds no model: the images must overlap, be sharp and differ in place")
    best = _best(models, len(files))
    few = len(best.images) < LEAST_SHARE * len(files)
    faults = best.faults or ["less than half of the images have a camera"] * few
    if faults:
        raise SceneError(
            f"{out}: no sound model of {len(files)} images: {'; '.join(faults)}. Try --matching exhaustive, "
            f"--max-features 8192, another --camera-model, more images, or a folder for each lens and zoom: images "
            f"with {shared.partition(':')[0]}; {work} has COLMAP's results"
        )
    for factor in (2, 4):
        _write_reduced(files, out / f"images_{factor}", factor)
    shots = [
        Shot(
            f"images/{image.name}",
            torch.from_numpy(image.pose),
            image.camera.lens,
            image.camera.width,
            image.camera.height,
            f"masks/{image.name}.png" if (masks / f"{image.name}.png").is_file() else "",
        )
        for image in best.images
    ]
    with contextlib.suppress(SceneError):  # transforms.json cannot describe all of COLMAP's lenses
        write_transforms(out / "transforms.json", shots)
    _write_sound(pycolmap, best, out / "sparse" / "0")
    if best.folded:
        say(f"check the cameras: the model {_contradiction(best)}")
    say(f"wrote {out}: cameras of {len(best.images)} of {len(files)} images; voronerf train --data {out}")


def _begin(out: Path, settings: Settings) -> Path:
    """Returns the folder of the stages: a new folder, or the folder of a stopped process with the same settings."""
    work = out / "colmap"
    if (work / RECORD).is_file():
        check_files(out)
        if settings.is_done(out):
            raise SceneError(f"{out}: is a scene already")
        return work
    partial = out / BEGUN
    if out.exists() and (not out.is_dir() or any(path != partial for path in out.iterdir())):
        raise SceneError(f"{out}: must be a new or empty folder, or the folder of a stopped process")
    write_text(emptied(partial) / RECORD, json.dumps(settings._asdict(), indent=1))
    os.replace(partial, work)
    return work


def _begin_images(
    sources: Sequence[Path], out: Path, frames: int, say: Callable[[str], None], progress: Progress
) -> None:
    """Makes `out/images` and, if there are masks, `out/masks`; removes both and the stages' folder on failure."""
    part, masks = emptied(out / ".images"), out / "masks"
    try:
        places = gather(sources, part, masks, frames, say=say, progress=progress)
        write_text(out / "colmap" / PLACES, json.dumps(places, indent=1))
    except BaseException:
        for folder in (part, masks):
            shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):
            os.replace(out / "colmap", out / BEGUN)  # renamed first, so that a kill cannot leave a partial folder
            shutil.rmtree(out / BEGUN)
            out.rmdir()
        raise
    os.replace(part, out / "images")


@dataclass(frozen=True)
class Stages:
    """The files and settings of all stages of :func:`process`: features, pairs, matches, cameras."""

    colmap: Any  # the module pycolmap
    work: Path  # the folder of the stages' results
    images: Path  # the folder of the images
    progress: Progress  # see :func:`process`

    def in_parts(self, name: str, items: Sequence[Item], size: int, work: Callable[[Sequence[Item]], None]) -> None:
        """Runs a stage in parts, between which it reports progress and can be stopped; COLMAP skips finished items."""
        for first in range(0, len(items), size):
            self.progress(name, first, len(items))
            with named_errors(f"pycolmap: {name}"):
                work(items[first : first + size])
        self.progress(name, len(items), len(items))


def _match(stages: Stages, sizes: dict[str, Size], labels: dict[str, str], settings: Settings) -> None:
    """Finds and matches the features of images; the dictionaries have the images' sizes and cameras by their names."""
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
            cameras = {labels[image.name]: image.camera_id for image in opened.read_all_images()}
        for label, alike in itertools.groupby(sorted(some, key=labels.__getitem__), labels.__getitem__):
            reader.existing_camera_id = cameras.get(label, -1)
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

    if database.is_file():
        check_database(colmap, database, sizes)
    tried, some = stages.work / "tried.db", names[:: -(-len(names) // TRIED)]
    _remove_database(tried)
    extraction.sift.first_octave = 0
    stages.progress("features", 0, len(names))
    with named_errors("pycolmap: features"):
        extract(some, tried)
    with colmap.Database.open(tried) as opened:
        if opened.num_keypoints() < len(some) * settings.max_features / 4:
            extraction.sift.first_octave = -1
    tried.unlink()
    stages.in_parts("features", names, 4, extract)
    with colmap.Database.open(database) as opened:
        matched = opened.num_matched_image_pairs() > 0
    if not matched:  # SIFT returns up to twice the requested number, and the time for matching is quadratic in it
        _keep_largest(colmap, database, database, settings.max_features)
    if settings.matching == "sequential":
        steps = {*range(1, SEQUENTIAL + 1), *(2**i for i in range(SEQUENTIAL))}
        pairs = [pair for step in sorted(steps) for pair in zip(names, names[step:])]
    else:
        pairs = list(itertools.combinations(names, 2))
        if settings.matching == "auto" and len(names) > FEW_IMAGES:
            few, chosen = stages.work / "few.db", stages.work / "pairs.json"
            if not chosen.is_file():
                if few.is_file():
                    check_database(colmap, few, sizes)
                else:
                    _keep_largest(colmap, database, few, LARGEST_FEATURES)
                match(few, "pairs", pairs)
                write_text(chosen, json.dumps(_choose_pairs(colmap, few)))
            pairs = read_pairs(chosen, names)
    match(database, "matches", pairs)


def _keep_largest(colmap: Any, database: Path, target: Path, most: int) -> None:
    """Copies a database with only the largest features of each image; both paths may be equal."""
    part = _copied(database, target.with_suffix(".part"))
    with colmap.Database.open(part) as opened:
        kept = {}
        for image in opened.read_all_images():
            places, descriptors = opened.read_keypoints(image.image_id), opened.read_descriptors(image.image_id)
            # A feature is x, y and a scale, or x, y and an affine shape of 2 x 2.
            a, *rest = places[:, 2:].T
            area = np.abs(a * rest[2] - rest[0] * rest[1]) if len(rest) == 3 else a**2
            top = np.argsort(-area, kind="stable")[:most]
            kept[image.image_id] = places[top], type(descriptors)(data=descriptors.data[top], type=descriptors.type)
        opened.clear_keypoints()
        opened.clear_descriptors()
        for number, (places, descriptors) in kept.items():
            opened.write_keypoints(number, places)
            opened.write_descriptors(number, descriptors)
    os.replace(part, target)


def _choose_pairs(colmap: Any, few: Path) -> list[Pair]:
    """Returns the pairs to match with all features: for each image its best partners, and the next images by name."""
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
    """Reconstructs ``count`` images with ``mapper``; "auto" tries the mappers in order until a model is good."""
    spread = spreads(matches)
    strong, models = strong_pairs(matches, wide_pairs(matches, spread)), list[Model]()
    for name, repeat in itertools.product(MAPPERS[1:], (False, True)):
        folded = bool(models) and models[-1].folded
        good = any(_sound(model, GOOD_SHARE * count) and not (model.folded or model.lost) for model in models)
        if good or mapper not in ("auto", name) or (repeat and not folded):
            continue
        database, line = stages.work / "database.db", f"{name} mapping"
        if repeat:
            trusted = trusted_pairs(matches, spread)
            database = _keep_pairs(stages.colmap, database, trusted)
            line += f" by {len(trusted)} pairs of {len(matches.pairs)}"
        try:
            model = _map(stages, f"{name}_again" if repeat else name, database, matches, strong)
        except SceneError as error:  # for example, a model with focal lengths that are not finite
            say(f"{line}: no model: {error}")
            continue
        say(f"{line}: {_described(model, count)}")
        models += [model] if model is not None else []
    return models


def _read_matches(stages: Stages) -> Matches:
    """Returns COLMAP's geometrically verified matches."""
    colmap, pairs = stages.colmap, {}
    with colmap.Database.open(stages.work / "database.db") as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        features = {name: opened.read_keypoints(number)[:, :2] for number, name in names.items()}
        for pair, count in zip(*opened.read_two_view_geometry_num_inliers()):
            if count:
                a, b = colmap.pair_id_to_image_pair(pair)
                rows = np.asarray(opened.read_two_view_geometry(a, b).inlier_matches)
                pairs[names[a], names[b]] = rows.astype(np.int64)
    return Matches(features, pairs)


def _keep_pairs(colmap: Any, database: Path, pairs: Collection[Pair]) -> Path:
    """Copies a database with only the matches of ``pairs``, and returns the copy's path."""
    kept = database.with_name("trusted.db")
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
    """Returns whether a model has no faults and at least ``least`` cameras."""
    return not model.faults and len(model.images) >= least


def _best(models: Sequence[Model], count: int) -> Model:
    """Returns the best model of ``count`` images, by these criteria in order.

    No faults and enough cameras; not folded; most cameras; fewest dropped cameras; least error. A contradicted pair
    counts as a missing camera, since it shows that cameras are wrong.
    """

    def worth(model: Model) -> tuple[float, ...]:
        cameras, folded = len(model.images) - model.contradicted, model.contradicted * model.folded
        return _sound(model, LEAST_SHARE * count), -folded, cameras, -len(model.lost), -model.error

    return max(models, key=worth)


def _map(stages: Stages, name: str, database: Path, matches: Matches, strong: Sequence[Pair]) -> Model | None:
    """Runs the mapper that ``name`` begins with (before any `_`); returns its largest model, or None for no model."""
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

        # COLMAP runs in a thread, since Ctrl-C could not interrupt it in the main thread.
        thread = threading.Thread(target=find, name=MAPPER, daemon=True)
        thread.start()
        while thread.is_alive():
            thread.join(0.5)
            logs = sorted(stages.work.glob(f"{LOG}*.{os.getpid()}")) if mapper == "global" else []
            started = BEGINS.findall(logs[-1].read_text(errors="replace")) if logs else []
            stages.progress(": ".join((f"{mapper} mapping {again}".rstrip(), *started[-1:])), len(placed), 0)
        with named_errors("pycolmap: mapping"):
            for failure in errors:
                raise failure
        os.replace(part, folder)
    models = [path for path in folder.iterdir() if (path / "images.bin").is_file()]
    if not models:
        return None
    largest = max(models, key=lambda path: len(read_model(path).images))
    model = read_model(largest)
    check_model(model, matches.features)
    lost = _lost(model)
    images = [image for image in model.images if image.name not in lost]
    origins = torch.from_numpy(np.stack([image.pose[:3, 3] for image in model.images]))
    bounds = [bound for image in images if (bound := depth_bounds(image, points_seen(image, model))) is not None]
    depths = torch.tensor(bounds, dtype=torch.float32, device="cpu")
    faults = camera_faults(origins, depths, ((image.camera.lens, image.camera.width) for image in images))
    _keep_model(largest)
    with named_errors(f"pycolmap: {largest}"):
        error = float(colmap.Reconstruction(largest).compute_mean_reprojection_error())
    side = max(max(image.camera.width, image.camera.height) for image in model.images)
    if error > max(LARGEST_ERROR, ERROR_SHARE * side):
        faults.append(f"its points are off by {error:.2f} pixels")
    return Model(largest, images, lost, error, faults, *contradicted_pairs(matches, strong, images))


def _lost(model: ColmapModel) -> dict[str, str]:
    """Returns why cameras of a model are dropped, by image name: few points, or a place far from other cameras."""
    far = lost_cameras(torch.from_numpy(np.stack([image.pose[:3, 3] for image in model.images])))
    held, uses = [len(points_seen(image, model)) for image in model.images], Counter(i.camera for i in model.images)
    usual, lost = float(np.median(held)), {}
    for image, is_far, seen in zip(model.images, far.tolist(), held):
        if is_far:
            lost[image.name] = "far from the others"
        elif seen < LEAST_HELD:
            lost[image.name] = f"held by {seen} points"
        elif uses[image.camera] == 1 and seen < ALONE_HELD * usual:
            lost[image.name] = f"alone with its lens, and held by {seen} points, others by {usual:.0f}"
    return lost


def _described(model: Model | None, images: int) -> str:
    if model is None:
        return "no model"
    remarks = "".join(f"; {fault}" for fault in [*model.faults, *[_contradiction(model)] * model.folded])
    if model.lost:
        remarks += f"; without the cameras of {some_of([f'{name} ({why})' for name, why in model.lost.items()])}"
    return f"{len(model.images)} of {images} images, points off by {model.error:.2f} pixels{remarks}"


def _contradiction(model: Model) -> str:
    """Returns a phrase that describes the fault of a folded model, for a message."""
    what = f"contradicts {model.contradicted} of {model.strong} pairs of images that match well over much of both"
    return f"{what}: something may look alike from several sides"


def _write_sound(colmap: Any, model: Model, folder: Path) -> None:
    """Writes the cameras, images and points of a model, without the images whose cameras are dropped."""
    part = emptied(folder.with_name(f".{folder.name}"))
    with named_errors(f"pycolmap: {model.folder}"):
        reconstruction = colmap.Reconstruction(model.folder)
        for image in list(reconstruction.images.values()):
            if image.name in model.lost:
                reconstruction.deregister_frame(image.frame_id)
        reconstruction.write_binary(part)
    _keep_model(part)
    os.replace(part, folder)


def _keep_model(folder: Path) -> None:
    """Removes the files of rigs beside the cameras, images and points of a model: each image has its pose."""
    for path in folder.iterdir():
        if path.stem not in FILES:
            path.unlink()


def _write_masks(files: Sequence[Path], masks: Path, folder: Path) -> None:
    """Writes masks in COLMAP's format: black where an image is transparent, or black in its mask in ``masks``."""
    if folder.is_dir():
        for path in files:  # COLMAP would decode other formats and any size
            if read_header(mask := folder / f"{path.name}.png").size != read_header(path).size:
                raise SceneError(f"{mask}: must have as many pixels as {path.name}")
        return
    part = emptied(folder.with_name(f".{folder.name}"))
    for path in files:
        pixels = read_image(path, 1)
        opaque = pixels[..., 3] >= OPAQUE if pixels.shape[-1] == 4 else np.ones(pixels.shape[:2], dtype=bool)
        if (mask := masks / f"{path.name}.png").is_file():
            opaque &= read_mask(mask, path.name, read_header(path))
        Image.fromarray(opaque).save(part / f"{path.name}.png")
    os.replace(part, folder)


def _write_reduced(files: Sequence[Path], folder: Path, factor: int) -> None:
    """Writes the images reduced by area averaging, unless the folder exists or they would be too small."""
    if folder.is_dir() or max(max(read_header(path).size) for path in files) // factor < LEAST_SIDE:
        return
    part = emptied(folder.with_name(f".{folder.name}"))
    for path in files:
        with Image.open(path) as image:
            kept = {} if path.suffix.lower() == ".png" else {"quality": 95, "exif": image.getexif()}
            kept["icc_profile"] = image.info.get("icc_profile")
            indexed = image.mode in ("P", "1")
            shown = image.convert("RGBA" if read_header(path).alpha else "RGB") if indexed else image
            shown.reduce(factor).save(part / path.name, **kept)
    os.replace(part, folder)


def _copied(database: Path, part: Path) -> Path:
    """Copies a database in place of an existing one, and returns the path of the copy."""
    _remove_database(part)
    shutil.copyfile(database, part)
    return part


def _remove_database(path: Path) -> None:
    """Removes a database and its write-ahead log, which SQLite would replay into the next database of this name."""
    for file in path.parent.glob(f"{path.name}*"):
        file.unlink()
