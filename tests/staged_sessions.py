"""What the four steps take of shipped machines, hexapods of section 4.3 and made-up bases."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from fit_sessions import PINHOLE, MachineSession, machine_session
from hexapod_sessions import PaperSession, disturbed_hexapod, moved, paper_session
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.identify.predicted_observations import (
    PredictedObservations,
    at_base_joints,
    at_platform_joints,
)
from legcal.data.axes import LegAxes, axes_from_outlines
from legcal.data.measurements import Measurements, View
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray
from legcal.machine.leg import JointType, KinematicParameters, Leg, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    Parametrization,
    moved_legs,
    parametrize,
    to_vector,
    vector_of,
)
from legcal.paper.criteria import Criteria
from legcal.paper.four_steps import StagedResult, run_base_steps, run_steps
from legcal.paper.joints_in_base import JointsInBase
from legcal.paper.joints_in_camera import JointsInCamera
from legcal.paper.nominal import NominalMachine
from legcal.simulation.observe import OutlineNoise, TableNoise
from legcal.simulation.paper import PAPER_VIEWS


@dataclass(frozen=True, eq=False)
class Observed:
    """What the steps take, and the truth behind it."""

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

    @property
    def is_angle(self) -> BoolArray:
        """Which parameters are angles."""
        return np.array([unit == "rad" for unit in self._parametrization().units])

    def run(self, criteria: Criteria = "default", **options: Any) -> StagedResult:
        """Run the four steps."""
        return run_steps(self.nominal, self.axes, self.measurements, criteria=criteria, **options)

    def run_base(self, criteria: Criteria = "default") -> JointsInBase:
        """Run steps 1 and 2."""
        return run_base_steps(self.nominal, self.axes, self.measurements, criteria=criteria)

    def errors(self, legs: tuple[Leg, ...], *, twists: bool = False) -> Array:
        """Return the error of every parameter of legs [m, rad]."""
        parametrization, true = self._parametrization(twists=twists), self.true_legs
        return vector_of(parametrization, legs, true) - vector_of(parametrization, true, true)

    def _parametrization(self, *, twists: bool = False) -> Parametrization:
        nominal = self.nominal
        return parametrize(nominal.leg_names, self.true_legs, nominal.frame_legs, twists=twists)


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
        NominalMachine(legs.names, legs.nominal, legs.frame_legs),
        axes_from_outlines(session.outlines, session.measurements, radii),
        session.measurements,
        session.truth.legs,
        session.truth.T_camera_Rb,
    )


def planned(session: PredictedObservations, *, noise: float = 0.0, seed: int = 0) -> Observed:
    """Return what a planned session will show, nominal legs being 3 mm and 1 deg off.

    The noise counts in the standard deviations of the session; without it all is exact.
    """
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
    M = session.A_at[pose, leg] - session.camera[session.view[row]]
    actuated = np.array([leg.kind is LegKind.ACTUATED for leg in session.legs])
    sign = [leg.sign for leg in session.legs]
    q = np.where(actuated, sign * (session.length - [leg.q0 for leg in session.legs]), np.nan)
    carried = session.carried_by >= 0
    q[:, carried] = session.q[:, session.carried_by[carried]]
    if noise > 0.0:
        rng = np.random.default_rng(seed)
        covariance *= noise**2
        errors = np.einsum(
            "nij,nj->ni", np.linalg.cholesky(covariance), rng.standard_normal((len(row), 4))
        )
        u, M = (
            x + np.einsum("nia,ni->na", E, e) for x, e in ((u, errors[:, :2]), (M, errors[:, 2:]))
        )
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        E = E - u[:, None] * np.einsum("nia,na->ni", E, u)[..., None]
        E /= np.linalg.norm(E, axis=2, keepdims=True)
        sigma = np.full(session.n_legs, session.sigma_q)
        sigma[carried] = session.sigma_of_q[session.carried_by[carried]]
        read = rng.standard_normal((len(q), session.n_legs))
        same = session.carried_by[:, None] == session.carried_by
        q = q + sigma * read[:, np.where(carried, same.argmax(axis=1), np.arange(len(same)))]
    units = np.array(session.parametrization.units)
    step = np.where(units == "m", 0.003, np.deg2rad(1.0) / np.sqrt(2.0))
    step *= np.random.default_rng(0).choice([-1.0, 1.0], len(step))
    away = moved_legs(session.legs, session.parametrization.place, step)
    return Observed(
        NominalMachine(session.leg_names, away, session.frame_legs),
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
    """Return a machine of RPS legs, or SPS where the axis is NaN, with R_b on joints 1, 2, 3."""
    up = np.array([0.0, 0.0, 1.0])
    legs = tuple(
        Leg(JointType("R"), JointType("S"), LegKind.ACTUATED, A, A + up, 0.5, v)
        if np.isfinite(v[0])
        else Leg(JointType("S"), JointType("S"), LegKind.ACTUATED, A, A + up, 0.5)
        for A, v in zip(A_Rb, v_Rb, strict=True)
    )
    names = tuple(f"leg{j + 1}" for j in range(len(legs)))
    return NominalMachine(names, legs, (0, 1, 2))


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


# Hexapods of section 4.3


@cache
def exact_session(
    seed: int = 0,
    *,
    coplanar: bool = False,
    noise: OutlineNoise | TableNoise | None = None,
    legs: tuple[tuple[int, ...], ...] = PAPER_VIEWS,
    n_poses: int = 6,
    share_poses: bool = False,
) -> PaperSession:
    """Return a session without noise of a hexapod 2 mm off its drawing."""
    return paper_session(
        disturbed_hexapod(seed, coplanar=coplanar),
        noise or OutlineNoise(),
        seed=seed,
        legs=legs,
        n_poses=n_poses,
        share_poses=share_poses,
    )


@cache
def noisy_session(
    seed: int, noise: OutlineNoise | TableNoise, *, coplanar: bool = False, n_poses: int = 15
) -> tuple[PaperSession, NominalMachine]:
    """Return a session with noise, and a nominal machine up to 2 mm wrong in every parameter."""
    machine = disturbed_hexapod(seed, coplanar=coplanar)
    session = paper_session(
        machine,
        noise,
        seed=seed,
        noisy=True,
        n_poses=n_poses,
        n_images=3 if isinstance(noise, TableNoise) else 1,
    )
    return session, moved(machine, np.random.default_rng(seed).uniform(-0.002, 0.002, 30))


def five_millimetres_away(machine: Machine, seed: int = 0) -> NominalMachine:
    """Return the machine with every parameter exactly 5 mm wrong, z and offsets included."""
    return moved(machine, 0.005 * np.random.default_rng(seed).choice([-1.0, 1.0], 30))


def errors(parameters: KinematicParameters, machine: Machine | NominalMachine) -> Array:
    """Return the absolute error of every parameter [m]."""
    difference = to_vector(parameters, machine.frame_legs) - to_vector(
        machine.parameters, machine.frame_legs
    )
    return np.asarray(np.abs(difference))


def staged(
    session: PaperSession, nominal: NominalMachine, criteria: Criteria = "default"
) -> StagedResult:
    """Run the four steps on a session."""
    return run_steps(nominal, session.axes, session.measurements, criteria=criteria)
