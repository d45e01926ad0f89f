"""What a fit expects of images that it has not seen is what they show, with shared errors too."""

from dataclasses import replace

import numpy as np
import pytest
from hexapod_session import (
    PINHOLE,
    Session,
    disturbed_start,
    moved_outlines,
    noisy_outlines,
    noisy_readings,
    simulate,
)
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.held_out import HeldOut, compare_held_out
from legcal.calibration.joint_fit.variables import start_from
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array, IntArray

N_SEEDS = 4


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(12, legs_seen=5, sigma_px=0.05)


def _held_out(session: Session, level: float, seed: int) -> HeldOut:
    """Return what a fourth of the images say of a fit of the others.

    Each edge of each leg errs alike in all images of a view, by *level* [px].
    """
    rng = np.random.default_rng(seed)
    outlines, measurements = noisy_outlines(session, rng), noisy_readings(session, rng)
    view = measurements.view[outlines.row]
    edge = np.stack([view, outlines.leg, outlines.edge - 1])
    errors = level * rng.standard_normal((3, 6, 2))
    outlines = moved_outlines(outlines, PINHOLE, np.repeat(errors[tuple(edge)][:, None], 2, axis=1))
    is_aside = np.arange(measurements.n_rows) % 4 == 2
    (fitted, shown, start), (aside, kept, near) = (
        _of_rows(session, measurements, outlines, rows)
        for rows in (np.flatnonzero(~is_aside), np.flatnonzero(is_aside))
    )
    begin = replace(disturbed_start(session), T_Rb_Re=start)
    solution = refine(session.legs, fitted, shown, begin)
    assert bool(solution.biases) == (level > 0.0)
    poses = start_from(solution.legs, aside, session.legs, (), near, "").T_Rb_Re
    return compare_held_out(solution.posterior, aside, kept, poses, 4.5)


def _of_rows(
    session: Session, measurements: Measurements, outlines: Outlines, rows: IntArray
) -> tuple[Measurements, Outlines, tuple[RigidTransform, ...]]:
    """Return some of the images, each of a pose of its own, with the start of their poses."""
    m = measurements
    images = tuple(m.image[i] for i in rows.tolist())
    some = replace(m, image=images, view=m.view[rows], pose=np.arange(len(rows)), q=m.q[rows])
    poses = disturbed_start(session).T_Rb_Re
    return some, outlines.at(rows), tuple(poses[k] for k in m.pose[rows].tolist())


def _ratios(session: Session, level: float) -> Array:
    """Return found over expected: in pixels, then displacement and rotation of the platform."""
    ratios = []
    for seed in range(N_SEEDS):
        found = _held_out(session, level, seed)
        assert found.rms_px is not None
        assert found.expected_px is not None
        assert len(found.displacement) == found.n_poses == 9
        ratios += [
            (found.rms_px / found.expected_px, displacement, rotation)
            for displacement, rotation in zip(
                found.displacement / found.expected_displacement,
                found.rotation / found.expected_rotation,
                strict=True,
            )
        ]
    return np.asarray(np.sqrt(np.mean(np.square(ratios), axis=0)))


@pytest.mark.parametrize("level", thinned([0.0, 0.05, 0.15], [0.0, 0.15]))
def test_images_are_as_far_off_as_is_expected(session: Session, level: float) -> None:
    pixels, displacement, rotation = _ratios(session, level)
    assert pixels == pytest.approx(1.0, abs=0.1)
    assert displacement == pytest.approx(1.0, abs=0.25)
    assert rotation == pytest.approx(1.0, abs=0.25)
