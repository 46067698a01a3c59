"""Agisoft Metashape's `cameras.xml` (File, Export, Export Cameras), with the photographs in `images` beside it.

A camera has a label, which is the name of its image with or without suffix, the number of its sensor, and 16 numbers:
its pose in the chunk, x to the right, y down. A sensor has a lens: focal length f, its addition b1 in x, the principal
point off the middle, and the terms of Metashape's frame or fisheye model, of which p1 and p2 are OpenCV's p2 and p1.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from voronerf.app.scenes.errors import SceneError
from voronerf.app.scenes.folders import listed_images, stay_inside
from voronerf.app.scenes.photographs import Reading, hold_out
from voronerf.app.scenes.scene import Scene
from voronerf.app.scenes.transforms import LARGEST, Frame, Listed, capture_scene, pose_of

FILE = "cameras.xml"
Element = ElementTree.Element
#: The largest skew that is left out, in pixels at 45 degrees off the axis.
SKEW = 0.5


def load_metashape(folder: Path, reading: Reading) -> Scene:
    """Loads a capture; every 8th image in the order of their names is held out for testing.

    Positions are those of the chunk times its scale, which are metres where Metashape knows them.

    Raises:
        SceneError: the file is broken, a lens is not supported, or an image is missing or has two names.
    """
    path = folder / FILE
    stay_inside(path, folder, reading.allow_outside)
    data = path.read_bytes()
    try:
        if b"<!DOCTYPE" in data:  # which could expand to any size
            raise ElementTree.ParseError("it has a document type")
        chunk = ElementTree.fromstring(data).find("chunk")
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise SceneError(f"{path}: is no XML of Metashape: {error}") from None
    if chunk is None:
        raise SceneError(f"{path}: has no chunk")
    images = _images(folder, reading.allow_outside)
    lenses = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    scales = {part.get("id"): _scale(part, path) for part in chunk.iterfind("components/component")}
    whole = _scale(chunk, path)
    read: dict[str | None, dict[str, Any]] = {}
    frames, skipped = [], 0
    for camera in chunk.iterfind(".//cameras//camera"):
        label, sensor = camera.get("label", ""), camera.get("sensor_id")
        text = camera.findtext("transform")
        if text is None or camera.get("enabled") in ("false", "0"):
            skipped += 1  # which Metashape has not aligned
            continue
        where = f"{path}: camera {label!r:.60}"
        image = images.get(label) or images.get(label.rpartition(".")[0])
        if image is None:
            raise SceneError(
                f"{where}: {'has more than one image' if label in images else 'has no image'} in {folder / 'images'}"
            )
        if sensor not in lenses:
            raise SceneError(f"{where}: has no sensor")
        if sensor not in read:
            read[sensor] = _lens(lenses[sensor], path)
        numbers = _numbers(text, 16, where)
        pose = pose_of([numbers[row : row + 4] for row in range(0, 16, 4)], where, "transform")
        pose[:3, 1:3] *= -1
        pose[:3, 3] *= scales.get(camera.get("component_id"), whole)
        frames.append(Frame(image, pose, read[sensor]))
    if len(frames) < 2:
        raise SceneError(f"{path}: has {len(frames)} aligned cameras, there must be at least two")
    frames.sort(key=lambda frame: frame.path)
    about = f"Metashape's {FILE} of {len(frames)} images" + (f", {skipped} more have no pose" if skipped else "")
    return capture_scene(folder, [Listed(path, {}, frame) for frame in frames], hold_out(len(frames)), reading, about)


def _images(folder: Path, allow_outside: bool) -> dict[str, Path | None]:
    """Images by their names with and without suffix; None for a name that two have."""
    place = folder / "images"
    if not place.is_dir():
        raise SceneError(f"{place}: there is no such folder")
    found: dict[str, Path | None] = {}
    for image in listed_images(place):
        stay_inside(image, folder, allow_outside)
        found[image.stem] = None if image.stem in found else image
        found[image.name] = image
    return found


def _lens(sensor: Element, path: Path) -> dict[str, Any]:
    """The entries of a transforms file for a sensor."""
    where = f"{path}: sensor {sensor.get('label', '')!r:.60}"
    lenses = sensor.findall("calibration")
    adjusted = [lens for lens in lenses if lens.get("class") == "adjusted"]
    if not lenses:
        raise SceneError(f"{where}: has no calibration")
    lens = (adjusted or lenses)[0]
    kind = lens.get("type") or sensor.get("type")
    if kind not in ("frame", "fisheye"):
        raise SceneError(f"{where}: must be of type frame or fisheye, got {kind!r:.60}")
    size = lens.find("resolution")
    size = sensor.find("resolution") if size is None else size
    width, height = (
        _numbers(size.get(side, "") if size is not None else "", 1, where)[0] for side in ("width", "height")
    )
    terms = {
        child.tag: _numbers(child.text or "", 1, where)[0]
        for child in lens
        if child.tag != "resolution" and len(child) == 0 and child.tag[:1] in "fckpb"
    }
    if abs(terms.get("b2", 0.0)) > SKEW:
        raise SceneError(f"{where}: skew (b2) is not supported, got {terms['b2']:g}; align without it")
    if "f" not in terms:
        raise SceneError(f"{where}: has no focal length f")
    k = {f"k{i}": terms.get(f"k{i}", 0.0) for i in range(1, 5)}
    return {
        "fl_x": terms["f"] + terms.get("b1", 0.0),
        "fl_y": terms["f"],
        "cx": width / 2 + terms.get("cx", 0.0),
        "cy": height / 2 + terms.get("cy", 0.0),
        "w": width,
        "h": height,
        **k,
        "p1": terms.get("p2", 0.0),
        "p2": terms.get("p1", 0.0),
        "is_fisheye": kind == "fisheye",
    }


def _scale(part: Element, path: Path) -> float:
    """By which lengths of a chunk or of one of its components are multiplied."""
    text = part.findtext("transform/scale")
    scale = 1.0 if text is None else _numbers(text, 1, f"{path}: scale")[0]
    if not scale >= 1 / LARGEST:
        raise SceneError(f"{path}: scale must be positive, got {scale:g}")
    return scale


def _numbers(text: str, count: int, where: str) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) <= LARGEST for value in values):
        raise SceneError(f"{where}: must have {count} finite numbers, got {text!r:.60}")
    return values
