"""``legcal view``: a machine that sliders move, on the canvas of the report, and its photographs.

The page posts the slider that is dragged; the machine moves, and the answer is all that is shown:
models, sliders, photographs with their outlines.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import cv2
import numpy as np

from legcal.errors import LegcalError, printable
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array
from legcal.machine.closing import COORDINATES
from legcal.machine.kinematics import platform_in_base
from legcal.machine.parameters import geometries
from legcal.pages.document import Page, Scene, Section, Sliders, page_html, time_of_page
from legcal.scene.motions import FACTORS, MachineScene, PlacedModel, pyramid, scene_content
from legcal.viewer.motion import Motion
from legcal.viewer.server import HTML, Address, PageServer
from legcal.viewer.source import Photographs, Source

_SCENE = "machine-scene"
_DEPTH = 0.25  # depth of the pyramid of a camera, relative to the machine
_QUALITY = 85  # JPEG quality [percent]
_HOME = "home"  # the button that moves the machine home


class _Slider(NamedTuple):
    """A slider that moves the machine."""

    label: str
    unit: str  # m, rad, or "" for numbers of poses
    ends: Array  # (2,)
    value: Callable[[], float]
    move: Callable[[float], object]

    @property
    def size(self) -> float:
        """The factor of the values that are shown."""
        return SHOWN_IN[self.unit][0]

    def document(self, name: str) -> dict[str, Any]:
        """Return the slider as the page has it."""
        label, unit = printable(self.label), SHOWN_IN[self.unit][1]
        low, high = np.round(self.size * self.ends, 2).tolist()
        step = 0.01 if unit else 1
        return {
            "name": name,
            "label": f"{label} [{unit}]" if unit else label,
            "low": low,
            "high": high,
            "step": step,
        }


class ViewServer(PageServer):
    """A machine in the browser, until it is closed.

    Attributes
    ----------
    motion : Motion
        The machine and its posture.
    """

    def __init__(self, source: Source, address: Address) -> None:
        super().__init__(address)
        self.source, self.motion = source, Motion(source.machine)
        self.scene = MachineScene(
            source.machine,
            geometries(source.machine),
            None if source.nominal is None else geometries(source.nominal),
            None if source.result is None else source.result.result,
        )
        self._photographs = Photographs(source)
        self._pose = 0  # of the session
        self._moving = Lock()  # requests come in threads
        if self._photographs.poses:
            self.motion.show(self._photographs.q[0])
        self._controls = self._sliders()
        self._page = page_html(self._document()).encode()

    def content(self, path: str) -> tuple[str, bytes] | None:
        """Return the page or a photograph; None for other paths."""
        if path == "/":
            return HTML, self._page
        name = path.removeprefix("/photographs/")
        row = int(name) if name != path and name.isdecimal() else -1
        if not 0 <= row < len(self._photographs.names):
            return None
        picture = self._photographs.picture(row)
        if picture is None:
            return None
        data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        return "image/jpeg", data.tobytes()

    def answer(self, path: str, query: dict[str, list[str]], text: bytes) -> dict[str, Any] | None:
        """Move the machine by a posted ``{"slider": NAME, "value": NUMBER}``; return its state."""
        if path != "/move":
            return None
        try:
            asked = json.loads(text)
            name, value = str(asked["slider"]), float(asked["value"])
        except (ValueError, KeyError, TypeError):
            return None
        if (name != _HOME and name not in self._controls) or not np.isfinite(value):
            return None
        with self._moving:
            if name == _HOME:
                self.motion.home()
            else:
                slider = self._controls[name]
                slider.move(value / slider.size)
            return self._state()

    # The sliders

    def _sliders(self) -> dict[str, _Slider]:
        """Return the sliders by name: the pose of the session, readings, coordinates."""
        motion, machine, sliders = self.motion, self.source.machine, dict[str, _Slider]()
        if n := len(self._photographs.poses):
            ends = np.array([1.0, n])
            sliders["pose"] = _Slider("pose", "", ends, lambda: self._pose + 1.0, self._show_pose)
        if machine.is_determined:
            ranges = motion.ranges_of_readings()
            for j in machine.motors:
                leg = machine.legs[j]
                label = machine.leg_names[j] if leg.actuator is None else leg.actuator.joint
                sliders[f"q{j}"] = _Slider(
                    label,
                    leg.reading_unit,
                    ranges[j],
                    partial(self._reading, j),
                    partial(motion.read, j),
                )
        for k, ends in enumerate(motion.ranges_of_coordinates()):
            which = int(motion.columns[k])
            sliders[f"x{k}"] = _Slider(
                COORDINATES[which],
                "m" if which < 3 else "rad",
                ends,
                partial(self._coordinate, k),
                partial(motion.place, k),
            )
        return sliders

    def _reading(self, leg: int) -> float:
        return float(self.motion.posture.q[leg])

    def _coordinate(self, k: int) -> float:
        return float(self.motion.coordinates[k])

    def _show_pose(self, value: float) -> None:
        """Move to a pose of the session."""
        self._pose = int(np.clip(round(value) - 1, 0, len(self._photographs.poses) - 1))
        self.motion.show(self._photographs.q[self._pose])

    # What is shown

    def _state(self) -> dict[str, Any]:
        """Return all that the page shows at the posture."""
        problems = [self.motion.posture.problem] * bool(self.motion.posture.problem)
        try:
            modes = self._modes()
        except LegcalError as error:
            problems += error.problems
            here = self._here()
            modes = [(printable(self.source.name), ("", "machine"), here, here)]
        machine = self.source.machine
        ends = dict.fromkeys(
            machine.legs[j].motor_label for j in np.flatnonzero(self.motion.at_end).tolist()
        )
        if ends:
            problems.append(f"At the end of the travel: {', '.join(ends)}.")
        T = self.motion.posture.T.as_matrix()[None]
        return {
            "scene": scene_content(self.scene, modes, T, factors=FACTORS if modes[0][1][0] else ()),
            "values": {
                name: round(slider.size * slider.value(), 2)
                for name, slider in self._controls.items()
            },
            "problems": [printable(problem) for problem in problems],
            "photographs": self._photographs.at(self._pose),
        }

    def _here(self) -> PlacedModel:
        """Return the machine at its posture."""
        near = platform_in_base(self.source.machine, self.motion.posture.T)
        q = self.motion.posture.q[None]
        return self.scene.placed(self.scene.legs, q, [near], by_readings=False)

    def _modes(self) -> list[tuple[str, tuple[str, str], PlacedModel, PlacedModel]]:
        """Return the pairs of models to compare: name, legend, both models."""
        scene, here = self.scene, self._here()
        machine, q = self.source.machine, self.motion.posture.q[None]
        near = [platform_in_base(machine, self.motion.posture.T)]
        if scene.nominal is None:
            return [(printable(self.source.name), ("", "machine"), here, here)]
        determined = machine.is_determined
        nominal = scene.placed(scene.nominal, q, near, by_readings=determined)
        moved = [
            (words, ("calibrated", "moved along the direction"), here,
             scene.placed(scene.moved(k), q, near, by_readings=determined))
            for k, (words, _) in enumerate(scene.directions)
        ]  # fmt: skip
        pair = ("change by the calibration", ("nominal", "calibrated"), nominal, here)
        return [pair, *moved]

    def _document(self) -> Page:
        """Return the page at the first posture."""
        state = self._state()
        cameras = [
            {"name": printable(name), "points": np.round(points, 4).tolist()}
            for name, camera, T in self._photographs.cameras
            for points in [pyramid(camera, T, _DEPTH * self.scene.size)]
        ]
        caption = "Drag to turn, scroll to zoom."
        if self.scene.nominal is not None:
            caption += (
                " Grey is the nominal model, blue the calibrated one at the same readings, or grey "
                "the calibrated one and blue where a direction would move it. Rings are ellipsoids "
                "of one standard deviation at the joints."
            )
        shown = Scene(_SCENE, {**state["scene"], "cameras": cameras}, 560, caption)
        controls = [slider.document(name) for name, slider in self._controls.items()]
        controls.append({"name": _HOME, "label": "Home", "button": True})
        sliders = Sliders(_SCENE, controls, {**state, "scene": {}}, self.token)
        section = Section("machine", "The machine", [shown, sliders])
        return Page(printable(self.source.name), time_of_page(), None, [section])
