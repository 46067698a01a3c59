"""The viewer: a server, its clients, and the order in which pictures are rendered.

One thread renders everything: the thread that calls :meth:`Viewer.render_next` or :meth:`Viewer.serve`. In a training,
this is the thread that makes the steps, so that a picture never shows a half-finished step. The threads of the server
only set flags.
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
#: Target time in seconds of a coarse picture, and of a band of the sharp picture, after which other clients are served.
COARSE, BAND = 0.06, 0.1
#: Least number of pixels along the longer side of a coarse picture.
SMALLEST = 96
#: Fraction of the training time that is spent on new sharp pictures while no camera moves.
REFRESH = 0.05
#: Hosts that mean all addresses of this machine.
EVERYWHERE = ("0.0.0.0", "::", "")
#: Path of the page that draws the scene in the browser itself.
PAGE = "/scene.html"
#: Depth of empty pixels in scene units, the largest depth that viser can send.
NOWHERE = 160.0


class Viewer:
    """A server that shows a subject to any number of browsers.

    Args:
        subject: The viewed run or training.
        host: Address to listen on.
        port: Port to listen on; 0 is any free port.
        page: Returns the page that draws the subject in the browser itself, served at `PAGE`; None for no page.

    Raises:
        ConfigError: The address is unavailable.
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
        # Messages to a browser tab that has just been closed are lost, which is no error.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        self.subject = subject
        self.clients: dict[int, Client] = {}
        self.tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.wake = threading.Event()
        self.rate = 100_000.0  # pixels a second
        self.page = page
        pages = {} if page is None else {PAGE: self._make_page}
        # stdout is redirected, since viser prints its address in a box.
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
        """The URL of the viewer."""
        host = socket.gethostname() if self.host in EVERYWHERE else self.host
        return f"http://[{host}]:{self.port}" if ":" in host else f"http://{host}:{self.port}"

    @property
    def audience(self) -> str:
        """A line with the URL of the viewer and who can reach it."""
        is_public = self.host in EVERYWHERE
        return f"open {self.address} in a browser" + "; whoever can reach this machine can use the viewer" * is_public

    def _stand(self) -> None:
        """Sets the initial camera of new browsers to the first test view."""
        start, scene = self.server.initial_camera, self.subject.scene
        view = frustum(scene.test.cameras, 0)
        start.position, start.fov = view["position"], view["fov"]
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
            points: (seconds, PSNR) of each evaluation.
        """
        self.points = list(points)
        for client in self.list_clients():
            self.serve_client(client, client.draw_curve)

    async def _make_page(self) -> bytes:
        """Returns the page, which is made on the rendering thread."""
        future: concurrent.futures.Future[bytes] = concurrent.futures.Future()

        def make() -> None:
            assert self.page is not None
            try:
                future.set_result(self.page())
            except Exception as error:
                future.set_exception(error)

        self.do(make)
        return await asyncio.wrap_future(future)

    def close(self) -> None:
        """Stops the server and disconnects its clients."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _enter(self, handle: viser.ClientHandle) -> None:
        self.clients[handle.client_id] = Client(handle, self)
        if handle.client_id not in self.server.get_clients():  # it has disconnected meanwhile
            del self.clients[handle.client_id]
        self.wake.set()

    async def _leave(self, handle: viser.ClientHandle) -> None:
        self.clients.pop(handle.client_id, None)

    def do(self, task: Callable[[], None]) -> None:
        """Queues a task for the rendering thread."""
        self.tasks.put(task)
        self.wake.set()

    def serve_client(self, client: Client, work: Callable[[], object]) -> None:
        """Runs ``work`` for a client; if it fails, disconnects the client and logs a line."""
        try:
            work()
        except Exception as error:  # an error of one client must not end the viewer or the training
            if self.clients.pop(client.handle.client_id, None) is None:  # another thread has removed it
                return
            log.warning("a browser is disconnected: %s: %.200s", type(error).__name__, error)
            connections = getattr(self.server._websock_server, "_live_connections", {})
            if (connection := connections.get(client.handle.client_id)) is not None:
                asyncio.run_coroutine_threadsafe(connection.close(1008), connection.loop)

    # --- rendering -------------------------------------------------------------------------------------------------

    def serve(self, until: Callable[[], bool] = lambda: False) -> None:
        """Renders the pictures that clients need, until ``until()`` is true or Ctrl-C."""
        while not until():
            if not self.render_next():
                # A sharp picture waits for its camera to rest, hence the short timeout.
                waiting = any(client.wants_sharp for client in self.list_clients())
                self.wake.wait(REST / 3 if waiting else 1.0)
                self.wake.clear()

    def warm_up(self) -> None:
        """Renders a small picture, since the first call of the operations loads much of torch."""
        cameras = self.subject.scene.train.cameras
        camera = Cameras(cameras.poses[:1], cameras.intrinsics[:1] * (SMALLEST / cameras.width), SMALLEST, SMALLEST)
        render_look(self.subject, camera, Look())

    def list_clients(self) -> list[Client]:
        """Returns the connected clients, as a copy that is safe to iterate over."""
        return list(self.clients.values())

    def render_next(self) -> bool:
        """Runs the next task or renders the most urgent picture; returns False if there was neither."""
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
        """Requests new sharp pictures, since the weights have changed, as often as `REFRESH` allows."""
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
        """Renders the sharp picture in bands, between which other clients get coarse pictures; a movement ends it."""
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
        if client.shows_nodes:  # hides objects of the scene that lie behind surfaces
            solid = image.opacity > 0.5
            depth = torch.where(solid, axial_depth(camera, image.depth), NOWHERE).clamp(max=NOWHERE).numpy()
        client.handle.scene.set_background_image(picture.numpy(), format="jpeg", jpeg_quality=quality, depth=depth)
        client.handle.flush()

    def _took(self, pixels: int, seconds: float) -> None:
        self.rate += 0.3 * (pixels / max(seconds, 1e-6) - self.rate)


def check_address(host: str, port: int) -> None:
    """Raises ConfigError if a server cannot listen on the address."""
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
    """Returns a viewer of a trained run; call `Viewer.serve` to render.

    Args:
        run: The run from `voronerf.app.open_run`.
        host: Address to listen on.
        port: Port to listen on; 0 is any free port.

    Raises:
        ConfigError: The address is unavailable.
    """
    try:
        packed: Packed | None = pack(run)
    except CannotDraw:
        packed = None
    page = None if packed is None else lambda: page_of(packed, turntable(run, 1)).encode()
    viewer = Viewer(Subject.of(run), host=host, port=port, page=page)
    viewer.show_curve(read_curve(run.path))
    return viewer
