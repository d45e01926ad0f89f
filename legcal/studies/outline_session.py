"""One measurement of a design: noise, and a nominal model and rough cameras to start from.

What an estimator may look at is in the session; the truth stays in the design.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.leg_steps import moved_legs
from legcal.mechanism.parametrization import Parametrization
from legcal.observations.measurements import Measurements, View
from legcal.observations.outlines import Outlines
from legcal.simulation.observe import shifted_outlines
from legcal.studies.outline_design import OutlineDesign


@dataclass(frozen=True)
class StartErrors:
    """How wrong the nominal model and the rough camera poses are.

    Attributes
    ----------
    length : float
        Of every coordinate of the joints, every offset and constant length [m].
    angle : float
        Of every axis [rad].
    camera_shift, camera_turn : float
        Of every camera, in any direction and about any axis [m], [rad].
    full : bool
        Whether all errors have this size, up or down, in any direction; else it is the most that
        they have, and they are uniform.
    """

    length: float
    angle: float
    camera_shift: float
    camera_turn: float
    full: bool


@dataclass(frozen=True)
class Noise:
    """What is measured how well.

    Attributes
    ----------
    sigma_px : float
        Standard deviation of an edge point [px]; every pixel along an outline has one.
    sigma_q : float
        Standard deviation of a reading [m].
    radius_sigma : float
        Standard deviation of the nominal radii, as a part of the true ones.
    """

    sigma_px: float = 0.1
    sigma_q: float = 2e-6
    radius_sigma: float = 0.02


@dataclass(frozen=True, eq=False)
class OutlineSession:
    """What was measured, and what was known before.

    Attributes
    ----------
    measurements : Measurements
        Images, readings and rough camera poses. The base link's frame is R_b.
    outlines : Outlines
        Outlines in the images, with their covariances.
    leg_names : tuple of str
        Names of the legs.
    nominal : tuple of LegGeometry
        The nominal legs in R_b and R_e.
    sign : (n_legs,) array of int
        Leg length = sign * q + q0.
    frame_legs : tuple of int
        The legs that define R_b and R_e.
    radii : dict
        Nominal radius [m] of each (leg index, part).
    home : RigidTransform
        T_Rb_Re of the pose that the nominal model calls home; its legs meet near it.
    """

    measurements: Measurements
    outlines: Outlines
    leg_names: tuple[str, ...]
    nominal: tuple[LegGeometry, ...]
    sign: IntArray
    frame_legs: tuple[int, ...]
    radii: dict[tuple[int, str], float]
    home: RigidTransform


def draw_session(
    design: OutlineDesign, noise: Noise, errors: StartErrors, rng: np.random.Generator
) -> OutlineSession:
    """Return a measurement of a design.

    Parameters
    ----------
    design : OutlineDesign
        What is true; its outlines carry the covariance of their noise.
    noise : Noise
        What is measured how well.
    errors : StartErrors
        How wrong what is known before is.
    rng : numpy.random.Generator
        Source of all errors.
    """
    step = _parameter_errors(design.parametrization, errors, rng)
    return OutlineSession(
        measurements=_measurements(design, noise, errors, rng),
        outlines=_outlines(design, rng),
        leg_names=design.leg_names,
        nominal=moved_legs(design.legs, design.parametrization.place, step),
        sign=design.sign,
        frame_legs=design.frame_legs,
        radii={
            part: radius * float(1.0 + noise.radius_sigma * rng.normal())
            for part, radius in design.radii.items()
        },
        home=design.home,
    )


def _parameter_errors(
    parametrization: Parametrization, errors: StartErrors, rng: np.random.Generator
) -> Array:
    """Return by how much the nominal parameters are wrong [m, rad]."""
    unit = rng.uniform(-1.0, 1.0, len(parametrization))
    if errors.full:
        unit = np.sign(unit)
        for place in parametrization.place:
            for axis in (place[7:9], place[9:11]):
                if axis[0] >= 0:
                    unit[axis] = _direction(rng, 2)
    is_angle = np.array([u == "rad" for u in parametrization.units], dtype=np.bool_)
    return np.asarray(np.where(is_angle, errors.angle, errors.length) * unit)


def _measurements(
    design: OutlineDesign, noise: Noise, errors: StartErrors, rng: np.random.Generator
) -> Measurements:
    """Return readings with noise and views with rough camera poses."""
    is_read = [leg.kind is LegKind.ACTUATED for leg in design.legs]
    q = design.q + np.where(is_read, noise.sigma_q, 0.0) * rng.normal(size=design.q.shape)
    views = tuple(
        View(f"c{v + 1}", design.camera, _rough(T, errors, rng), seen)
        for v, (T, seen) in enumerate(zip(design.T_Rb_camera, design.seen, strict=True))
    )
    image = ("",) * len(design.view)
    return Measurements(views, image, design.view, design.pose, q[design.pose], noise.sigma_q)


def _rough(T: RigidTransform, errors: StartErrors, rng: np.random.Generator) -> RigidTransform:
    """Return the pose of a camera as somebody noted it."""
    shift, turn = (1.0, 1.0) if errors.full else rng.random(2)
    turned = Rotation.from_rotvec(errors.camera_turn * turn * _direction(rng, 3))
    moved = errors.camera_shift * shift * _direction(rng, 3)
    return RigidTransform.from_components(T.translation + moved, turned * T.rotation)


def _direction(rng: np.random.Generator, n: int) -> Array:
    """Return a unit vector (n,) that points anywhere."""
    v = rng.normal(size=n)
    return np.asarray(v / np.linalg.norm(v))


def _outlines(design: OutlineDesign, rng: np.random.Generator) -> Outlines:
    """Return outlines with noise."""
    exact = design.outlines
    root = np.linalg.cholesky(exact.covariance)
    offsets = np.einsum("nij,nj->ni", root, rng.normal(size=(len(exact), 2)))
    h, ends = shifted_outlines(design.camera, exact.h, exact.ends, offsets)
    return replace(exact, h=h, ends=ends)
