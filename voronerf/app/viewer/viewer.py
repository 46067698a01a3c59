"""The viewer: a server, its clients, and which picture is rendered next.

One thread renders everything, that which calls :meth:`Viewer.render_next` or :meth:`Viewer.serve`: in a training it is
the thread of the steps, so that a picture is never of half a step. The threads of the server only set flags.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import io
import logging
import queue
import socket
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial

import torch
import viser

from voronerf.app.run import Run
from voronerf.app.train.config import ConfigError
from voronerf.app.train.run_directory import read_curve
from voronerf.app.viewer.cameras import axial_depth, frustum, look_point
from voronerf.app.viewer.client import Client
from voronerf.app.viewer.door import guarded
from voronerf.app.viewer.pictures import Look, Subject, picture_of, render_bands, render_look, stack_bands
from voronerf.app.web import CannotDraw, Packed, pack, page_of, turntable
from voronerf.nerf.cameras import Cameras
from voronerf.nerf.renderer import RenderedImage

log = logging.getLogger(__name__)

#: Seconds without a movement after which the sharp picture is begun.
REST = 0.15
#: Seconds that a picture may take while the camera moves, and a band of the sharp one, after which others have a turn.
COARSE, BAND = 0.06, 0.1
#: Pixels along the longer side of a coarse picture, at least.
SMALLEST = 96
#: Share of a training's time that goes into new pictures while nobody moves.
REFRESH = 0.05
#: Hosts that stand for all addresses of this machine.
EVERYWHERE = ("0.0.0.0", "::", "")
#: Path of the page that draws the scene in the browser itself.
PAGE = "/scene.html"
#: Depth of empty pixels in scene units, the largest that viser takes.
NOWHERE = 160.0


class Viewer:
    """Shows a subject to any number of browsers.

    Args:
        subject: What is viewed.
        host: Address to listen at.
        port: To listen at; 0 is any that is free.
        page: Makes the page that draws the subject in the browser itself, served at `PAGE`; None for none.

    Raises:
        ConfigError: The address cannot be listened at.
    """

    def __init__(
        self,
        subject: Subject,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        page: Callable[[], bytes] | None = None,
    ) -> None:
        check_address(host, port)
        # A tab is closed at any time; what is on its way to it then is lost.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        self.subject = subject
        self.clients: dict[int, Client] = {}
        self.tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.wake = threading.Event()
        self.rate = 100_000.0  # pixels a second
        # viser draws a box around its address
        self.page = page
        pages = {} if page is None else {PAGE: self._make_page}
        with contextlib.redirect_stdout(io.StringIO()), guarded(host, pages):
            self.server = viser.ViserServer(host=host, port=port, label=subject.name, verbose=False)
        self.host, self.port = host, self.server.get_port()
        self.server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="medium")
        self._stand()
        self.points: list[tuple[float, float]] = []
        self.server.on_client_connect(self._enter)
        self.server.on_client_disconnect(self._leave)

    @property
    def address(self) -> str:
        """What to open in a browser."""
        host = socket.gethostname() if self.host in EVERYWHERE else self.host
        return f"http://[{host}]:{self.port}" if ":" in host else f"http://{host}:{self.port}"

    @property
    def audience(self) -> str:
        """A line about where the viewer is, and for whom."""
        others = self.host in EVERYWHERE
        return f"open {self.address} in a browser" + "; whoever can reach this machine can use the viewer" * others

    def _stand(self) -> None:
        """Starts new browsers at the first test view."""
        start, scene = self.server.initial_camera, self.subject.scene
        seen = frustum(scene.test.cameras, 0)
        start.position, start.fov = seen["position"], seen["fov"]
        start.look_at = look_point(scene, scene.test.cameras, 0).numpy()

    def show(self, subject: Subject, points: Sequence[tuple[float, float]] = ()) -> None:
        """Shows another subject to every browser, with its curve; see :meth:`show_curve`."""
        self.subject = subject
        self.server.gui.set_panel_label(subject.name)
        self._stand()
        self.points = list(points)
        for client in self.list_clients():
            self.serve_client(client, client.on_subject)

    def show_curve(self, points: Sequence[tuple[float, float]]) -> None:
        """Draws PSNR in dB over training seconds, from the second evaluation on.

        Args:
            points: seconds and PSNR of each evaluation.
        """
        self.points = list(points)
        for client in self.list_clients():
            self.serve_client(client, client.draw_curve)

    async def _make_page(self) -> bytes:
        """The page, made on the thread that renders."""
        made: concurrent.futures.Future[bytes] = concurrent.futures.Future()

        def make() -> None:
            assert self.page is not None
            try:
                made.set_result(self.page())
            except Exception as error:
                made.set_exception(error)

        self.do(make)
        return await asyncio.wrap_future(made)

    def close(self) -> None:
        """Ends the server; its clients see that it is gone."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _enter(self, handle: viser.ClientHandle) -> None:
        self.clients[handle.client_id] = Client(handle, self)
        if handle.client_id not in self.server.get_clients():  # it has left meanwhile
            del self.clients[handle.client_id]
        self.wake.set()

    async def _leave(self, handle: viser.ClientHandle) -> None:
        self.clients.pop(handle.client_id, None)

    def do(self, task: Callable[[], None]) -> None:
        """Runs a task on the thread that renders."""
        self.tasks.put(task)
        self.wake.set()

    def serve_client(self, client: Client, work: Callable[[], object]) -> None:
        """Does what a client asked for; if that fails, disconnects the client and logs a line."""
        try:
            work()
        except Exception as error:  # whatever it asked for, the others and the training go on
            if self.clients.pop(client.handle.client_id, None) is None:  # as other threads have found
                return
            log.warning("a browser is disconnected: %s: %.200s", type(error).__name__, error)
            connections = getattr(self.server._websock_server, "_live_connections", {})
            if (connection := connections.get(client.handle.client_id)) is not None:
                asyncio.run_coroutine_threadsafe(connection.close(1008), connection.loop)

    # --- rendering -------------------------------------------------------------------------------------------------

    def serve(self, until: Callable[[], bool] = lambda: False) -> None:
        """Renders what clients need, until ``until()`` is true or Ctrl-C."""
        while not until():
            if not self.render_next():
                # A picture may wait for its camera to rest; without one there is nothing to look at.
                waiting = any(client.wants_sharp for client in self.list_clients())
                self.wake.wait(REST / 3 if waiting else 1.0)
                self.wake.clear()

    def warm_up(self) -> None:
        """Renders something small, since the first call of the operations loads much of torch."""
        cameras = self.subject.scene.train.cameras
        camera = Cameras(cameras.poses[:1], cameras.intrinsics[:1] * (SMALLEST / cameras.width), SMALLEST, SMALLEST)
        render_look(self.subject, camera, Look())

    def list_clients(self) -> list[Client]:
        """The clients that are connected now."""
        return list(self.clients.values())

    def render_next(self) -> bool:
        """Does the most urgent task or picture; returns whether there was one."""
        with contextlib.suppress(queue.Empty):
            self.tasks.get_nowait()()
            return True
        clients = self.list_clients()
        for client in clients:
            if client.wants_coarse:
                self.serve_client(client, partial(self._draw_coarse, client))
                return True
        for client in clients:
            if client.wants_sharp and time.perf_counter() - client.moved_at >= REST:
                self.serve_client(client, partial(self._draw_sharp, client))
                return True
        return False

    def refresh(self) -> None:
        """Renders pictures at rest again, since the weights have changed, as often as `REFRESH` allows."""
        now = time.perf_counter()
        for client in self.list_clients():
            if now - client.drawn_at > client.cost / REFRESH:
                client.wants_sharp = True

    def _draw_coarse(self, client: Client) -> None:
        client.wants_coarse = False
        longest = int(max(SMALLEST, (self.rate * COARSE) ** 0.5))
        camera = client.camera(min(longest, client.longest))
        started = time.perf_counter()
        image = render_look(self.subject, camera, client.look)
        self._took(camera.width * camera.height, time.perf_counter() - started)
        self._send(client, camera, image, client.look, quality=85)
        client.count_picture(camera)

    def _draw_sharp(self, client: Client) -> None:
        """Renders in bands; a movement ends it, and other clients get their coarse pictures in between."""
        version, look, camera = client.version, client.look, client.camera(client.longest)
        started, bands = time.perf_counter(), []
        rows = max(1, int(self.rate * BAND / camera.width))
        client.state.content = f"rendering {camera.width} x {camera.height} pixels"
        for band in render_bands(self.subject, camera, look, rows):
            bands.append(band)
            for other in self.list_clients():
                if other is not client and other.wants_coarse:
                    self.serve_client(other, partial(self._draw_coarse, other))
            if client.version != version or client.handle.client_id not in self.clients:
                return
        client.wants_sharp = False
        image = stack_bands(bands)
        self._took(camera.width * camera.height, time.perf_counter() - started)
        self._send(client, camera, image, look, quality=95)
        client.cost, client.drawn_at = time.perf_counter() - started, time.perf_counter()
        client.state.content = f"{camera.width} x {camera.height} pixels in {client.cost:.2f} s"

    def _send(self, client: Client, camera: Cameras, image: RenderedImage, look: Look, *, quality: int) -> None:
        picture = picture_of(self.subject, image, look)
        depth = None
        if client.shows_nodes:  # so that what is drawn into the scene vanishes behind it
            solid = image.opacity > 0.5
            depth = torch.where(solid, axial_depth(camera, image.depth), NOWHERE).clamp(max=NOWHERE).numpy()
        client.handle.scene.set_background_image(picture.numpy(), format="jpeg", jpeg_quality=quality, depth=depth)
        client.handle.flush()

    def _took(self, pixels: int, seconds: float) -> None:
        self.rate += 0.3 * (pixels / max(seconds, 1e-6) - self.rate)


def check_address(host: str, port: int) -> None:
    """Raises ConfigError for an address that cannot be listened at."""
    if not 0 <= port <= 65535:
        raise ConfigError(f"--port must be 0 to 65535, got {port}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise ConfigError(f"--host {host} --port {port}: cannot listen there: {error.strerror}") from None


def view_run(run: Run, *, host: str = "127.0.0.1", port: int = 8080) -> Viewer:
    """The viewer of a trained run; `Viewer.serve` renders for it.

    Args:
        run: As `voronerf.app.open_run` opens it.
        host: Address to listen at.
        port: To listen at; 0 is any that is free.

    Raises:
        ConfigError: The address cannot be listened at.
    """
    try:
        packed: Packed | None = pack(run)
    except CannotDraw:
        packed = None
    page = None if packed is None else lambda: page_of(packed, turntable(run, 1)).encode()
    viewer = Viewer(Subject.of(run), host=host, port=port, page=page)
    viewer.show_curve(read_curve(run.path))
    return viewer
