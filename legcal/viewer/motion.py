"""The posture of the machine, moved by readings or by independent platform coordinates.

Readings move the closed chain, each step from the last (``Follower``); a pose is met exactly and
the legs follow. After a motion that is not possible the machine is unchanged, with the reason in
words.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError
from legcal.geometry.motions import motion_of
from legcal.geometry.types import Array, BoolArray
from legcal.machine.closing import coordinates_of, independent_coordinates, poses_at_coordinates
from legcal.machine.kinematics import Follower, followed_poses
from legcal.machine.model import Machine, joint_values, readings_at, readings_at_poses
from legcal.machine.redundancy import consistent_readings

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
    """A machine in motion, from home.

    Attributes
    ----------
    machine : Machine
        The machine.
    columns : (m,) array of int
        Independent coordinates of the platform, as indices of x, y, z, roll, pitch, yaw.
    posture : Posture
        The current posture.
    """

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.columns = independent_coordinates(machine)
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
        """Return the joint values at a pose."""
        return np.where(self._slides, readings_at(self.machine, T), 0.0)

    def _stand(self, T: RigidTransform, q: Array) -> Posture:
        self.posture = Posture(T, q)
        return self.posture

    def _stay(self, problem: str) -> Posture:
        self.posture = replace(self.posture, problem=problem)
        return self.posture
