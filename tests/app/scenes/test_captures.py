"""Captures of phones and of Metashape: the scene is that of a transforms file with the same cameras."""

import json
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from helpers import refuses
from PIL import Image
from scene_files import quaternion

from voronerf.app.scenes import SceneError, load_scene
from voronerf.app.scenes.lenses import COEFFICIENTS, FISHEYE
from voronerf.nerf import orbit_cameras

COUNT, SIZE = 9, (24, 16)
POSES = orbit_cameras(COUNT, radius=3.0, elevation=20.0, width=8, height=8, focal=8.0).poses.double().numpy()
# From the scene's axes, z up, to those of phones, y up.
PHONE = np.linalg.inv([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def write_images(folder, names):
    folder.mkdir(parents=True)
    for index, name in enumerate(names):
        Image.fromarray(np.full((SIZE[1], SIZE[0], 3), 10 * index, np.uint8)).save(folder / name)


def write_polycam(folder, kind=""):
    write_images(folder / f"keyframes/{kind}images", [f"{index}.jpg" for index in range(COUNT)])
    cameras = folder / f"keyframes/{kind}cameras"
    cameras.mkdir()
    for index, pose in enumerate(POSES):
        rows = {f"t_{i}{j}": float((PHONE @ pose)[i, j]) for i in range(3) for j in range(4)}
        values = {"fx": 30.0, "fy": 31.0, "cx": 12.5, "cy": 7.5, "width": SIZE[0], "height": SIZE[1], "blur_score": 9}
        (cameras / f"{index}.json").write_text(json.dumps({**rows, **values}))


def write_record3d(folder):
    write_images(folder / "rgb", [f"{index}.png" for index in range(COUNT)])
    poses = []
    for pose in POSES:
        w, x, y, z = quaternion((PHONE @ pose)[:3, :3])
        poses.append([x, y, z, w, *(PHONE @ pose)[:3, 3]])
    contents = {"w": SIZE[0], "h": SIZE[1], "K": [30.0, 0, 0, 0, 31.0, 0, 11.0, 9.0, 1], "poses": poses}
    (folder / "metadata.json").write_text(json.dumps(contents))


def write_metashape(folder, scale=2.0, kind="frame", **terms):
    """Every camera has a label with a suffix or without; the last is not aligned."""
    write_images(folder / "images", [f"DSC {index}.jpg" for index in range(COUNT + 1)])
    root = ElementTree.Element("document", version="2.0.0")
    chunk = ElementTree.SubElement(root, "chunk")
    sensor = ElementTree.SubElement(ElementTree.SubElement(chunk, "sensors"), "sensor", id="3", type=kind, label="D850")
    size = {"width": str(SIZE[0]), "height": str(SIZE[1])}
    for which, f in (("initial", 99.0), ("adjusted", 31.0)):
        lens = ElementTree.SubElement(sensor, "calibration", {"type": kind, "class": which})
        ElementTree.SubElement(lens, "resolution", size)
        for name, value in {"f": f, **terms}.items():
            ElementTree.SubElement(lens, name).text = str(value)
    part = ElementTree.SubElement(ElementTree.SubElement(chunk, "components"), "component", id="7")
    ElementTree.SubElement(ElementTree.SubElement(part, "transform"), "scale").text = str(scale)
    group = ElementTree.SubElement(ElementTree.SubElement(chunk, "cameras"), "group")
    for index in range(COUNT + 1):
        label = f"DSC {index}" + ".jpg" * (index % 2)
        camera = ElementTree.SubElement(group, "camera", sensor_id="3", component_id="7", label=label)
        if index < COUNT:
            pose = POSES[index] * [1, -1, -1, 1]
            pose[:3, 3] /= scale
            ElementTree.SubElement(camera, "transform").text = " ".join(map(str, pose.flatten()))
    ElementTree.ElementTree(root).write(folder / "cameras.xml")


def read(folder, **options):
    """The cameras in the order of their images, the images' greys, and the scene."""
    scene = load_scene(folder, normalise=False, **options)
    order = [int(name.split()[-1]) for name in (*scene.train.names, *scene.test.names)]
    poses = torch.cat((scene.train.cameras.poses, scene.test.cameras.poses))[np.argsort(order)]
    lenses = torch.cat((scene.train.cameras.intrinsics, scene.test.cameras.intrinsics))
    greys = torch.cat((scene.train.images, scene.test.images))[np.argsort(order), 0, 0, 0]
    return poses.double().numpy(), lenses.numpy(), greys.tolist(), scene


@pytest.mark.parametrize(
    ("write", "lens", "says"),
    [
        (write_polycam, (30, 31, 12.5, 7.5), "Polycam's cameras of 9 images, as the phone tracked them"),
        (write_record3d, (30, 31, 12, 8), "Record3D's metadata.json of 9 images"),
        (
            lambda folder: write_metashape(folder, b1=-1.0, cx=0.5, cy=-0.5),
            (30, 31, 12.5, 7.5),
            "Metashape's cameras.xml of 9 images, 1 more have no pose",
        ),
    ],
    ids=["polycam", "record3d", "metashape"],
)
def test_a_capture_has_the_poses_it_was_made_of(tmp_path, write, lens, says):
    write(tmp_path)
    poses, lenses, greys, scene = read(tmp_path)
    assert np.abs(poses - POSES).max() < 1e-5
    assert np.abs(lenses - lens).max() < 1e-5
    assert np.abs(np.array(greys) - 10 * np.arange(COUNT)).max() <= 2  # JPEG
    assert says in scene.notes and len(scene.test) == 2


def test_refined_cameras_of_polycam_come_first(tmp_path):
    write_polycam(tmp_path)
    write_polycam(tmp_path, "corrected_")
    assert "Polycam's cameras of 9 images, as Polycam refined them" in read(tmp_path)[3].notes
    (tmp_path / "keyframes/corrected_images").rename(tmp_path / "keyframes/gone")
    refuses("corrected_images: there is no such folder", load_scene, tmp_path, error=SceneError)


def test_lenses_of_metashape(tmp_path):
    terms = {"k1": 0.01, "k2": -0.02, "k3": 0.03, "p1": 0.001, "p2": 0.002}
    write_metashape(tmp_path / "frame", **terms)
    distortion = read(tmp_path / "frame")[3].train.cameras.distortion[0]
    write_metashape(tmp_path / "fisheye", kind="fisheye", k1=0.01, k4=0.02)
    fisheye = read(tmp_path / "fisheye")[3].train.cameras
    # Metashape's x is x (1 + k1 r^2 + ...) + p1 (r^2 + 2 x^2) + 2 p2 x y; OpenCV's has p2 and p1 there.
    ours = dict(zip(("k1", "k2", "p1", "p2", "k3"), distortion.tolist()))
    assert ours == pytest.approx({"k1": 0.01, "k2": -0.02, "k3": 0.03, "p1": 0.002, "p2": 0.001})
    assert (fisheye.models == FISHEYE).all() and fisheye.distortion[
        0, COEFFICIENTS[FISHEYE].index("k4")
    ] == pytest.approx(0.02)


def test_broken_captures_are_one_line(tmp_path):
    def refused(name, write, break_it, reason, **options):
        folder = tmp_path / name
        write(folder, **options)
        break_it(folder)
        refuses(reason, load_scene, folder, error=SceneError)

    def text(file, old, new):
        return lambda folder: (folder / file).write_text((folder / file).read_text().replace(old, new))

    xml, camera, meta = "cameras.xml", "keyframes/cameras/3.json", "metadata.json"
    cases = [
        (write_metashape, text(xml, "<chunk>", ""), "is no XML of Metashape"),
        (write_metashape, text(xml, "<document", "<!DOCTYPE a><document"), "it has a document type"),
        (write_metashape, text(xml, "chunk>", "lump>"), "has no chunk"),
        (write_metashape, text(xml, "<f>31.0</f>", ""), "has no focal length f"),
        (write_metashape, text(xml, "<f>31.0</f>", "<f>inf</f>"), "must have 1 finite numbers, got 'inf'"),
        (write_metashape, text(xml, 'label="DSC 3.jpg"', 'label="none"'), "camera 'none': has no image in"),
        (write_metashape, text(xml, 'sensor_id="3"', 'sensor_id="4"'), "has no sensor"),
        (write_metashape, text(xml, "<scale>2.0", "<scale>0"), "scale must be positive, got 0"),
        (write_metashape, text(xml, 'type="frame"', 'type="spherical"'), "must be of type frame or fisheye"),
        (write_polycam, text(camera, '"t_00"', '"u_00"'), "t_00 to t_23 is not a matrix of numbers"),
        (write_polycam, text(camera, '"fx": 30.0', '"fx": "a"'), "fl_x must be a finite number"),
        (write_polycam, text(camera, '"width": 24', '"width": 25'), "is 24 x 16 pixels, but"),
        (write_polycam, lambda folder: (folder / camera).write_text("[]"), "must be an object of JSON"),
        (write_record3d, lambda folder: (folder / meta).write_text("{"), "metadata.json"),
        (write_record3d, text(meta, '"poses"', '"places"'), "poses must be lists of 7 numbers"),
        (write_record3d, text(meta, '"K": [30.0, ', '"K": ['), "K must be lists of 9 numbers"),
        (write_record3d, lambda folder: (folder / "rgb/8.png").rename(folder / "rgb/80.png"), "numbered to 80"),
    ]
    for index, case in enumerate(cases):
        refused(str(index), *case)
    refused("skew", write_metashape, lambda folder: None, "skew (b2) is not supported, got 3", b2=3.0)
    refused("k4", write_metashape, lambda folder: None, "lens distortion k4 is not supported", k4=0.1)
