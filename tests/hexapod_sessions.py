"""Sessions of the hexapod of section 4.3 in memory, before cameras that see some of its legs."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from machines import from_vector
from scipy.spatial.transform import RigidTransform

from legcal.data.measurements import Measurements
from legcal.data.outlines import LegAxes, Outlines, axes_from_outlines, axes_of_table
from legcal.geometry.types import Array, IntArray
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, to_vector
from legcal.paper.unknowns import NominalMachine
from legcal.simulation.observe import (
    Images,
    OutlineNoise,
    Scene,
    TableNoise,
    Viewpoint,
    axes_in_images,
    outlines_of,
)
from legcal.simulation.paper import PAPER_VIEWS, paper_cameras
from legcal.simulation.session import draw_poses, simulate_session, streams
from legcal.simulation.settings import (
    Distribution,
    Level,
    ParameterErrors,
    Sampling,
    SimulationSettings,
    Spread,
)
from legcal.simulation.truth import write_true_model
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis, steps_to_outlines
from legcal.vision.visibility import Seen

SIGMA_Q = 2e-6  # [m]


@dataclass(frozen=True, eq=False)
class PaperSession:
    """Measurements of a hexapod of which each view shows some legs, and the truth behind them."""

    machine: Machine  # the true one
    measurements: Measurements
    outlines: Outlines
    axes: LegAxes
    scene: Scene
    T_Rb_Re: RigidTransform  # n_poses of them
    T_camera_Rb: tuple[RigidTransform, ...]  # of each view

    @property
    def radii(self) -> dict[str, float]:
        """The radii of the parts of all legs [m]."""
        return {part: r for leg in self.machine.legs for part, r in leg.radius_of_part.items()}


def plain_scene(
    A: Array,  # (n_poses, n_legs, 3)
    B: Array,
    views: Sequence[Viewpoint],
    view: IntArray,  # (n_rows,) view and pose of each image
    pose: IntArray,
    radii: Mapping[tuple[int, str], float],  # of each (leg, part) [m]
    seen: Sequence[Sequence[int]] | None = None,  # legs of each row; None for all
    span: tuple[float, float] = (0.15, 0.85),  # of the length of a leg that is seen
    arms: Mapping[tuple[int, str], Array] | None = None,  # which parts are arms: their ends
) -> Scene:
    """Return a scene in which nothing is hidden: images show legs over one part of their length."""
    arms, shown = arms or {}, list[Seen]()
    for row, (v, k) in enumerate(zip(view.tolist(), pose.tolist(), strict=True)):
        keys = [key for key in radii if seen is None or key[0] in seen[row]]
        of_arm = np.array([key in arms for key in keys], dtype=np.bool_)
        ends = [arms[key][k] if key in arms else (A[k, key[0]], B[k, key[0]]) for key in keys]
        ends = views[v].T_base_camera.inv().apply(np.reshape(ends, (-1, 3))).reshape(-1, 2, 3)
        along, radius = ends[:, 1] - ends[:, 0], np.array([radii[key] for key in keys])
        u = along / np.linalg.norm(along, axis=1, keepdims=True)
        h = outlines_of_axis(u, ends[:, 0], radius)
        axis = ends[:, :1] + np.array(span)[:, None] * along[:, None]
        px = views[v].camera.project(axis[:, None] + steps_to_outlines(h, radius)[:, :, None])
        shown.append(
            Seen(
                np.zeros(len(keys), dtype=np.intp),
                np.array([j for j, _ in keys], dtype=np.intp),
                of_arm,
                tuple(part for _, part in keys),
                h,
                px,
                np.tile(span, (len(keys), 1)),
                np.linalg.norm(px[:, :, 1] - px[:, :, 0], axis=-1).mean(axis=1),
            )
        )
    images = Images(view, pose, np.zeros(len(view), dtype=np.intp), tuple(shown))
    return Scene(A, B, tuple(views), images)


@cache
def disturbed_hexapod(seed: int = 0, *, coplanar: bool = False) -> Machine:
    """Return the shipped hexapod with every parameter up to 2 mm off."""
    error = Spread(0.002)
    errors = ParameterErrors(
        base_joints=error, platform_joints=error, offsets=error, coplanar=coplanar
    )
    with tempfile.TemporaryDirectory() as folder:
        rng = np.random.default_rng(seed)
        return write_true_model(load_mechanism("hexapod"), errors, rng, Path(folder))


def nominal_of(machine: Machine) -> NominalMachine:
    """Return a machine of point-like joints as the steps take it."""
    vector = to_vector(geometries(machine), machine.frame_legs)
    legs = from_vector(vector, machine.n_legs, machine.frame_legs)
    return NominalMachine(machine.leg_names, legs, machine.frame_legs)


def moved(machine: Machine, step: np.ndarray) -> NominalMachine:
    """Return a machine with all parameters changed, as the steps take it."""
    vector = to_vector(geometries(machine), machine.frame_legs) + step
    legs = from_vector(vector, machine.n_legs, machine.frame_legs)
    return NominalMachine(machine.leg_names, legs, machine.frame_legs)


def extreme_poses(machine: Machine, n_poses: int, seed: int) -> RigidTransform:
    """Return poses T_Rb_Re with every motor near an end of its travel."""
    drawn = draw_poses(machine, n_poses, np.random.default_rng(seed), Sampling.EXTREME).poses
    return RigidTransform.concatenate(list(platforms_in_base(machine, drawn)))


def paper_session(
    machine: Machine,
    noise: OutlineNoise | TableNoise,
    *,
    seed: int = 0,
    noisy: bool = False,  # else all is exact, and carries the covariances of the noise
    legs: Sequence[Sequence[int]] = PAPER_VIEWS,
    camera: Camera | None = None,
    n_poses: int = 6,  # of each view
    n_images: int = 1,  # of each pose
    share_poses: bool = False,
) -> PaperSession:
    """Return a session; its axes have the noise of Table 1, or come from outlines."""
    rng = np.random.default_rng(seed)
    settings = SimulationSettings(
        level=Level.OUTLINES,
        poses=n_poses,
        images=n_images,
        shared_poses=share_poses,
        views=paper_cameras(machine, rng, legs, camera),
        occlusion=False,
        readings=Spread(SIGMA_Q * noisy, Distribution.NORMAL),
    )
    made = simulate_session(machine, machine, settings, streams(seed))
    m = replace(made.measurements, sigma_q=SIGMA_Q)
    radii = {  # one cylinder for each leg
        (j, f"{leg.name}_tube"): leg.radius_of_part[f"{leg.name}_tube"]
        for j, leg in enumerate(machine.legs)
    }
    scene = plain_scene(
        made.scene.A, made.scene.B, made.scene.views, m.view, m.pose, radii,
        [legs[v] for v in m.view],
    )  # fmt: skip
    errors = rng if noisy else None
    white = noise if isinstance(noise, OutlineNoise) else OutlineNoise()
    outlines = outlines_of(scene, white, errors)
    if isinstance(noise, TableNoise):
        axes = axes_of_table(*axes_in_images(scene, noise, errors))
    else:
        axes = axes_from_outlines(outlines, m, {part: r for (_, part), r in radii.items()})
    return PaperSession(
        machine,
        m,
        outlines,
        axes,
        scene,
        RigidTransform.concatenate(list(platforms_in_base(machine, made.poses.poses))),
        tuple(view.T_base_camera.inv() * machine.T_base_Rb for view in made.scene.views),
    )
