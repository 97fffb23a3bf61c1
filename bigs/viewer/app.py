"""The live viewer: a local web page that plays a reconstruction and lets the user pose it."""

from __future__ import annotations

import contextlib
import io
import math
import socket
import threading
import time
from types import TracebackType
from typing import Any

import numpy as np

from bigs.checks import InputError
from bigs.viewer.origins import own_pages_only
from bigs.viewer.stage import Mesh, Splats, Stage

# The page stores covariances as 16-bit floats: square millimetres vanish in metres but not in centimetres.
_UNITS_PER_METRE = 100.0
_TRUTH_COLOR = (40, 190, 90)
_FRUSTUM_DEPTH = 4.0  # centimetres
# The page's camera starts beside and behind the clip's own, so that scene and frustum are in sight.
_START_TURN, _START_DISTANCE, _START_PULL, _START_FOV = 15.0, 1.4, 0.15, 50.0
_LAST_PORT = 65535
_AS_RECONSTRUCTED, _BY_SUBJECT = "as reconstructed", "by subject"


class Viewer:
    """Serves a `Stage` until it is closed; leaving a `with` block closes it.

    Everything is drawn by one thread, which shows what the controls say when it gets to it; callbacks only
    wake it. So a slider that moves faster than frames can be drawn skips frames and never queues them.

    Raises:
        InputError: viser is not installed, or the address cannot be listened at.
    """

    def __init__(self, stage: Stage, host: str = "127.0.0.1", port: int = 8080) -> None:
        try:
            import viser
        except ImportError as error:
            raise InputError(
                "live viewer: expected the extra 'viewer' (pip install 'bigs[viewer]'), found no viser"
            ) from error
        _check_address(host, port)
        # viser would print a box with its address.
        with contextlib.redirect_stdout(io.StringIO()), own_pages_only(host):
            self._server = viser.ViserServer(host=host, port=port, label=stage.title, verbose=False)
        self._stage = stage
        self._wake, self._closing, self._ended = threading.Event(), threading.Event(), threading.Event()
        self._failure: Exception | None = None
        self._splats: dict[str, Any] = {}
        self._meshes: dict[str, Any] = {}
        self._frustum: Any = None
        self._frustum_frame = -1
        self._set_camera()
        self._add_controls()
        self._painter = threading.Thread(target=self._paint, name="viewer", daemon=True)
        self._painter.start()

    @property
    def url(self) -> str:
        """The page's address. The port is the next free one if the wanted one is taken."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def close(self) -> None:
        self._closing.set()
        self._wake.set()
        self._ended.wait()
        self._painter.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def wait(self) -> None:
        """Serve until interrupted, or until drawing fails, which is then raised here."""
        # Not join: before Python 3.13 an interrupted join marks the thread as ended, and the interpreter
        # aborts if it exits while the thread still draws.
        self._ended.wait()
        if self._failure is not None:
            raise self._failure

    def _set_camera(self) -> None:
        stage, start = self._stage, self._server.initial_camera
        self._server.scene.set_up_direction("-y")
        middle = _UNITS_PER_METRE * stage.middle
        angle = math.radians(_START_TURN)
        turn = np.array(
            [
                [math.cos(angle), 0.0, -math.sin(angle)],
                [0.0, 1.0, 0.0],
                [math.sin(angle), 0.0, math.cos(angle)],
            ]
        )
        start.look_at = (1.0 - _START_PULL) * middle
        start.position = middle + _START_DISTANCE * turn @ -middle
        start.up = np.array([0.0, -1.0, 0.0])
        start.fov = math.radians(_START_FOV)

    def _field_of_view(self) -> float:
        """The clip camera's vertical angle, radians."""
        return 2.0 * math.atan(0.5 * self._stage.height / float(self._stage.K[1, 1]))

    def _add_controls(self) -> None:
        gui, stage = self._server.gui, self._stage
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._frame: Any = None
        self._playing: Any = None
        if stage.frames > 1:
            with gui.add_folder("Time"):
                self._frame = self._watched(gui.add_slider("frame", 0, stage.frames - 1, 1, 0))
                self._playing = self._watched(gui.add_checkbox("play", False))
                rate = max(1, round(stage.fps))
                self._fps = gui.add_slider("frames a second", 1, max(60, rate), 1, rate)
                if stage.grasps:
                    gui.add_html(f"<div>Hands hold the object:{stage.grasps}</div>")
        with gui.add_folder("Show"):
            self._shown = {name: self._watched(gui.add_checkbox(name, True)) for name in stage.colors}
            self._with_splats = self._watched(gui.add_checkbox("Gaussians", True))
            self._with_meshes = self._watched(gui.add_checkbox("meshes", False))
            self._with_camera = self._watched(gui.add_checkbox("input camera", True))
            if stage.truth is not None:
                self._with_truth = self._watched(gui.add_checkbox("ground truth", False))
            self._coloring = self._watched(gui.add_dropdown("colours", (_AS_RECONSTRUCTED, _BY_SUBJECT)))
            look = gui.add_button("look through the input camera")
            look.on_click(lambda event: self._look_through(event.client))
        self._knobs: dict[tuple[str, str], Any] = {}
        for subject, knobs in stage.knobs.items():
            with gui.add_folder(f"Pose {subject}", expand_by_default=False):
                for knob, (low, high) in knobs.items():
                    slider = gui.add_slider(f"{subject}: {knob}", low, high, 1, 0)
                    self._knobs[subject, knob] = self._watched(slider)
        gui.add_button("reset poses").on_click(lambda _: self._reset())

    def _watched(self, control: Any) -> Any:
        control.on_update(lambda _: self._wake.set())
        return control

    def _reset(self) -> None:
        for slider in self._knobs.values():
            slider.value = 0

    def _look_through(self, client: Any) -> None:
        """Put one page's camera where the clip's was, whose frustum would then hide all."""
        self._with_camera.value = False
        with client.atomic():
            client.camera.position = (0.0, 0.0, 0.0)
            client.camera.look_at = (0.0, 0.0, _UNITS_PER_METRE * float(self._stage.middle[2]))
            client.camera.up_direction = (0.0, -1.0, 0.0)
            client.camera.fov = self._field_of_view()

    def _paint(self) -> None:
        try:
            self._paint_on()
        except Exception as error:
            self._failure = error
        finally:
            self._ended.set()

    def _paint_on(self) -> None:
        frame, due = 0, time.monotonic()
        while True:
            with self._server.atomic():
                self._draw(frame)
            if self._playing is not None and self._playing.value:
                due = max(due + 1.0 / self._fps.value, time.monotonic())
                self._closing.wait(due - time.monotonic())
                # If the user chose a frame meanwhile, keep it.
                chosen = self._frame.value
                self._frame.value = (chosen + 1) % self._stage.frames
            else:
                self._wake.wait()
                due = time.monotonic()
            if self._closing.is_set():
                return
            self._wake.clear()
            frame = 0 if self._frame is None else int(self._frame.value)

    def _draw(self, frame: int) -> None:
        stage = self._stage
        pose = {knob: float(slider.value) for knob, slider in self._knobs.items() if slider.value}
        for name, subject in stage.show(frame, pose).items():
            shown = self._shown[name].value
            self._draw_splats(name, subject.splats, shown and self._with_splats.value)
            mesh = subject.mesh if shown and self._with_meshes.value else None
            self._draw_mesh(name, mesh, stage.colors[name])
        if stage.truth is not None:
            true = stage.truth(frame) if self._with_truth.value else {}
            for name in stage.colors:
                mesh = true.get(name) if self._shown[name].value else None
                self._draw_mesh(f"true {name}", mesh, _TRUTH_COLOR, opacity=0.5)
        self._draw_camera(frame)

    def _draw_splats(self, name: str, splats: Splats, visible: bool) -> None:
        handle = self._splats.get(name)
        if not visible:
            if handle is not None:
                handle.visible = False
            return
        colors = np.clip(splats.colors, 0.0, 1.0)
        if self._coloring.value == _BY_SUBJECT:
            colors = np.broadcast_to(np.array(self._stage.colors[name]) / 255.0, colors.shape)
        arrays = {
            "centers": (_UNITS_PER_METRE * splats.means).astype(np.float32),
            "covariances": (_UNITS_PER_METRE**2 * splats.covariances).astype(np.float32),
            "rgbs": colors.astype(np.float32),
            "opacities": splats.opacities[:, None].astype(np.float32),
        }
        if handle is None:
            self._splats[name] = self._server.scene.add_gaussian_splats(f"/{name}/Gaussians", **arrays)
        else:
            handle.set_gaussians(**arrays)
            handle.visible = True

    def _draw_mesh(
        self, name: str, mesh: Mesh | None, color: tuple[int, int, int], opacity: float | None = None
    ) -> None:
        handle = self._meshes.get(name)
        if mesh is None:
            if handle is not None:
                handle.visible = False
            return
        verts = (_UNITS_PER_METRE * mesh.verts).astype(np.float32)
        if handle is None:
            self._meshes[name] = self._server.scene.add_mesh_simple(
                f"/{name}/mesh", verts, mesh.faces, color=color, opacity=opacity, side="double"
            )
        else:
            handle.vertices = verts
            handle.visible = True

    def _draw_camera(self, frame: int) -> None:
        stage = self._stage
        if not self._with_camera.value:
            if self._frustum is not None:
                self._frustum.visible = False
            return
        image = None if stage.image is None or frame == self._frustum_frame else stage.image(frame)
        self._frustum_frame = frame
        if self._frustum is None:
            self._frustum = self._server.scene.add_camera_frustum(
                "/input camera",
                self._field_of_view(),
                stage.width / stage.height,
                scale=_FRUSTUM_DEPTH,
                thickness=0.05,
                image=image,
                format="jpeg",
            )
            return
        self._frustum.visible = True
        if image is not None:
            self._frustum.image = image


def _check_address(host: str, port: int) -> None:
    """Refuse an address that is not this machine's; the server would try every port in vain."""
    if not 0 <= port <= _LAST_PORT:
        raise InputError(f"port: expected a number from 0 to {_LAST_PORT}, found {port}")
    try:
        with socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
            pass
    except OSError as error:
        raise InputError(f"{host}: expected an address of this machine, found: {error.strerror}") from None
