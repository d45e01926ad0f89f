"""What is the same in all runs of a study of outlines: a true machine, its poses, what cameras see.

Poses and cameras are drawn as for a simulated dataset, and rays find which stretches of which legs
an image shows. All of it is drawn once for each machine: the bound is then one matrix, and a run
costs no more than its noise and its fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parameters import radius_name
from legcal.mechanism.parametrization import Parametrization, geometries, parametrize
from legcal.mechanism.platform import platform_in_base
from legcal.observations.outlines import Outlines
from legcal.simulation.camera_places import places_around
from legcal.simulation.cameras import mild_lens
from legcal.simulation.dressing import dressed
from legcal.simulation.images import Images, Viewpoint, take_images
from legcal.simulation.motion import draw_poses
from legcal.simulation.posed_machine import PosedMachine, pose_machine
from legcal.simulation.tables import outlines_of_images
from legcal.studies.closed_poses import closed_poses
from legcal.studies.outline_machines import MOST_LEGS, true_mechanism
from legcal.vision.camera import Camera

_SEED = 2002


@dataclass(frozen=True, eq=False)
class OutlineDesign:
    """A true machine, its poses, its cameras and its outlines without noise.

    Attributes
    ----------
    leg_names : tuple of str
        Names of the legs.
    legs : tuple of LegGeometry
        The true legs in R_b and R_e.
    sign : (n_legs,) array of int
        Leg length = sign * q + q0.
    frame_legs : tuple of int
        The legs that define R_b and R_e.
    radii : dict
        True radius [m] of each (leg index, part).
    home : RigidTransform
        T_Rb_Re of the pose that the model calls home.
    R, t : (n_poses, 3, 3) and (n_poses, 3) array
        The true poses of R_e in R_b [m].
    q : (n_poses, n_legs) array
        Exact readings [m]; zero for constant legs, NaN for passive ones.
    camera : Camera
        Intrinsics of all cameras.
    T_Rb_camera : tuple of RigidTransform
        Their true poses.
    seen : tuple of tuple of str, or None
        The legs that each view is said to see; None for all.
    view, pose : (n_rows,) array of int
        View and pose of each image.
    outlines : Outlines
        What the images show, exactly, with the covariance of the noise.
    """

    leg_names: tuple[str, ...]
    legs: tuple[LegGeometry, ...]
    sign: IntArray
    frame_legs: tuple[int, ...]
    radii: dict[tuple[int, str], float]
    home: RigidTransform
    R: Array
    t: Array
    q: Array
    camera: Camera
    T_Rb_camera: tuple[RigidTransform, ...]
    seen: tuple[tuple[str, ...] | None, ...]
    view: IntArray
    pose: IntArray
    outlines: Outlines

    @property
    def parametrization(self) -> Parametrization:
        """The kinematic parameters."""
        return parametrize(self.leg_names, self.legs, self.frame_legs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is to be found: the kinematic parameters, then the radii observed."""
        radii = (radius_name(self.leg_names[leg], part) for leg, part in self.parts)
        return (*self.parametrization.names, *radii)

    @property
    def parts(self) -> tuple[tuple[int, str], ...]:
        """Leg index and part of each radius that is observed, by leg and name."""
        shown = zip(self.outlines.leg.tolist(), self.outlines.part, strict=True)
        return tuple(sorted(set(shown)))


@lru_cache(maxsize=32)  # a study goes through all of its machines in every run
def design_of(name: str, n_views: int, n_poses: int, sigma_px: float) -> OutlineDesign:
    """Return the design of a machine; the same one in all processes.

    Parameters
    ----------
    name : str
        The machine, one of those of :mod:`legcal.studies.outline_machines`.
    n_views : int
        Number of cameras.
    n_poses : int
        Poses that each of them sees; no two see the same.
    sigma_px : float
        Standard deviation of an edge point [px]; every pixel along an outline has one.
    """
    mechanism = true_mechanism(name)
    rng = np.random.default_rng(_SEED)
    lens = mild_lens()
    drawn = draw_poses(mechanism, n_views * n_poses, rng)
    machines = pose_machine(mechanism, dressed(mechanism), drawn)
    places = places_around(mechanism, machines, [lens] * n_views, rng)
    views = tuple(Viewpoint(f"c{v + 1}", lens, T) for v, T in enumerate(places))
    images = take_images(mechanism.legs, machines, views, 1, shared_poses=False)
    legs = geometries(mechanism)
    R, t = closed_poses(
        legs, mechanism.frame_legs, *_arrays([platform_in_base(mechanism, T) for T in drawn.poses])
    )
    closed = _standing(mechanism, machines, R, t)
    outlines = outlines_of_images(images, closed, views, sigma_px, None)
    seen = _best_legs(images, n_views, MOST_LEGS.get(name, mechanism.n_legs))
    outlines = _only(outlines, np.array([j in seen[images.view[r]] for r, j in _keys(outlines)]))
    return OutlineDesign(
        leg_names=mechanism.leg_names,
        legs=legs,
        sign=mechanism.sign.astype(np.intp),
        frame_legs=mechanism.frame_legs,
        radii={
            (j, part): radius
            for j, leg in enumerate(mechanism.legs)
            for part, radius in leg.radius_of_part.items()
        },
        home=platform_in_base(mechanism, mechanism.home),
        R=R,
        t=t,
        q=_readings(legs, mechanism.sign, R, t),
        camera=lens,
        T_Rb_camera=tuple(mechanism.T_base_Rb.inv() * T for T in places),
        seen=tuple(
            None if len(s) == mechanism.n_legs else tuple(mechanism.leg_names[j] for j in s)
            for s in seen
        ),
        view=images.view,
        pose=images.pose,
        outlines=outlines,
    )


def _standing(
    mechanism: Mechanism, machines: Sequence[PosedMachine], R: Array, t: Array
) -> list[PosedMachine]:
    """Return a machine with its joint centres where the equations of its legs put them."""
    B = np.array([leg.B for leg in geometries(mechanism)])
    placed = np.einsum("kij,lj->kli", R, B) + t[:, None]
    return [
        replace(machine, B=np.asarray(mechanism.T_base_Rb.apply(points)))
        for machine, points in zip(machines, placed, strict=True)
    ]


def _best_legs(images: Images, n_views: int, most: int) -> list[list[int]]:
    """Return the legs, as many as asked for, that are seen longest in each view."""
    found = []
    for v in range(n_views):
        rows = np.flatnonzero(images.view == v)
        length = [[leg.length_px * leg.is_seen for leg in images.shown[r]] for r in rows]
        order = np.argsort(-np.mean(length, axis=0), kind="stable")
        found.append(sorted(order[:most].tolist()))
    return found


def _keys(outlines: Outlines) -> list[tuple[int, int]]:
    """Return the image and the leg of each outline."""
    return list(zip(outlines.row.tolist(), outlines.leg.tolist(), strict=True))


def _only(outlines: Outlines, chosen: Array) -> Outlines:
    """Return some of the outlines."""
    index = np.flatnonzero(chosen)
    return Outlines(
        row=outlines.row[index],
        leg=outlines.leg[index],
        part=tuple(outlines.part[i] for i in index),
        edge=outlines.edge[index],
        h=outlines.h[index],
        ends=outlines.ends[index],
        covariance=outlines.covariance[index],
        used=outlines.used[index],
        reason=("",) * len(index),
        source=("detected",) * len(index),
    )


def _readings(legs: Sequence[LegGeometry], sign: Array, R: Array, t: Array) -> Array:
    """Return the readings of all legs at poses (n_poses, n_legs) [m]."""
    q = np.zeros((len(t), len(legs)))
    for j, leg in enumerate(legs):
        if leg.kind is LegKind.PASSIVE:
            q[:, j] = np.nan
        elif leg.kind is LegKind.ACTUATED:
            length = np.linalg.norm(R @ leg.B + t - leg.A, axis=-1)
            q[:, j] = sign[j] * (length - leg.q0)
    return q


def _arrays(poses: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotation matrices and positions of poses."""
    together = RigidTransform.concatenate(list(poses))
    rotation: Rotation = together.rotation
    return rotation.as_matrix(), np.asarray(together.translation)
