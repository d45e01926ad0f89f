"""The browser window: sliders, and the machine drawn with viser.

Controls only store requests; one loop takes the latest ones, moves the machine and sends the
changes, so that dragging a slider quickly causes no lag.
"""

from __future__ import annotations

import io
import logging
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from legcal.errors import UsageError
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array
from legcal.machine.closing import COORDINATES
from legcal.scene.motions import FACTORS
from legcal.viewer.address import Address, check_address
from legcal.viewer.motion import Motion
from legcal.viewer.source import Photographs, Place, Source
from legcal.viewer.stage import Seen, Stage

if TYPE_CHECKING:
    import viser

FRAMES = 60.0  # largest frame rate [1/s]
_PERIOD = 2.0  # period of a played motion [s]
_EYE = np.array([1.1, -1.5, 0.9])  # viewpoint, in sizes of the machine
_AWAY = 1.5  # factor of its distance if cameras are shown
_DEPTH = 0.45  # distance of a photograph from its camera, in sizes of the machine
_PLAIN = "nominal and calibrated"
_NONE = "none"
_STEP = 0.01  # step of sliders [mm, deg]
_STEEL, _ROD, _BASE, _PLATFORM = (88, 96, 108), (190, 197, 206), (70, 74, 80), (31, 95, 168)
_ARM = (138, 109, 59)
_BESIDE, _RED, _AMBER, _GREEN = (150, 156, 164), (190, 20, 15), (190, 95, 0), (30, 125, 70)
_USED, _LEFT_OUT = (60, 220, 90), (235, 70, 60)


def require_viser() -> None:
    """Refuse to continue without viser.

    Raises
    ------
    UsageError
        If the extra is not installed.
    """
    if find_spec("viser") is None:
        raise UsageError(
            "The viewer could not be started: found no package viser, needed it; install it with: "
            "pip install 'legcal[view]'"
        )


class Window:
    """A machine in the browser.

    Attributes
    ----------
    motion : Motion
        The machine and its posture.
    seen : Seen
        The scene drawn last.
    address : Address
        Address of the server.
    """

    def __init__(self, source: Source, address: Address) -> None:
        require_viser()
        check_address(address)
        self.source = source
        self.motion, self.stage = Motion(source.machine), Stage(source)
        self.photographs = Photographs(source)
        self._changed = threading.Condition()
        self._drawing = threading.Lock()  # nothing is sent after the server has stopped
        self._wanted: dict[Any, Callable[[], object]] = {}
        self._is_over = False
        self._shown_motion: int | None = None
        self._factor, self._phase, self._started = 1.0, 1.0, 0.0
        self._is_playing = False
        self._server: Any = _serve(source.name, address)  # handles of viser have no common type
        self.address = Address(address.host, int(self._server.get_port()))
        if self.address.port != (address.port or self.address.port):
            self.close()
            check_address(address)
        with self._server.atomic():
            self._add_machine()
            self._add_cameras()
            self._add_controls()
            self._draw()

    def run(self) -> None:
        """Serve until :meth:`close` or an interrupt."""
        while not self._is_over:
            with self._changed:
                if not self._wanted and not self._is_over:
                    self._changed.wait(1.0 / FRAMES if self._is_playing else None)
                wanted, self._wanted = self._wanted, {}
            started = time.monotonic()
            with self._drawing:
                if self._is_over:
                    return
                self._step(wanted, started)
            time.sleep(max(0.0, 1.0 / FRAMES - (time.monotonic() - started)))

    def _step(self, wanted: dict[Any, Callable[[], object]], now: float) -> None:
        """Handle the pending requests of the browser, then send the new scene."""
        for do in wanted.values():
            do()
        if self._is_playing:
            self._phase = float(np.sin(2.0 * np.pi * (now - self._started) / _PERIOD))
        with self._server.atomic():
            self._draw()

    def close(self) -> None:
        """Stop serving."""
        self._is_over = True
        with self._changed:
            self._changed.notify_all()
        with self._drawing, redirect_stdout(io.StringIO()):
            self._server.stop()

    # Drawing

    def _add_machine(self) -> None:
        scene, stage, size = self._server.scene, self.stage, self.stage.size
        seen = stage.seen(self.motion.posture)
        middle = np.concatenate([seen.A, seen.B]).mean(axis=0)
        camera = self._server.initial_camera
        away = (_AWAY if self.photographs.places else 1.0) * size
        camera.position, camera.look_at = middle + away * _EYE, middle
        camera.near, camera.far = 0.01 * size, 100.0 * size
        floor = float(min(seen.A[:, 2].min(), seen.B[:, 2].min())) - 0.04 * size
        cell = float(10.0 ** np.floor(np.log10(size)))
        scene.add_grid(
            "/floor", width=10 * cell, height=10 * cell, cell_size=0.2 * cell, section_size=cell,
            cell_color=(232, 234, 237), section_color=(214, 218, 222),
            position=(*middle[:2], floor), infinite_grid=False, fade_distance=5.0 * size,
        )  # fmt: skip
        vertices, faces = _cylinder(24)
        self._rods = scene.add_batched_meshes_simple(
            "/legs", vertices, faces, seen.rods.wxyz, seen.rods.position,
            batched_scales=seen.rods.scale, batched_colors=self._rod_colours(), lod="off",
        )  # fmt: skip
        self._motors = None
        if len(seen.motors.position):
            colours = np.full((len(seen.motors.position), 3), _ARM, dtype=np.uint8)
            colours[: stage.n_standing] = _BASE
            self._motors = scene.add_batched_meshes_simple(
                "/motors", vertices, faces, seen.motors.wxyz, seen.motors.position,
                batched_scales=seen.motors.scale, batched_colors=colours, lod="off",
            )  # fmt: skip
        vertices, faces = _ball()
        radii = np.repeat(np.tile(stage.ball_radii, 2)[:, None], 3, axis=1)
        upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(radii), 1))
        n = self.source.machine.n_legs
        self._balls = scene.add_batched_meshes_simple(
            "/joints", vertices, faces, upright, np.concatenate([seen.A, seen.B]),
            batched_scales=radii, batched_colors=np.repeat([_BASE, _PLATFORM], n, axis=0),
            lod="off",
        )  # fmt: skip
        self._plates = [
            scene.add_mesh_simple(
                name, *_plate(joints, rim), color=colour, opacity=0.45, side="double",
                flat_shading=True, cast_shadow=False,
            )
            for name, joints, rim, colour in (
                ("/base", seen.base, stage.scene.rims["base"], _BASE),
                ("/platform", seen.B, stage.scene.rims["platform"], _PLATFORM),
            )
        ]  # fmt: skip
        self._frame = scene.add_frame(
            "/tool", axes_length=0.12 * size, axes_radius=0.003 * size, origin_radius=0.006 * size
        )
        scene.add_frame(
            "/origin", axes_length=0.12 * size, axes_radius=0.003 * size,
            origin_radius=0.006 * size,
        )  # fmt: skip
        self._labels = [
            scene.add_label(f"/name/{j}", name, position=seen.A[j], anchor="top-center")
            for j, name in enumerate(self.source.machine.leg_names)
        ]
        self._beside = scene.add_line_segments(
            "/beside", np.zeros((1, 2, 3)), colors=_BESIDE, thickness=2.5,
            thickness_units="screen",
            visible=False,
        )  # fmt: skip
        axes = stage.scene.ellipsoids
        self._ellipsoid_axes = {
            side: stage.magnification * of_side for side, of_side in axes.items()
        }
        self._ellipsoids = None
        if axes:
            rotations, scales = zip(
                *(_principal(self._ellipsoid_axes[s]) for s in axes), strict=True
            )
            self._ellipsoid_turns = dict(zip(axes, rotations, strict=True))
            self._ellipsoids = scene.add_batched_meshes_simple(
                "/uncertainty", *_ball(), np.tile([1.0, 0, 0, 0], (2 * n, 1)),
                np.concatenate([seen.A, seen.B]),
                batched_scales=np.maximum(np.concatenate(scales), 2e-4 * size),
                batched_colors=_AMBER, opacity=0.85, lod="off",
            )  # fmt: skip

    def _rod_colours(self) -> NDArray[np.uint8]:
        stage = self.stage
        colours = np.where(stage.rod_is_thick[:, None], _STEEL, _ROD).astype(np.uint8)
        colours[self.motion.at_end[stage.rod_legs]] = _RED
        return colours

    def _add_cameras(self) -> None:
        scene, depth = self._server.scene, _DEPTH * self.stage.size
        self._frusta: list[Any] = []
        self._segments: list[Any] = []
        for place in self.photographs.places:
            R = place.T_base_camera.rotation.as_quat()
            frustum = scene.add_camera_frustum(
                f"/cameras/{place.view}", place.fov, place.aspect,
                scale=depth * np.cbrt(np.tan(0.5 * place.fov) ** 2 * place.aspect / 3.0),
                thickness=0.003 * self.stage.size, color=_GREEN,
                wxyz=R[[3, 0, 1, 2]], position=place.T_base_camera.translation,
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            frustum.on_click(partial(self._look_through, place))
            scene.add_label(f"/cameras/{place.view}/name", place.name, position=(0.0, 0.0, 0.0))
            self._frusta.append(frustum)
            self._segments.append(
                scene.add_line_segments(
                    f"/outlines/{place.view}", np.zeros((1, 2, 3)), colors=_USED, thickness=2.0,
                    thickness_units="screen",
                    visible=False,
                )
            )  # fmt: skip

    def _look_through(self, place: Place, event: Any) -> None:
        """Move the viewpoint of a client to a camera."""
        if event.client is None:
            return
        camera = event.client.camera
        R = place.T_base_camera.rotation.as_matrix()
        with event.client.atomic():
            camera.up_direction = -R[:, 1]
            camera.position = place.T_base_camera.translation
            camera.look_at = place.T_base_camera.translation + _DEPTH * self.stage.size * R[:, 2]
            camera.fov = place.fov

    def _draw(self) -> None:
        """Send the current scene."""
        posture, stage = self.motion.posture, self.stage
        seen = stage.seen(posture, self._shown_motion, self._factor, self._phase)
        self.seen = seen
        self._rods.batched_positions = seen.rods.position.astype(np.float32)
        self._rods.batched_wxyzs = seen.rods.wxyz.astype(np.float32)
        self._rods.batched_scales = seen.rods.scale.astype(np.float32)
        self._rods.batched_colors = self._rod_colours()
        if self._motors is not None:
            self._motors.batched_positions = seen.motors.position.astype(np.float32)
            self._motors.batched_wxyzs = seen.motors.wxyz.astype(np.float32)
            self._motors.batched_scales = seen.motors.scale.astype(np.float32)
        self._balls.batched_positions = np.concatenate([seen.A, seen.B]).astype(np.float32)
        for plate, joints, rim in zip(
            self._plates, (seen.base, seen.B), stage.scene.rims.values(), strict=True
        ):
            plate.vertices = _plate(joints, rim)[0]
        T = posture.T
        self._frame.position, self._frame.wxyz = T.translation, T.rotation.as_quat()[[3, 0, 1, 2]]
        is_beside = seen.skeleton is not None and self._show_beside.value
        self._beside.visible = is_beside
        if seen.skeleton is not None and is_beside:
            self._beside.points = seen.skeleton.astype(np.float32)
        if self._ellipsoids is not None:
            self._ellipsoids.visible = self._show_ellipsoids.value
            self._ellipsoids.batched_positions = np.concatenate([seen.A, seen.B]).astype(np.float32)
            turns = [
                (T.rotation * turn if side == "platform" else turn).as_quat()[:, [3, 0, 1, 2]]
                for side, turn in self._ellipsoid_turns.items()
            ]
            self._ellipsoids.batched_wxyzs = np.concatenate(turns).astype(np.float32)
        self._say(seen)

    def _say(self, seen: Seen) -> None:
        """Update sliders and text."""
        posture, motion = self.motion.posture, self.motion
        for j, slider in self._reading_sliders.items():
            slider.value = _shown(self._scale(j) * posture.q[j], slider.min, slider.max)
        for k, (slider, value) in enumerate(
            zip(self._pose_sliders, motion.coordinates.tolist(), strict=True)
        ):
            slider.value = _shown(value * _scale(int(motion.columns[k])), slider.min, slider.max)
        legs = [self.source.machine.legs[j] for j in np.flatnonzero(motion.at_end)]
        ends = dict.fromkeys(leg.motor_label for leg in legs)
        lines = []
        if ends:
            lines.append(f"**At the end of the travel:** {_plain(', '.join(ends))}")
        if posture.problem:
            lines.append(f"**Not reached.** {_plain(posture.problem)}")
        if seen.beside is not None:
            subject = "The motion" if self._shown_motion is not None else "The calibration"
            times = "" if self._factor == 1.0 else f", shown {self._factor:g} times as large"
            lines.append(f"{subject} moves joints by up to {1e3 * seen.apart:.3g} mm here{times}.")
        self._words.content = "\n\n".join(lines) or "Drag to turn, scroll to zoom."

    # Controls

    def ask(self, key: Any, do: Callable[[], object]) -> None:
        """Schedule an action for the loop, replacing an earlier one with the same key."""
        with self._changed:
            self._wanted[key] = do
            self._changed.notify_all()

    def _on_update(self, control: Any, key: Any, do: Callable[[Any], object]) -> None:
        """Schedule an action with the value of a control whenever the user changes it."""

        def changed(event: Any) -> None:
            if event.client is not None:  # not by the loop
                self.ask(key, partial(do, event.target.value))

        control.on_update(changed)

    def _add_controls(self) -> None:
        gui, machine, motion = self._server.gui, self.source.machine, self.motion
        self._words = gui.add_markdown("")
        home = gui.add_button("Home")
        home.on_click(lambda _: self.ask("home", motion.home))
        self._add_session()
        self._add_comparison()
        self._reading_sliders: dict[int, Any] = {}
        if machine.is_determined:
            units = {"mm" if self._scale(j) == 1e3 else "deg" for j in machine.motors}
            with gui.add_folder(f"Readings [{', '.join(sorted(units, reverse=True))}]"):
                for j, ends in enumerate(motion.ranges_of_readings()):
                    if j not in machine.motors:
                        continue
                    low, high = (self._scale(j) * ends).tolist()
                    actuator = machine.legs[j].actuator
                    slider = gui.add_slider(
                        machine.leg_names[j] if actuator is None else actuator.joint,
                        low, high, _STEP,
                        _shown(self._scale(j) * motion.posture.q[j], low, high),
                    )  # fmt: skip
                    self._on_update(slider, ("leg", j), partial(self._read, j))
                    self._reading_sliders[j] = slider
        self._pose_sliders: list[Any] = []
        with gui.add_folder("Pose of the platform [mm, deg]"):
            values = motion.coordinates
            for k, (low, high) in enumerate(motion.ranges_of_coordinates().tolist()):
                which = int(motion.columns[k])
                low = float(np.floor(low * _scale(which)))
                high = float(np.ceil(high * _scale(which)))
                slider = gui.add_slider(
                    COORDINATES[which], low, high, _STEP,
                    _shown(values[k] * _scale(which), low, high),
                )  # fmt: skip
                self._on_update(slider, ("pose", k), partial(self._place, k))
                self._pose_sliders.append(slider)

    def _read(self, leg: int, value: float) -> None:
        self.motion.read(leg, value / self._scale(leg))

    def _scale(self, leg: int) -> float:
        """Return the display factor of the reading of a leg: mm, or degrees of arms."""
        return SHOWN_IN[self.source.machine.legs[leg].reading_unit][0]

    def _place(self, k: int, value: float) -> None:
        self.motion.place(k, value / _scale(int(self.motion.columns[k])))

    def _add_session(self) -> None:
        """Add the controls of the photographs."""
        gui, photographs = self._server.gui, self.photographs
        if not photographs.poses:
            return
        with gui.add_folder("Session"):
            self._pose_words = gui.add_markdown("")
            n = len(photographs.poses)
            self._pose = gui.add_slider("pose", 1, max(n, 2), 1, 1, disabled=n == 1)
            step = gui.add_button_group("step", ("previous", "next"))
            self._show_pictures = gui.add_checkbox("photographs", True)
            self._show_outlines = gui.add_checkbox(
                "outlines", photographs.has_outlines, disabled=not photographs.has_outlines,
                hint="" if photographs.has_outlines else "legcal detect or calibrate measures them",
            )  # fmt: skip
            self._look = gui.add_dropdown(
                "look through", (_NONE, *(place.name for place in photographs.places))
            )
        self._on_update(self._pose, "session", lambda value: self.show_pose(int(value) - 1))
        for box in (self._show_pictures, self._show_outlines):
            self._on_update(box, "pictures", lambda _: self._show_photographs())

        def step_on(event: Any) -> None:
            by = 1 if event.target.value == "next" else -1
            self.ask("session", lambda: self.show_pose((int(self._pose.value) - 1 + by) % n))

        def look(event: Any) -> None:
            place = next((p for p in photographs.places if p.name == event.target.value), None)
            if place is not None:
                self._look_through(place, event)

        step.on_click(step_on)
        self._look.on_update(look)
        self.show_pose(0)

    def show_pose(self, pose: int) -> None:
        """Move to a pose of the session, with its photographs."""
        self._pose.value = pose + 1
        self.motion.show(self.photographs.q[pose])
        self._show_photographs()

    def _show_photographs(self) -> None:
        """Send the photographs and outlines of the current pose."""
        pose, sentences = int(self._pose.value) - 1, []
        depth = _DEPTH * self.stage.size
        for place, frustum, segments in zip(
            self.photographs.places, self._frusta, self._segments, strict=True
        ):
            row = self.photographs.row(place, pose)
            picture, problem = None, ""
            if row is not None:
                name = self.photographs.name(row)
                if self._show_pictures.value:
                    picture, problem = self.photographs.picture(place, row)
                sentences.append(_plain(problem or f"{place.name}: {name}"))
            frustum.image = picture
            ends, used = np.zeros((0, 2, 3)), np.zeros(0, dtype=np.bool_)
            if row is not None and self._show_outlines.value:
                ends, used = self.photographs.outlines(place, row, 0.995 * depth)
            segments.visible = len(ends) > 0
            if len(ends):
                segments.points = ends.astype(np.float32)
                colours = np.where(used[:, None, None], _USED, _LEFT_OUT)
                segments.colors = np.repeat(colours, 2, axis=1).astype(np.uint8)
        title = f"Pose {pose + 1} of {len(self.photographs.poses)}"
        if not self.photographs.places:
            sentences.append("No camera has a pose yet: the dataset has no hints.")
        self._pose_words.content = "\n\n".join([title, *sentences])

    def _add_comparison(self) -> None:
        """Add the controls that compare nominal and calibrated, and play weak directions."""
        gui, stage = self._server.gui, self.stage
        result = self.source.result
        if result is None:
            self._show_beside: Any = _Constant(False)
            return
        with gui.add_folder("Calibration"):
            self._show_beside = gui.add_checkbox("grey beside it", True)
            self._show_ellipsoids = gui.add_checkbox("uncertainty", True)
            gui.add_markdown(f"Ellipsoids: 1 sigma, {stage.magnification:g} times as large.")
            options = (
                _PLAIN,
                *(f"{k + 1}. {w}" for k, (w, _) in enumerate(stage.scene.directions)),
            )
            self._show = gui.add_dropdown("show", options)
            self._play = gui.add_checkbox("play", False)
            self._exaggerate = gui.add_slider(
                "exaggerate", 0, len(FACTORS) - 1, 1, FACTORS.index(1), hint="0, 1, 2, 5, 10, ...",
                marks=tuple((k, f"{FACTORS[k]:g}") for k in (1, 4, 7, 10, 13)),
            )  # fmt: skip
        for box in (self._show_beside, self._show_ellipsoids):
            self._on_update(box, "look", lambda _: None)
        self._on_update(
            self._exaggerate, "factor", lambda k: setattr(self, "_factor", FACTORS[int(k)])
        )
        self._on_update(self._play, "play", self._set_playing)
        self._on_update(
            self._show, "show", lambda words: self.show_motion(options.index(words) - 1)
        )

    def show_motion(self, motion: int) -> None:
        """Show a weak direction as a motion, or for -1 the change by the calibration."""
        self._shown_motion = None if motion < 0 else motion
        step = FACTORS.index(1)
        if motion >= 0:
            step = self.stage.first_step(self.motion.posture, motion)
        self._exaggerate.value, self._factor = step, float(FACTORS[step])
        self._play.value = motion >= 0
        self._set_playing(motion >= 0)

    def _set_playing(self, is_playing: bool) -> None:
        self._is_playing, self._started, self._phase = is_playing, time.monotonic(), 1.0


class _Constant:
    """A dummy control with a constant value."""

    def __init__(self, value: bool) -> None:
        self.value = value


def _serve(name: str, address: Address) -> viser.ViserServer:
    """Start a private server."""
    import viser

    class Server(viser.ViserServer):
        """A server that opens no tunnel to another host, whoever asks."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    # Not the errors of clients that are no browsers.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with redirect_stdout(io.StringIO()):
        server = Server(address.host, address.port, label=name, verbose=False)
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="medium", brand_color=_PLATFORM
    )
    return server


def _scale(coordinate: int) -> float:
    """Return the display factor of a coordinate: mm and degrees."""
    return 1e3 if coordinate < 3 else float(np.degrees(1.0))


def _shown(value: float, low: float, high: float) -> float:
    """Return a number clipped to a slider."""
    return float(np.clip(np.round(value, 2), low, high))


def _plain(text: str) -> str:
    """Return text escaped for Markdown."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+-.!|<>~$" else c for c in text)


def _cylinder(n: int) -> tuple[Array, Any]:
    """Return vertices and faces of a cylinder of radius and length 1 along z, about the origin."""
    turn = 2.0 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(turn), np.sin(turn), np.full(n, 0.5)], axis=1)
    low = ring * [1.0, 1.0, -1.0]
    sides = np.concatenate([ring, low])
    caps = np.concatenate([ring, low, [[0.0, 0.0, 0.5], [0.0, 0.0, -0.5]]])
    i, after = np.arange(n), (np.arange(n) + 1) % n
    faces = [np.stack([i, n + i, after], axis=1), np.stack([after, n + i, n + after], axis=1)]
    m = 2 * n
    faces += [
        m + np.stack([i, after, np.full(n, 2 * n)], axis=1),
        m + np.stack([n + after, n + i, np.full(n, 2 * n + 1)], axis=1),
    ]
    return np.concatenate([sides, caps]), np.concatenate(faces)


def _ball() -> tuple[Array, Any]:
    """Return vertices and faces of a ball of radius 1."""
    from trimesh.creation import icosphere

    ball = icosphere(subdivisions=3)
    return ball.vertices, ball.faces


def _plate(joints: Array, rim: list[int]) -> tuple[Any, Any]:
    """Return vertices and faces of a fan over joints (n, 3)."""
    ring = joints[rim[:-1]]
    n = len(ring)
    faces = [[n, k, (k + 1) % n] for k in range(n)]
    return (
        np.concatenate([ring, ring.mean(axis=0)[None]]).astype(np.float32),
        np.array(faces, dtype=np.uint32),
    )


def _principal(axes: Array) -> tuple[Rotation, Array]:
    """Return the rotations of ellipsoids with half axes (n, 3, 3), and their radii (n, 3)."""
    U, radii, _ = np.linalg.svd(axes)
    return Rotation.from_matrix(U * np.sign(np.linalg.det(U))[:, None, None]), radii
