"""Steps 1 to 3 on sessions of any shipped machine, and on bases that are made up."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from machine_session import PINHOLE, MachineSession, machine_session
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.identify.session import Session, at_base_joints, at_platform_joints
from legcal.data.axes import LegAxes, axes_from_outlines
from legcal.data.measurements import Measurements, View
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray
from legcal.machine import Leg, LegKind, moved_legs
from legcal.paper.joints_in_base import JointsInBase, locate_joints_in_base
from legcal.paper.joints_in_camera import JointsInCamera, locate_joints_in_cameras
from legcal.paper.leg_directions import (
    LegDirections,
    directions_through_joints,
    observed_directions,
)
from legcal.paper.nominal import Criteria, NominalMachine
from legcal.paper.offsets import Offsets, identify_offsets


@dataclass(frozen=True, eq=False)
class Observed:
    """What steps 1 to 3 take, and the truth behind it."""

    nominal: NominalMachine
    axes: LegAxes
    measurements: Measurements
    true_legs: tuple[Leg, ...]
    T_camera_Rb: tuple[RigidTransform, ...]

    @property
    def A_Rb(self) -> Array:
        """True base joint centres [m]."""
        return np.array([leg.A for leg in self.true_legs])

    @property
    def v_Rb(self) -> Array:
        """True revolute axes at the base; z in a plane."""
        up = np.array([0.0, 0.0, 1.0])
        nominal = self.nominal.base_axes if self.nominal.spatial else np.tile(up, (99, 1))
        return np.array(
            [
                leg.base_axis if leg.base_joint == "R" and leg.base_axis is not None else v
                for leg, v in zip(self.true_legs, nominal, strict=False)
            ]
        )


@dataclass(frozen=True, eq=False)
class Steps:
    """The results of steps 1 to 3."""

    joints: JointsInCamera
    base: JointsInBase
    directions: LegDirections
    offsets: Offsets


def three_steps(observed: Observed, criteria: Criteria = "default") -> Steps:
    """Run steps 1 to 3."""
    nominal, axes, m = observed.nominal, observed.axes, observed.measurements
    joints = locate_joints_in_cameras(nominal, axes, m, criteria=criteria)
    base = locate_joints_in_base(nominal, joints, criteria=criteria)
    directions = (
        observed_directions(nominal, axes, m, joints)
        if criteria == "literal"
        else directions_through_joints(nominal, axes, m, joints, base)
    )
    offsets = identify_offsets(nominal, directions, m.sigma_q, criteria=criteria)
    return Steps(joints, base, directions, offsets)


@cache
def shipped(name: str, *, n_poses: int = 6, noise: float = 0.0, seed: int = 0) -> Observed:
    """Return a shipped model as seen by three cameras, nominal legs being 3 mm and 1 deg off.

    The noise counts in that of 0.2 px at the ends of an outline.
    """
    session = machine_session(name, n_poses=n_poses)
    if noise > 0.0:
        covariance = noise**2 * session.outlines.covariance
        session = replace(session, outlines=replace(session.outlines, covariance=covariance))
        measurements, outlines = session.noisy(seed)
        session = replace(session, measurements=measurements, outlines=outlines)
    return _observed(session)


def _observed(session: MachineSession) -> Observed:
    legs = session.legs
    radii = {part: radius for (_, part), radius in legs.radii.items()}
    return Observed(
        NominalMachine(legs.names, legs.nominal, legs.sign, legs.frame_legs),
        axes_from_outlines(session.outlines, session.measurements, radii),
        session.measurements,
        session.truth.legs,
        session.truth.T_camera_Rb,
    )


def planned(session: Session, sign: Array) -> Observed:
    """Return exactly what a planned session will show, nominal legs being 3 mm and 1 deg off."""
    row, leg = np.nonzero(session.seen[session.view])
    pose = session.pose[row]
    u, length = session.u[pose, leg], session.length[pose, leg][:, None, None]
    E = normal_basis(u)
    at_A, at_B = (
        across.gradient[row, leg] @ np.swapaxes(E, 1, 2)
        for across in (at_base_joints(session), at_platform_joints(session))
    )
    rows = np.zeros((len(row), 4, 4))  # by alpha and beta at A
    rows[:, :2, 2:], rows[:, 2:, 2:], rows[:, 2:, :2] = at_A, at_B, length * at_B
    covariance = np.asarray(np.linalg.inv(np.swapaxes(rows, 1, 2) @ rows), dtype=np.float64)
    M = session.A[leg] - session.camera[session.view[row]]
    actuated = np.array([leg.kind is LegKind.ACTUATED for leg in session.legs])
    q = np.where(actuated, sign * (session.length - [leg.q0 for leg in session.legs]), np.nan)
    units = np.array(session.parametrization.units)
    step = np.where(units == "m", 0.003, np.deg2rad(1.0) / np.sqrt(2.0))
    step *= np.random.default_rng(0).choice([-1.0, 1.0], len(step))
    away = moved_legs(session.legs, session.parametrization.place, step)
    return Observed(
        NominalMachine(session.leg_names, away, sign, session.frame_legs),
        LegAxes(row, leg, u, M, E, covariance),
        Measurements(
            tuple(View(f"c{v + 1}", PINHOLE) for v in range(session.n_views)),
            ("",) * len(session.view),
            session.view,
            session.pose,
            q[session.pose],
            session.sigma_q,
        ),
        session.legs,
        tuple(RigidTransform.from_translation(-centre) for centre in session.camera),
    )


def made_up_base(A_Rb: Array, v_Rb: Array) -> NominalMachine:
    """Return a mechanism of RPS legs, or SPS where the axis is NaN, with R_b on joints 1, 2, 3."""
    up = np.array([0.0, 0.0, 1.0])
    legs = tuple(
        Leg("R", "S", LegKind.ACTUATED, A, A + up, 0.5, v)
        if np.isfinite(v[0])
        else Leg("S", "S", LegKind.ACTUATED, A, A + up, 0.5)
        for A, v in zip(A_Rb, v_Rb, strict=True)
    )
    names = tuple(f"leg{j + 1}" for j in range(len(legs)))
    return NominalMachine(names, legs, np.ones(len(legs)), (0, 1, 2))


def seen_from(
    A_Rb: Array, v_Rb: Array, seen: BoolArray, *, sigma: float = 1e-4, seed: int | None = None
) -> tuple[JointsInCamera, list[RigidTransform]]:
    """Return what step 1 finds of a base in views (n_views, n_legs), axes of any sign; T_Rb_camera.

    With a seed, centres [m] and axes [rad] have errors.
    """
    rng = np.random.default_rng(1)
    cameras = [
        RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng)) for _ in seen
    ]
    A = np.array([T.inv().apply(A_Rb) for T in cameras])
    v = np.array([T.rotation.inv().apply(np.nan_to_num(v_Rb)) for T in cameras])
    v *= rng.choice([-1.0, 1.0], v.shape[:2])[..., None]
    if seed is not None:
        noise = np.random.default_rng(seed)
        A += sigma * noise.normal(size=A.shape)
        v += sigma * noise.normal(size=v.shape)
        v /= np.maximum(np.linalg.norm(v, axis=2, keepdims=True), 1e-9)
    with_axis = seen & np.isfinite(v_Rb[:, 0])
    joints = JointsInCamera(
        np.where(seen[..., None], A, 0.0),
        seen,
        np.where(with_axis[..., None], v, 0.0),
        with_axis,
        np.where(seen[..., None, None], sigma**2 * np.eye(5), 0.0),
        (),
        np.zeros(len(seen), dtype=np.bool_),
    )
    return joints, cameras
