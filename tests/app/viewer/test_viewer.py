"""Tests of the viewer with simulated browser tabs."""

from __future__ import annotations

import contextlib
import io
import re
import socket
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from http.client import HTTPConnection

import numpy as np
import pytest
import torch
from helpers import refuses, same
from PIL import Image

pytest.importorskip("viser", reason="viser is not installed")

import viser
from tab import CAMERA, Tab
from websockets.exceptions import ConnectionClosed

from voronerf.app import open_run
from voronerf.app.cli import main
from voronerf.app.cli.opening import crop_box
from voronerf.app.evaluate.panels import palette
from voronerf.app.render.paths import read_camera_path
from voronerf.app.scenes.record import read_scene
from voronerf.app.train import Callback, ConfigError, Scores, TrainConfig, build, train
from voronerf.app.train import run as run_training
from voronerf.app.viewer import view_run, watch
from voronerf.app.viewer.cameras import angle_of_view, scene_bounds
from voronerf.nerf import Renderer, Stratified, orbit_cameras


@pytest.fixture
def tab(viewer, scene):
    tab = Tab(viewer, scene.test.cameras)
    yield tab
    tab.close()


def apart(picture, colour):
    """Returns the mean difference in levels between a JPEG and the rendered colour [h, w, 3]."""
    shown = (colour.clamp(0, 1) * 255).round().numpy()
    assert picture.shape == shown.shape
    return np.abs(picture.astype(float) - shown).mean()


def larger(cameras, side):
    """Returns the cameras with images of `side` x `side` pixels."""
    factor = side / cameras.width
    return replace(cameras, intrinsics=cameras.intrinsics * factor, width=side, height=side)


def test_a_camera_at_rest_sees_what_render_gives(run, scene, tab) -> None:
    tab.rest()
    for index, side in ((1, 128), (0, 192)):
        tab.look(scene.test.cameras, index)
        tab.set("Pixels", side)
        assert apart(tab.rest(), run.render(larger(scene.test.cameras, side), index).colour) < 1.5
    assert min(len(picture) for picture in tab.pictures) < 128  # coarse pictures came first


def test_panes(run, scene, tab) -> None:
    tab.rest()
    image = run.render(larger(scene.test.cameras, 128), 0)
    pictures = {}
    for pane in ("depth", "opacity", "cells"):
        tab.set("Show", pane)
        pictures[pane] = tab.rest()
    assert apart(pictures["opacity"], image.opacity[..., None].expand(128, 128, 3)) < 1.5
    solid, near = image.opacity.numpy() > 0.95, torch.nn.functional.max_pool2d(image.opacity[None], 17, 1, 8)[0]
    empty = near.numpy() < 0.01  # outside the ringing of the JPEG's 8 x 8 blocks
    assert empty.any() and pictures["depth"][empty].min() > 240 and pictures["depth"][solid].mean() < 200
    # A pixel of the cells pane has the hue of its leaf cell.
    hues = palette(run.diagram.num_cells).numpy().astype(float)
    leaves = run.diagram.locate(image.heaviest).long().numpy()[solid]
    shown = pictures["cells"][solid].astype(float)
    cosine = (hues[leaves] * shown).sum(-1) / np.linalg.norm(hues[leaves], axis=-1) / np.linalg.norm(shown, axis=-1)
    assert np.mean(cosine > 0.98) > 0.9


def test_the_field_of_view_and_the_background_are_chosen(run, scene, tab) -> None:
    seen = tab.rest()
    solid = run.render(larger(scene.test.cameras, 128), 0).opacity.numpy() > 0.999
    for name, level in (("black", 0), ("grey", 128), ("white", 255)):
        tab.set("Background", name)
        picture = tab.rest()
        assert np.abs(picture[:8, :8].astype(float) - level).max() < 4
        assert np.abs(picture[solid].astype(float) - seen[solid]).mean() < 2
    tab.set("Field of view", 60)
    picture, cameras = tab.rest(), larger(scene.test.cameras, 128)
    cameras.intrinsics[:, :2] = 64 / np.tan(np.radians(30))
    assert apart(picture, run.render(cameras, 0).colour) < 1.5


def test_a_narrow_canvas_opens_at_all_of_the_first_view_with_folded_settings(viewer, scene, tab) -> None:
    tab.rest()
    tab.until(lambda: "GuiUplotMessage" in tab.gui)
    assert "Settings" not in tab.gui
    with closing(Tab(viewer, scene.test.cameras, size=(39, 84), number=1)) as phone:
        phone.until(lambda: "GuiUplotMessage" in phone.gui)
        folder = phone.gui["Settings"]
        assert folder["expand_by_default"] is False
        inside = {label for label, part in phone.gui.items() if part["folder"] == folder["uuid"]}
        assert inside >= {"Show", "Pixels", "Cells", "GuiUplotMessage"}
        phone.until(lambda: "Field of view" in phone.gui and 1 in viewer.clients)
        fov = np.degrees(viewer.clients[1].handle.camera.fov)
        across = 2 * np.degrees(np.arctan(np.tan(np.radians(fov / 2)) * 39 / 84))
        wide = 2 * np.degrees(np.arctan(scene.test.cameras.width / 2 / float(scene.test.cameras.intrinsics[0, 0])))
        assert abs(across - wide) < 0.1
        phone.until(lambda: abs(phone.gui["Field of view"]["value"] - fov) <= 0.5)
        again = Tab(viewer, replace(scene.test.cameras, intrinsics=scene.test.cameras.intrinsics * 2), number=2)
        again.rest()  # like a browser that reconnects
        assert abs(viewer.clients[2].handle.camera.fov - 2 * np.arctan(np.tan(viewer.clients[0].fov / 2) / 2)) < 1e-3
        again.close()


def test_a_slow_page_opens_at_all_of_the_first_view(viewer, scene) -> None:
    """A page that first sends viser's wider angle of view still opens with the viewer's angle."""
    before = replace(scene.test.cameras, intrinsics=scene.test.cameras.intrinsics / 2)
    with closing(Tab(viewer, before, size=(39, 84))) as phone:
        client = phone.until(lambda: viewer.clients.get(0))
        assert client.handle.camera.fov == client.fov > 1.1 * viewer.server.initial_camera.fov
        phone.look(scene.test.cameras)
        opened = angle_of_view(scene.test.cameras, 0, 39 / 84)
        phone.until(lambda: np.isclose(client.handle.camera.fov, opened))
        phone.until(lambda: phone.gui["Field of view"]["value"] == round(np.degrees(opened)))
        phone.look(scene.test.cameras)  # the page may return to this angle later
        phone.until(lambda: np.isclose(client.fov, viewer.server.initial_camera.fov))
        assert np.isclose(client.handle.camera.fov, client.fov)


@pytest.mark.slow
def test_the_line_about_the_picture(viewer, scene, tab) -> None:
    def said():
        return " ".join(part["_markdown"] or "" for part in tab.gui.values() if "_markdown" in part)

    tab.rest()
    tab.until(lambda: "128 x 128 pixels in " in said())
    lines = []
    for number in range(40):  # movements in quick succession
        tab.look(scene.test.cameras, number % 2)
        viewer.render_next()
        tab.read()
        lines.append(said())  # a slow machine may draw the sharp picture in between
    assert re.search(r"rendering (9[6-9]|1..) x \S+ pixels, \d+ frames a second", " ".join(lines))
    assert min(len(picture) for picture in tab.pictures) >= 96


@pytest.mark.slow
def test_cells_are_described_hidden_and_kept_alone(run, scene, tab) -> None:
    tab.rest()
    tab.set("Show", "cells")
    tab.rest()
    image = run.render(larger(scene.test.cameras, 128), 0)
    y, x = divmod(int(torch.where(image.opacity > 0.99, 1 / image.depth, 0).argmax()), 128)
    leaf = int(run.diagram.locate(image.heaviest[y, x]))
    info = tab.gui["Click or tap a cell."]

    def pick(x, y):
        info["_markdown"] = None
        tab.click((x + 0.5) / 128, (y + 0.5) / 128)
        return tab.until(lambda: info["_markdown"])

    text = pick(x, y)
    tab.set("Show", "opacity")  # grey except for the outline
    outlined = (tab.rest() * torch.tensor([1, -1, 1]).numpy()).sum(-1) > 300
    cell_pixels = (run.diagram.locate(image.heaviest) == leaf) & (image.opacity > 0.5)
    near = torch.nn.functional.max_pool2d(cell_pixels[None].float(), 3, 1, 1)[0] > 0  # the page's pixels may be one off
    assert 0 < outlined.sum() < 0.5 * float(cell_pixels.sum()) and near.numpy()[outlined].all()
    assert cell_pixels.numpy()[outlined].mean() > 0.7
    tab.set("Show", "cells")
    tab.rest()
    assert f"**Cell {leaf}** of {run.diagram.num_cells}" in text and "centre " in text
    before = run.diagram.locate(image.heaviest) == leaf

    def shares():
        """Returns the fractions of the cell's pixels and of the other solid pixels that are still visible."""
        solid = (image.opacity > 0.95).numpy()
        now = tab.rest().min(-1) < 235
        mine = before.numpy() & solid
        return now[mine].mean(), now[solid & ~mine].mean()

    tab.set("Cell", "hide")
    hidden = shares()
    assert pick(x, y) != text
    tab.set("Cell", "show all")
    tab.rest()
    assert pick(x, y) == text
    tab.set("Cell", "only this")
    alone = shares()
    assert hidden[0] < 0.9 and alone[0] > 0.9 and alone[1] < hidden[1]
    tab.set("Level", 1)
    tab.rest()
    assert f"of {int(run.diagram.paths()[:, 0].max()) + 1}" in pick(x, y)
    assert pick(0, 0) == "Click or tap a cell."


def test_a_crop_leaves_what_is_inside(run, scene, tab) -> None:
    tab.rest()
    tab.set("Crop", True)
    whole = tab.rest()
    low, high = scene.box.tolist()
    tab.drag("/crop/high", [*high[:2], (low[2] + high[2]) / 2])
    part = tab.rest()
    assert (part[:40].min(-1) < 235).sum() < 0.3 * (whole[:40].min(-1) < 235).sum()
    assert abs(part[-40:].astype(float) - whole[-40:]).mean() < 3


def test_a_crop_is_saved_with_the_run(run, scene, tab, viewer) -> None:
    tab.rest()
    tab.set("Crop", True)
    low, beyond = scene.box[0].tolist(), [-9.0, -9.0, -9.0]
    tab.drag("/crop/low", [0.1, low[1], low[2]])
    tab.drag("/crop/high", beyond)  # the corners keep their order
    client = viewer.clients[0]
    tab.until(lambda: client.look.crop is not None and client.look.crop[1][0] < 0.3)
    corners = torch.tensor(client.look.crop)
    assert bool((corners[0] < corners[1]).all()) and torch.allclose(corners[0], torch.tensor([0.1, *low[1:]]))
    tab.set("Save crop", True)
    tab.until(lambda: tab.notes)
    assert torch.allclose(crop_box(run, "saved"), corners)
    (run.path / "crop.json").unlink()
    refuses("--crop saved needs a crop", crop_box, run, "saved", error=ConfigError)


def test_centres_and_cameras_are_drawn_into_the_scene(run, scene, tab) -> None:
    tab.rest()
    assert tab.depths[-1] is None
    tab.set("Centres", True)
    tab.rest()
    tab.set("Cameras", True)
    tab.rest()
    assert "/centres" in tab.nodes and sum(name.startswith("/cameras/") for name in tab.nodes) == len(scene.train)
    assert tab.nodes["/cameras/3"]["_image_data"] is not None
    depth = np.array(Image.open(io.BytesIO(tab.depths[-1])))[..., :3].astype(np.int64)
    depth = (depth * np.array((65536, 256, 1))).sum(-1) / 100_000
    middle = float(run.render(scene.test.cameras, 0).depth[12, 12])
    assert abs(np.median(depth[60:68, 60:68]) - middle) < 0.3 and depth.max() > 100
    tab.set("Cameras", False)
    tab.rest()
    assert not any(name.startswith("/cameras/") for name in tab.nodes)


@pytest.mark.slow
def test_keyframes_become_a_path_that_render_takes(run, scene, tab) -> None:
    tab.rest()
    for index in (0, 1):
        tab.look(scene.test.cameras, index)
        tab.rest()
        tab.set("Keyframes", "add")
        tab.until(lambda index=index: f"{index + 1} keyframe" in str(tab.gui["No keyframes."]))
    assert {"/keyframes/0", "/keyframes/1", "/keyframes/line"} <= set(tab.nodes)
    assert tab.nodes["/keyframes/0"]["thickness_units"] == "screen"  # otherwise lines cover large scenes
    tab.set("Seconds", 1.0)
    pictures = len(tab.pictures)
    tab.set("Preview", True)
    tab.until(lambda: len(tab.pictures) > pictures)
    tab.set("Save path", True)
    tab.until(lambda: tab.notes)
    path = read_camera_path(run.path / "camera_paths" / "path-1.json")
    assert (len(path.frames), path.fps, path.frames.width) == (24, 24, 128)
    ends = path.frames.poses[[0, -1]]
    assert torch.allclose(ends, scene.test.cameras.poses[:2], atol=1e-4)
    tab.set("Keyframes", "clear")
    tab.until(lambda: not any(name.startswith("/keyframes/") for name in tab.nodes))
    assert torch.allclose(path.keyframes.intrinsics[:, 1] * 24 / 128, scene.test.cameras.intrinsics[:2, 1], rtol=1e-4)


def test_each_tab_has_its_own_view_and_a_closed_one_costs_nothing(viewer, scene, tab) -> None:
    first = tab.rest()
    other = Tab(viewer, scene.test.cameras, 1, number=1)
    other.rest()
    other.set("Show", "opacity")
    other.rest()
    count = len(tab.pictures)
    assert np.array_equal(first, tab.pictures[-1]) and not np.array_equal(first, other.pictures[-1])
    tab.read()
    assert len(tab.pictures) == count
    other.look(scene.test.cameras, 0)
    other.close()
    tab.until(lambda: len(viewer.clients) == 1)
    while viewer.render_next():
        pass


def test_a_tab_may_close_at_any_time(run, scene, capfd) -> None:
    with warnings.catch_warnings(record=True) as warned, closing(view_run(run, port=0)) as viewer:
        tab = Tab(viewer, scene.test.cameras)
        tab.until(lambda: tab.pictures)
        client = viewer.clients[0]
        tab.close()
        while viewer.server.get_clients():
            time.sleep(0.01)
        viewer._draw_coarse(client)  # as if drawing had begun before the tab closed
        socket.create_connection(("127.0.0.1", viewer.port)).close()  # browsers open spare connections
        with closing(Tab(viewer, scene.test.cameras, number=1)) as other:
            other.until(lambda: other.pictures)
    assert not warned and capfd.readouterr().err == ""


def test_a_camera_may_stand_anywhere(scene, tab) -> None:
    near = tab.rest()
    poses = scene.test.cameras.poses.clone()
    poses[0, :3, 3] *= 3  # beyond the cameras' far distance
    tab.look(replace(scene.test.cameras, poses=poses), 0)
    far = tab.rest()
    share = (far.min(-1) < 220).sum() / (near.min(-1) < 220).sum()
    assert 0.06 < share < 0.2


def test_cameras_in_a_plane_have_space_around_them(scene) -> None:
    cameras = orbit_cameras(4, radius=2.0, elevation=0.0, width=8, height=8, focal=9.0)
    low, high = scene_bounds(replace(scene, box=None, train=replace(scene.train, cameras=cameras)))
    assert bool((high - low > 1).all()) and bool((low < -2).any()) and bool((high > 2).any())


def test_a_picture_at_rest_is_as_large_as_the_window(scene, tab) -> None:
    assert max(tab.rest().shape) == 128
    for size, longest in (((200, 150), 200), ((5000, 3000), 320)):
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr("voronerf.app.viewer.client.FULL", 320)
            tab.size = size
            tab.look(scene.test.cameras, 0)
            assert tab.rest().shape[1] == longest
    tab.set("Pixels", 160)
    tab.until(lambda: tab.viewer.list_clients()[0].longest == 160)
    tab.look(scene.test.cameras, 1)
    assert tab.rest().shape[1] == 160


def test_a_canvas_without_pixels_is_passed_over(scene, tab) -> None:
    picture = tab.rest()
    tab.size = (0, 0)
    tab.look(scene.test.cameras, 1)
    assert np.array_equal(tab.rest(), picture)
    tab.click(float("nan"), -3.0)
    tab.until(lambda: tab.viewer.tasks.empty())


@pytest.mark.slow
def test_a_training_is_the_same_with_a_viewer(tmp_path, scene, monkeypatch) -> None:
    monkeypatch.setattr("voronerf.app.viewer.client.SHARP", 128)
    config = TrainConfig(steps=40, cells=(3,), split_at=(20,), rays=128, samples=(16,), evaluations=2)
    plain, watched = build(config, scene), build(config, scene)
    scores, same_scores = Scores(None), Scores(None)
    run_training(plain, [scores])
    training = watch(watched, same_scores, port=0)
    viewer = training.viewer
    tab = Tab(viewer, scene.test.cameras)
    tab.until(lambda: "Show" in tab.gui)

    class Visitor(Callback):
        def after_step(self, state):
            if state.step == 10:
                tab.set("Show", "cells")
            if state.step == 30:
                tab.read()
                tab.set("Pause", True)
                tab.until(lambda: training.paused)
                reader.start()
            else:
                tab.look(scene.test.cameras, state.step % 2)

    def go_on_when_told():  # reads the tab while the training is paused
        end = time.monotonic() + 20
        while "3 cells" not in str(tab.gui.values()) and time.monotonic() < end:
            tab.read()
        tab.set("Pause", True)

    reader = threading.Thread(target=go_on_when_told)
    run_training(watched, [same_scores, Visitor(), training])
    reader.join()
    assert "3 cells" in str(tab.gui.values())
    tab.until(lambda: "Pause" not in tab.gui)
    assert len(tab.pictures) > 5
    tab.close()
    viewer.close()
    assert same(dict(plain.router.state_dict()), dict(watched.router.state_dict()))
    assert [line["psnr"] for line in scores.metrics] == [line["psnr"] for line in same_scores.metrics]


def test_nothing_is_rendered_for_nobody(scene) -> None:
    state = build(TrainConfig(steps=4, cells=(), rays=64, samples=(8,), evaluations=1), scene)
    scores = Scores(None)
    scores.metrics = [{"seconds": 1.0, "step": 1, "part": 1, "psnr": None}]  # was NaN
    training = watch(state, scores, port=0)
    training.tell()
    calls = []
    state.renderer.image = lambda *args, **options: calls.append(args)
    train(state, [training])
    training.viewer.close()
    assert state.step == 4 and not calls


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ({"port": 70_000}, "--port must be 0 to 65535, got 70000"),
        ({"host": "192.0.2.1"}, "--host 192.0.2.1 --port 8080: cannot listen there"),
        ({"host": "no such host"}, "--host no such host --port 8080: cannot listen there"),
    ],
)
def test_bad_addresses(run, address, message) -> None:
    refuses(message, view_run, run, error=ConfigError, **address)


@pytest.mark.parametrize(
    ("host", "asked", "origin", "status"),
    [
        ("127.0.0.1", "127.0.0.1:{}", None, 101),  # a program that is not a browser
        ("127.0.0.1", "127.0.0.1:{}", "http://127.0.0.1:{}", 101),
        ("127.0.0.1", "localhost:9", "http://localhost:9", 101),  # an SSH tunnel
        ("127.0.0.1", "127.0.0.1:{}", "https://example.org", 403),
        ("127.0.0.1", "127.0.0.1:{}", "http://127.0.0.1:9", 403),
        ("127.0.0.1", "127.0.0.1:{}", "null", 403),
        ("127.0.0.1", "example.org:{}", "http://example.org:{}", 403),  # DNS rebinding
        ("127.1", "127.0.0.1:{}", "http://127.0.0.1:{}", 101),
        ("127.1", "example.org:{}", "http://example.org:{}", 403),
        ("0.0.0.0", "192.0.2.7:{}", "http://192.0.2.7:{}", 101),  # any address of this machine
        ("0.0.0.0", f"{socket.gethostname()}:{{}}", f"http://{socket.gethostname()}:{{}}", 101),
        ("0.0.0.0", "example.org:{}", "http://example.org:{}", 403),
        ("0.0.0.0", f"{socket.gethostname()}.local:{{}}", None, 101),
        ("0.0.0.0", "example.local:{}", None, 403),
        ("0.0.0.0", "192.0.2.7:{}", "https://example.com", 403),
        ("0.0.0.0", "[::1:{}", None, 403),  # not an address
    ],
)
def test_pages_of_other_sites_are_refused(run, host, asked, origin, status) -> None:
    with closing(view_run(run, host=host, port=0)) as viewer:
        headers = {"Host": asked, "Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        headers |= {"Sec-WebSocket-Key": 22 * "A" + "==", "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}"}
        headers |= {} if origin is None else {"Origin": origin}
        with closing(HTTPConnection("127.0.0.1", viewer.port)) as browser:
            browser.request("GET", "/", headers={name: text.format(viewer.port) for name, text in headers.items()})
            assert browser.getresponse().status == status


@pytest.mark.parametrize(("asked", "status"), [("127.0.0.1:{}", 200), ("example.org:{}", 403)])
def test_the_page_that_draws_by_itself_is_served_beside(viewer, tab, asked, status) -> None:
    link = tab.until(lambda: next((text for text in tab.gui if text.startswith("[Draw it in this")), None))
    assert "](/scene.html)" in tab.gui[link]["_markdown"]

    def get():
        with closing(HTTPConnection("127.0.0.1", viewer.port, timeout=60)) as browser:
            browser.request("GET", "/scene.html", headers={"Host": asked.format(viewer.port)})
            answer = browser.getresponse()
            return answer.status, answer.read()

    with ThreadPoolExecutor() as pool:
        answer = pool.submit(get)
        tab.until(answer.done)
    assert answer.result()[0] == status
    assert (b"data:image/webp" in answer.result()[1]) == (status == 200)


def test_a_run_that_no_page_can_draw_has_no_link(run) -> None:
    plain = replace(run, renderer=Renderer({"field": run.renderer.field}, Stratified(8)))
    with closing(view_run(plain, port=0)) as viewer:
        assert viewer.page is None


BAD = {
    "half a corner": lambda tab: (tab.set("Crop", True), tab.drag("/crop/low", [1.0])),
    "a corner nowhere": lambda tab: (tab.set("Crop", True), tab.drag("/crop/high", [float("nan"), 1.0, 1.0])),
    "a long path": lambda tab: (tab.set("Keyframes", "add"), tab.set("Seconds", 1e9), tab.set("Save path", True)),
    "a large picture": lambda tab: tab.set("Pixels", 10**6),
    "another pane": lambda tab: tab.set("Show", "x" * 1000),
    "a click at no place": lambda tab: tab.click(0.5, None),
    "a camera of texts": lambda tab: tab.send("ViewerCameraMessage", **{**CAMERA, "position": ["a", "b", "c"]}),
    "half a camera": lambda tab: tab.send("ViewerCameraMessage", fov=1.0),
    "no message": lambda tab: tab.socket.send(b"\x93\x01"),
    "text": lambda tab: tab.socket.send("text"),
    "a large message": lambda tab: tab.socket.send(bytes(2**20)),
}
#: Odd messages that do not disconnect a client.
ODD = {
    "a text for a number": lambda tab: tab.set("Pixels", "many"),
    "a property": lambda tab: tab.send("GuiUpdateMessage", uuid=tab.gui["Pixels"]["uuid"], updates={"update_cb": 3}),
    "a public address": lambda tab: tab.send("ShareUrlRequest"),
    "a camera anywhere": lambda tab: tab.send("ViewerCameraMessage", **{**CAMERA, "position": [1e300, 0.0, 0.0]}),
    "a turn of no length": lambda tab: tab.send("ViewerCameraMessage", **{**CAMERA, "wxyz": [0.0] * 4}),
    "no angle": lambda tab: tab.send("ViewerCameraMessage", **{**CAMERA, "fov": 1e-300}),
    "a thin canvas": lambda tab: tab.send("ViewerCameraMessage", **{**CAMERA, "image_width": 10**9}),
    "a click far away": lambda tab: tab.click(1e300, float("inf")),
}


@pytest.mark.slow
def test_a_client_harms_itself_at_most(viewer, scene, caplog, capfd) -> None:
    other = Tab(viewer, scene.test.cameras)
    other.rest()
    for number, (name, send) in enumerate({**BAD, **ODD}.items(), 1):
        caplog.clear()
        bad = Tab(viewer, scene.test.cameras, number=number)
        bad.rest()
        with contextlib.suppress(ConnectionClosed):  # the server may hang up first
            send(bad)
        end, lines = time.monotonic() + (20.0 if name in BAD else 0.5), list[str]()
        while (number in viewer.clients or not lines) and time.monotonic() < end:  # the log may be late
            viewer.render_next()
            with contextlib.suppress(ConnectionClosed):
                bad.read()
            lines = [record.getMessage() for record in caplog.records if record.name.startswith("voronerf")]
        assert (number in viewer.clients) == (name in ODD), name
        assert len(lines) == 1 or name in ODD, (name, lines)
        assert all("\n" not in line and len(line) < 300 for line in lines)
        bad.close()
    other.set("Show", "depth")
    other.rest()
    other.close()
    assert "Traceback" not in capfd.readouterr().err


def test_properties_beside_a_value_are_passed_over(viewer, tab) -> None:
    tab.rest()
    for updates in ({"value": 200, "update_cb": []}, {"value": 192}):
        tab.send("GuiUpdateMessage", uuid=tab.gui["Pixels"]["uuid"], updates=updates)
    tab.until(lambda: viewer.clients[0].longest == 192)


def test_a_port_in_use_is_one_line(run, tmp_path, capsys) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for command in (["view", str(run.path)], ["train", "--view", "--out", str(tmp_path / "run")]):
            assert main([*command, "--port", port]) == 1
            lines = capsys.readouterr().err.splitlines()
            assert len(lines) == 1 and f"--host 127.0.0.1 --port {port}: cannot listen there" in lines[0]
    assert not (tmp_path / "run").exists()


def test_a_run_is_shown_without_its_images(run, scene, monkeypatch) -> None:
    monkeypatch.setattr("voronerf.app.viewer.client.SHARP", 128)
    record = read_scene(run.path / "scene.json")
    viewer = view_run(open_run(run.path, scene=record), port=0)
    with closing(viewer), closing(Tab(viewer, scene.test.cameras)) as tab:
        assert apart(tab.rest(), run.render(larger(scene.test.cameras, 128), 0).colour) < 1.5
        tab.set("Cameras", True)
        tab.rest()
        assert tab.nodes["/cameras/0"]["_image_data"] is None


def test_without_viser_it_is_one_line(run, monkeypatch, capsys) -> None:
    for name in [name for name in sys.modules if name.startswith("voronerf.app.viewer")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(run.path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "the viewer needs viser: pip install 'voronerf[viewer]'" in line
