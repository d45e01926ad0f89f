"""FlyPT Mover: the regular hexapod nearest to a machine, as the numbers of its rig.

The rig has two sides each of platform and base, one length for all actuators, and the place of the
centre of rotation (:class:`legcal.machine.hexapod_files.Rig`). FlyPT Mover is taken to be off by
the distance of the joints of the platform from where the rig has them, at the same positions of the
actuators: least squares over the workspace, in a frame of the base that is chosen with it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.exports.correction import poses_at_readings, stacked
from legcal.exports.firmware import (
    hexapod_refusal,
    in_words,
    least_squares,
    number_text,
    with_picture,
)
from legcal.exports.subject import ExportOptions, Rendered, Subject, comment
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.configurations import workspace
from legcal.machine.hexapod_files import SIDES, STRUTS, Rig, rig_in
from legcal.machine.model import Machine
from legcal.version import __version__

_MM = 1e3
_NEWTON = 8  # steps of the forward kinematics of a rig
_N = len(SIDES) + 1 + 3  # unknowns of a rig: sides, length, centre of rotation


def flypt_refusal(subject: Subject) -> str | None:
    """Return the reason for refusing a machine other than a hexapod, or None."""
    refusal = hexapod_refusal(subject)
    return (
        None if refusal is None else refusal.split("; ")[0].replace("genhexkins", "LinearHexapod")
    )


def flypt_files(subject: Subject, options: ExportOptions, path: Path) -> Rendered:
    """Return the numbers of the rig, and a picture of what remains."""
    machine = subject.machine
    readings, motions = workspace(machine)
    poses = stacked(motions)
    places = _Places(machine, readings, poses)
    x = places.nearest()
    numbers = dict(zip((*SIDES, "Middle", "COR X", "COR Y", "COR Z"), x[:_N], strict=True))
    stroke = np.ptp([leg.travel for leg in machine.legs], axis=1).min()
    numbers["Range"] = 0.5 * _MM * stroke
    text = "".join(f"{key}: {number_text(float(value))}\n" for key, value in numbers.items())
    rig, centre = rig_in(path, text)[:2]
    written = np.array([*(getattr(rig, side) for side in SIDES), rig.Middle, *centre])
    after = places.placed(written)
    before = None
    if subject.nominal is not None:
        there, reached = poses_at_readings(subject.nominal, readings, poses)
        of_nominal = _Places(subject.nominal, readings[reached], there[reached], places.order)
        before = places.placed(of_nominal.nearest()[:_N])
    sentences, figures = in_words("FlyPT Mover", "at the joints of the platform", after, before)
    legs = ", ".join(f"'{comment(machine.leg_names[j])}'" for j in places.order)
    sentences += [
        f"Actuators counterclockwise from the right one of the short side in front: {legs}.",
        "To use it, write the numbers into the rig (LinearHexapod) and start the rig from its "
        "lowest position; actuators have no offsets there, so that what they need is set in their "
        "controllers.",
    ]
    head = f"FlyPT Mover rig of {comment(subject.name)}, written by legcal {__version__}."
    comments = "".join(f"# {line}\n" for line in [head, *sentences])
    return with_picture(
        f"{comments}\n{text}", "FlyPT Mover", places.joints, after, before, sentences, figures
    )


class _Places:
    """Where a machine has the joints of its platform, at positions of its actuators [mm]."""

    def __init__(
        self, machine: Machine, readings: Array, poses: Array, order: list[int] | None = None
    ) -> None:
        B = _MM * machine.B_platform
        centred = B - B.mean(axis=0)
        home = machine.home.rotation.as_matrix()
        seen = centred @ home.T
        angle = np.degrees(np.arctan2(seen[:, 1], seen[:, 0])) % 360.0
        by_angle = np.argsort(angle)
        gaps = np.diff(angle[by_angle], append=angle[by_angle[0]] + 360.0)
        first = int(np.argmin([gaps[k] + gaps[k + 2] + gaps[(k + 4) % 6] for k in (0, 1)]))
        pairs = list(range(first, STRUTS, 2))
        middles = np.array([(angle[by_angle[k]] + 0.5 * gaps[k]) % 360.0 for k in pairs])
        front = pairs[int(np.argmin(np.abs((middles - 90.0 + 180.0) % 360.0 - 180.0)))]
        self.order = [int(j) for j in np.roll(by_angle, -front)] if order is None else order
        turn = (middles[pairs.index(front)] - 90.0 + 180.0) % 360.0 - 180.0
        self._turn = Rotation.from_euler("z", turn, degrees=True)
        self._of_platform = home.T @ self._turn.as_matrix()  # axes of the rig in the link
        legs = [machine.legs[j] for j in self.order]
        mid = np.array([np.mean(leg.travel) for leg in legs])
        sign = np.array([float(leg.sign) for leg in legs])
        self.moves = _MM * sign * (readings[:, self.order] - mid)  # (k, 6) beyond the middle
        self.poses = poses.copy()
        self.poses[:, :, 3] *= _MM
        self._B = B[self.order]
        A = _MM * machine.A_base[self.order]
        self._middle = A.mean(axis=0)
        self.joints = self._B @ np.swapaxes(poses[:, :, :3], 1, 2) + self.poses[:, None, :, 3]
        lengths = _MM * np.array(
            [leg.length_at(q) for leg, q in zip(legs, mid.tolist(), strict=True)]
        )
        (long, short), (short_base, long_base) = _sides(self._B, 0), _sides(A, 1)
        sides = [long, short, short_base, long_base]
        centre = -B.mean(axis=0) @ self._of_platform
        self._start = np.array([*sides, lengths.mean(), *centre])

    def errors(self, x: Array) -> Array:
        """Return the errors (k, 6, 3) of the joints, with a rig and the frame of its base (14,)."""
        rig = Rig(*x[: len(SIDES) + 1])
        frame = self._turn * Rotation.from_rotvec(x[_N + 3 :] / self._start[4])
        origin = self._middle + x[_N : _N + 3]
        near_R = frame.as_matrix().T @ self.poses[:, :, :3] @ self._of_platform
        near = (self.joints.mean(axis=1) - origin) @ frame.as_matrix()
        R, t = _forward(rig, rig.Middle + self.moves, near_R, near)
        joints = rig.platform @ np.swapaxes(R, 1, 2) + t[:, None]
        return np.asarray(joints @ frame.as_matrix().T + origin - self.joints)

    def nearest(self) -> Array:
        """Return the rig (8,) and its frame (6,) of least errors."""
        start = np.concatenate([self._start, np.zeros(6)])
        free = [*range(len(SIDES) + 1), *range(_N, _N + 6)]

        def errors(step: Array) -> Array:
            x = start.copy()
            x[free] += step
            return self.errors(x).ravel()

        start[free] += least_squares(errors, len(free))
        return start

    def placed(self, rig: Array) -> Array:
        """Return the errors (k, 6, 3) of a rig (8,) in its best frame."""
        frame = least_squares(lambda y: self.errors(np.concatenate([rig, y])).ravel(), 6)
        return self.errors(np.concatenate([rig, frame]))


def _sides(joints: Array, first: int) -> tuple[float, float]:
    """Return the mean sides of a hexagon: of pairs from the first or second joint, and others."""
    sides = np.linalg.norm(np.roll(joints, -1, axis=0) - joints, axis=1)
    others, pairs = float(sides[1 - first :: 2].mean()), float(sides[first::2].mean())
    return (others, pairs) if first == 0 else (pairs, others)


def _forward(rig: Rig, lengths: Array, R: Array, t: Array) -> tuple[Array, Array]:
    """Return the poses of a rig at lengths (k, 6), near others, by Newton's method."""
    for _ in range(_NEWTON):
        arms = rig.platform @ np.swapaxes(R, 1, 2)
        legs = arms + t[:, None] - rig.base
        now = np.linalg.norm(legs, axis=2)
        u = legs / now[..., None]
        slope = np.concatenate([u, cross(arms, u)], axis=2)
        step = np.linalg.solve(slope, (lengths - now)[..., None])[..., 0]
        t = t + step[:, :3]
        R = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ R
    return R, t
