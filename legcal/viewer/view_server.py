"""``legcal view``: a machine that sliders move, on the canvas of the report, and its photographs.

The page posts the slider that is dragged; the machine moves, and the answer is all that is shown:
models, sliders, photographs with their outlines.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError, printable
from legcal.exports.subject import Subject
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.motions import motion_of
from legcal.geometry.types import Array, BoolArray
from legcal.machine.closing import (
    COORDINATES,
    coordinates_of,
    independent_coordinates,
    poses_at_coordinates,
)
from legcal.machine.kinematics import Follower, followed_poses, platform_in_base
from legcal.machine.model import Machine, joint_values, readings_at, readings_at_poses
from legcal.machine.parameters import geometries
from legcal.machine.redundancy import consistent_readings
from legcal.pages.document import Page, Scene, Section, Sliders, page_html, time_of_page
from legcal.report.scene import MachineScene
from legcal.viewer.server import HTML, Address, PageServer
from legcal.viewer.source import Photographs

_AT_END = 2.5e-6  # distance from the end of a travel that counts as none, in mean leg lengths
_TICKS = 40  # steps of the search for the range of a coordinate, on either side of home
_TURN = 0.5 * np.pi  # range of an angle that no travel limits [rad]
_WAY = 1.0  # range of a position that no travel limits, in leg lengths
_BEYOND = 1.15  # range of a coordinate, relative to the range within the travel of legs
_STROKE = 0.5  # range of a motor without travel, in leg lengths
_LEAST_SHARE = 1e-6  # least share of a reading that the freedoms of the platform change


@dataclass(frozen=True, eq=False)
class Posture:
    """The pose and joint values of a machine."""

    T: RigidTransform  # T_base_platform
    q: Array  # (n_legs,) joint values [m]; zero for legs of constant length
    problem: str = ""  # reason for not reaching the requested posture; "" if reached


class Motion:
    """A machine in motion, from home."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.columns = independent_coordinates(machine)  # (m,) indices of COORDINATES
        self._follower = Follower(machine) if machine.is_determined else None
        self.posture = self.home()

    def home(self) -> Posture:
        """Move the machine home and return its posture."""
        T = self.machine.home
        if self._follower is not None:
            self._follower.configuration = self.machine.home_configuration
        return self._stand(T, self._values(T))

    @property
    def coordinates(self) -> Array:
        """The independent coordinates of the pose, (m,) [m, rad]."""
        values, _ = coordinates_of(self.posture.T.as_matrix()[None, :3])
        return np.asarray(values[0, self.columns])

    @property
    def at_end(self) -> BoolArray:
        """Which legs are at or beyond an end of their travel, (n_legs,)."""
        lower, upper = self.travel.T
        q, near = self.posture.q, _AT_END * self.machine.size
        return np.asarray(((q <= lower + near) | (q >= upper - near)) & self._slides)

    @property
    def travel(self) -> Array:
        """The limits of the travel of all legs, (n_legs, 2) [m]; infinite if there are none."""
        return np.array([leg.travel for leg in self.machine.legs], dtype=np.float64).reshape(-1, 2)

    @property
    def _slides(self) -> BoolArray:
        return np.array([leg.has_value for leg in self.machine.legs])

    def ranges_of_readings(self) -> Array:
        """Return the range of motion of each leg, (n_legs, 2) [m]."""
        about = readings_at(self.machine, self.machine.home)[:, None]
        stroke = _STROKE * self.machine.size
        travel = self.travel
        free = ~np.isfinite(travel) | (np.ptp(travel, axis=1) <= 0.0)[:, None]
        return np.where(free, about + stroke * np.array([-1.0, 1.0]), travel)

    def ranges_of_coordinates(self) -> Array:
        """Return the range of each independent coordinate, (m, 2) [m, rad].

        With the others at home, it extends slightly beyond the travel of the legs.
        """
        machine, home = self.machine, self.machine.home.as_matrix()[:3]
        centre = coordinates_of(home[None])[0][0, self.columns]
        scale = machine.size
        lower, upper = self.travel.T
        ranges = np.zeros((len(self.columns), 2))
        for k, which in enumerate(self.columns.tolist()):
            most = _WAY * scale if which < 3 else _TURN
            for side, sign in enumerate((-1.0, 1.0)):
                steps = sign * most * np.arange(1, _TICKS + 1) / _TICKS
                wanted = np.repeat(centre[None], _TICKS, axis=0)
                wanted[:, k] += steps
                poses, reached = poses_at_coordinates(machine, self.columns, wanted, home)
                q = readings_at_poses(machine, poses)
                inside = reached & (((q >= lower) & (q <= upper)) | ~self._slides).all(axis=1)
                last = int(np.argmin(inside)) if not inside.all() else _TICKS
                ranges[k, side] = centre[k] + _BEYOND * steps[max(last - 1, 0)]
        return ranges

    def read(self, leg: int, value: float) -> Posture:
        """Move a motor to a reading [m], the others unchanged, and return the posture.

        With redundant motors the others change as little as possible.
        """
        if self._follower is None:
            return self._stay(f"Readings do not move it: {self.machine.undetermined}.")
        q = self.posture.q.copy()
        step = value - q[leg]
        if self.machine.is_redundant:
            motors = list(self.machine.motors)
            here = readings_at(self.machine, self.posture.T)[motors]
            unit = np.eye(len(motors))[motors.index(leg)]
            pulled = consistent_readings(self.machine, here + unit, self.posture.T) - here
            share = pulled[motors.index(leg)]
            if share < _LEAST_SHARE:
                return self._stay(
                    f"The motor of {self.machine.leg_names[leg]} cannot move alone: no freedom of "
                    "the platform moves it here."
                )
            q[motors] += step / share * pulled
        else:
            reads = np.array(self.machine.reads)
            q[reads == reads[leg]] = value
        try:
            T = self._follower.move_to(q)
        except LegcalError as error:
            return self._stay(str(error))
        return self._stand(T, joint_values(self.machine, self._follower.configuration))

    def place(self, coordinate: int, value: float) -> Posture:
        """Move one independent coordinate to a value [m, rad], and return the posture."""
        wanted = self.coordinates
        wanted[coordinate] = value
        near = self.posture.T.as_matrix()[:3]
        poses, reached = poses_at_coordinates(self.machine, self.columns, wanted[None], near)
        if not reached[0]:
            return self._stay("The joints of the legs allow no pose with these coordinates.")
        return self._follow(motion_of(poses[0, :, :3], poses[0, :, 3]))

    def show(self, q: Array) -> Posture:
        """Move to readings (n_legs,) [m] of a session, from any posture, and return the posture."""
        if self._follower is None:
            return self._stay(f"Readings do not give the pose: {self.machine.undetermined}.")
        try:
            ((T, failure),) = followed_poses(self.machine, q[None], on_the_chain=False)
        except LegcalError as error:
            return self._stay(str(error))
        return self._stay(str(failure)) if failure is not None else self._follow(T)

    def _follow(self, T: RigidTransform) -> Posture:
        """Move to a pose, with the chain closed, and return the posture."""
        if self._follower is not None:
            try:
                T = self._follower.place(T)
            except LegcalError as error:
                return self._stay(str(error))
        return self._stand(T, self._values(T))

    def _values(self, T: RigidTransform) -> Array:
        return np.where(self._slides, readings_at(self.machine, T), 0.0)

    def _stand(self, T: RigidTransform, q: Array) -> Posture:
        self.posture = Posture(T, q)
        return self.posture

    def _stay(self, problem: str) -> Posture:
        self.posture = replace(self.posture, problem=problem)
        return self.posture


_SCENE = "machine-scene"
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
    """A machine in the browser, until it is closed."""

    def __init__(self, source: Subject, address: Address) -> None:
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
        if len(self._photographs.q):
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
        return None if picture is None else ("image/jpeg", picture)

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
        if n := len(self._photographs.q):
            ends = np.array([1.0, n])
            sliders["pose"] = _Slider("pose", "", ends, lambda: self._pose + 1.0, self._show_pose)
        if machine.is_determined:
            ranges = motion.ranges_of_readings()
            for j in machine.motors:
                leg = machine.legs[j]
                label = machine.leg_names[j] if leg.actuator is None else leg.actuator.joint
                reading = partial(lambda j: float(motion.posture.q[j]), j)
                sliders[f"q{j}"] = _Slider(
                    label, leg.reading_unit, ranges[j], reading, partial(motion.read, j)
                )
        for k, ends in enumerate(motion.ranges_of_coordinates()):
            which = int(motion.columns[k])
            coordinate = partial(lambda k: float(motion.coordinates[k]), k)
            sliders[f"x{k}"] = _Slider(
                COORDINATES[which],
                "m" if which < 3 else "rad",
                ends,
                coordinate,
                partial(motion.place, k),
            )
        return sliders

    def _show_pose(self, value: float) -> None:
        self._pose = int(np.clip(round(value) - 1, 0, len(self._photographs.q) - 1))
        self.motion.show(self._photographs.q[self._pose])

    # What is shown

    def _state(self) -> dict[str, Any]:
        """Return all that the page shows at the posture."""
        problems = [self.motion.posture.problem] * bool(self.motion.posture.problem)
        scene, machine, q = self.scene, self.source.machine, self.motion.posture.q[None]
        near = [platform_in_base(machine, self.motion.posture.T)]
        here = scene.placed(scene.legs, q, near, by_readings=False)
        try:
            content = scene.compared(here, q, near, by_readings=machine.is_determined)
        except LegcalError as error:
            problems += error.problems
            content = scene.alone(here, near)
        ends = dict.fromkeys(
            machine.legs[j].motor_label for j in np.flatnonzero(self.motion.at_end).tolist()
        )
        if ends:
            problems.append(f"At the end of the travel: {', '.join(ends)}.")
        return {
            "scene": content,
            "values": {
                name: round(slider.size * slider.value(), 2)
                for name, slider in self._controls.items()
            },
            "problems": [printable(problem) for problem in problems],
            "photographs": self._photographs.at(self._pose),
        }

    def _document(self) -> Page:
        """Return the page at the first posture."""
        state = self._state()
        cameras = self.scene.cameras(self._photographs.cameras)
        caption = "Drag to turn, scroll to zoom."
        if self.scene.nominal is not None:
            caption += (
                " Grey is the nominal model, blue the calibrated one at the same readings. Rings "
                "are ellipsoids of one standard deviation at the joints."
            )
        shown = Scene(_SCENE, {**state["scene"], "cameras": cameras}, 560, caption)
        controls = [slider.document(name) for name, slider in self._controls.items()]
        controls.append({"name": _HOME, "label": "Home", "button": True})
        sliders = Sliders(_SCENE, controls, {**state, "scene": {}}, self.token)
        section = Section("machine", "The machine", [shown, sliders])
        return Page(printable(self.source.name), time_of_page(), None, [section])
