"""A machine beside its nominal model, ellipsoids at its joints, pyramids of cameras.

Points and lengths are in the base link [m]; ``scene.js`` of :mod:`legcal.pages` draws them on the
canvas of a page: a report, or that of :mod:`legcal.viewer`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import printable
from legcal.geometry.motions import components, product
from legcal.geometry.types import Array
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.machine.picture import around, corners_of_base, motor_lines
from legcal.machine.rods import ends_in_base, first_rods

if TYPE_CHECKING:
    from legcal.calibration.documents import Result
    from legcal.vision.camera import Camera

FACTORS = (0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000, 50000)
_SHOWN = 0.12  # default displayed size of the largest change, relative to the machine
_RING = 0.06  # size of the median ellipsoid, relative to the machine
_DEPTH = 0.25  # depth of the pyramid of a camera, relative to the machine


class PlacedModel(NamedTuple):
    """The visible geometry of a model at k poses, in the base link [m]."""

    A: Array  # (k, n_legs, 3)
    B: Array  # (k, n_legs, 3)
    anchors: Array  # (n_motors, 3) positions of motors that move joints at A
    standing: Array  # (n_motors, 2, 3) their rails and axes
    moving: Array  # (k, m, 2, 3) carriages, arms, and bars between the joints of one motor


class MachineScene:
    """A machine with the nominal model that it is compared with.

    *legs* are shown, in R_b and R_e of the machine, beside *nominal* ones; the *result* of a
    calibration is the source of ellipsoids.
    """

    def __init__(
        self,
        machine: Machine,
        legs: Sequence[Leg],
        nominal: Sequence[Leg] | None,
        result: Result | None,
    ) -> None:
        self.machine, self.legs, self.nominal = machine, legs, nominal
        A, B = machine.A_base, machine.home.apply(machine.B_platform)
        self.size = float(np.ptp(np.concatenate([A, B]), axis=0).max())  # at home [m]
        anchors = motor_lines(machine.legs, A[None]).anchors
        # Joints, or motors of the base, in order around base and platform, the first twice
        self.rims = {"base": around(corners_of_base(A, anchors)), "platform": around(B)}
        self.ellipsoids = {} if result is None else _ellipsoids(result)

    def placed(
        self,
        legs: Sequence[Leg],
        q: Array,
        near: Sequence[RigidTransform],
        *,
        by_readings: bool = True,
    ) -> PlacedModel:
        """Return the geometry of legs in R_b and R_e, motors and platform at readings q (k, n).

        Poses T_Rb_Re are solved *near* others, which are kept unless *by_readings*. Motors are
        fixed in the base link, even if A defines R_b.
        """
        poses = near
        if by_readings:
            from legcal.calibration.joint_fit.platform import poses_at_readings

            poses = poses_at_readings(self.machine, legs, q, near)
        frame = self.machine.T_base_Rb
        A, B = ends_in_base(legs, frame, *components(poses), q[:, first_rods(legs)])
        turn = frame.rotation.as_matrix()
        lines = motor_lines(legs, (A - frame.translation) @ turn)
        return PlacedModel(A, B, *(points @ turn.T + frame.translation for points in lines))

    def compared(
        self,
        shown: PlacedModel,
        q: Array,
        near: Sequence[RigidTransform],
        *,
        by_readings: bool,
    ) -> dict[str, Any]:
        """Return the content of ``scene.js`` at poses T_Rb_Re *near*: beside the nominal model.

        The machine is *shown* at readings q (k, n), and the nominal model at the same; their
        difference is exaggerated. Without a nominal model the machine is alone.
        """
        if self.nominal is None:
            return self.alone(shown, near)
        nominal = self.placed(self.nominal, q, near, by_readings=by_readings)
        moved = max(
            float(np.abs(shown.A - nominal.A).max()), float(np.abs(shown.B - nominal.B).max())
        )
        wanted = _SHOWN * self.size / max(moved, 1e-12)
        step = max(k for k, factor in enumerate(FACTORS) if factor <= max(wanted, 1.0))
        content = self._content((nominal, shown), near)
        return content | {"legend": ("nominal", "calibrated"), "factors": FACTORS, "step": step}

    def alone(self, shown: PlacedModel, near: Sequence[RigidTransform]) -> dict[str, Any]:
        """Return the content of ``scene.js`` without another model: the machine stands for both."""
        content = self._content((shown, shown), near)
        return content | {"legend": ("", "machine"), "factors": (1,), "step": 0}

    def _content(
        self, models: tuple[PlacedModel, PlacedModel], near: Sequence[RigidTransform]
    ) -> dict[str, Any]:
        """Return all of the content but what exaggerates, at poses T_Rb_Re."""
        factor = _enlargement(self.ellipsoids, _RING * self.size)
        to_link = self.machine.T_platform_Re.inv()
        turns = [
            product(self.machine.T_base_Rb, T, to_link).rotation.as_matrix().round(6) for T in near
        ]
        rings = {side: np.round(factor * axes, 6) for side, axes in self.ellipsoids.items()}
        return {
            "unit": "m",
            "flat": not self.machine.spatial,
            "models": [_model(model) for model in models],
            "names": [printable(name) for name in self.machine.leg_names],
            "rims": self.rims,
            "rings": {
                "name": f"1 sigma, {factor:g} times as large",
                "turns": [turn.tolist() for turn in turns],
                **{side: axes.tolist() for side, axes in rings.items()},
            },
        }

    def cameras(self, views: Iterable[tuple[str, Camera, RigidTransform]]) -> list[dict[str, Any]]:
        """Return names, cameras and T_base_camera as the pyramids of ``scene.js``."""
        depth = _DEPTH * self.size
        return [
            {"name": printable(name), "points": pyramid(camera, T, depth).round(4).tolist()}
            for name, camera, T in views
        ]


def _ellipsoids(result: Result) -> dict[str, Array]:
    """Return half axes of one sigma at the joints of base and platform, (n, 3, 3) [m].

    Columns are axes, in the link; they are zero along fixed coordinates and those that define a
    frame.
    """
    half_axes = {}
    for side, block in result.links.items():
        value, vector = np.linalg.eigh(np.array([joint.covariance for joint in block.joints]))
        half_axes[str(side)] = vector * np.sqrt(np.maximum(value, 0.0))[:, None]
    return half_axes


def _enlargement(axes: Mapping[str, Array], radius: float) -> float:
    """Return the factor 1, 2, 5, 10, ... that enlarges the median ellipsoid to nearly *radius*."""
    longest = [np.linalg.norm(of_side, axis=1).max(axis=1) for of_side in axes.values()]
    seen = np.concatenate([*longest, np.zeros(0)])
    usual = float(np.median(seen[seen > 0.0])) if np.any(seen > 0.0) else 1.0
    wanted = radius / usual
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(s for s in (1, 2, 5) if s * power <= wanted))


def pyramid(camera: Camera, T_base_camera: RigidTransform, depth: float) -> Array:
    """Return the centre of a camera and the corners of its view at a depth [m], (5, 3)."""
    w, h = camera.width - 0.5, camera.height - 0.5
    rays = depth * camera.rays(np.array([[-0.5, -0.5], [w, -0.5], [w, h], [-0.5, h]]))
    return np.asarray(T_base_camera.apply(np.concatenate([np.zeros((1, 3)), rays])))


def _model(model: PlacedModel) -> dict[str, Any]:
    """Return the geometry of a model; joints at A that no motor moves are included once."""
    is_fixed = np.ptp(model.A, axis=0).max() == 0.0
    once = model._replace(A=model.A[:1], moving=model.moving[:1]) if is_fixed else model
    return {name: np.round(values, 7).tolist() for name, values in once._asdict().items()}
