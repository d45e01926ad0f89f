"""The fit finds the truth: exactly without noise, as predicted with it, in spite of outliers."""

import dataclasses

import numpy as np
import pytest
from hexapod_session import (
    FRAME_LEGS,
    LENS,
    PINHOLE,
    Session,
    disturbed_start,
    gauge_is_kept,
    joint_errors,
    moved_outlines,
    noisy_outlines,
    noisy_readings,
    simulate,
)
from scipy.spatial.transform import RigidTransform, Rotation
from thinned import thinned

from legcal.calibration.joint_fit.fit import refine, refine_from_best
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import FittedLegs, RefinementSettings
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array
from legcal.machine import KinematicParameters, parameters_of_legs


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(15)


@pytest.fixture(scope="module")
def small() -> Session:
    return simulate(6, legs_seen=5)


@pytest.fixture(scope="module")
def noisy(small: Session) -> tuple[Measurements, Outlines]:
    rng = np.random.default_rng(5)
    return noisy_readings(small, rng), noisy_outlines(small, rng)


@pytest.mark.parametrize(
    ("joints", "camera", "degrees"), [(0.002, 0.005, 0.6), (0.005, 0.005, 2.0), (0.005, 0.02, 3.0)]
)
def test_exact_outlines_give_the_truth(
    session: Session, joints: float, camera: float, degrees: float
) -> None:
    start = disturbed_start(session, joints=joints, camera=camera, angle=np.deg2rad(degrees))
    assert np.abs(joint_errors(parameters_of_legs(start.legs))).min() > 0.9 * joints
    solution = refine(session.legs, session.measurements, session.outlines, start)
    assert np.abs(joint_errors(solution.parameters)).max() < 1e-9
    assert gauge_is_kept(solution.parameters)
    assert solution.outlines.used.all()
    for found, true in zip(solution.T_Rb_Re, session.T_Rb_Re, strict=True):
        assert np.linalg.norm((found.inv() * true).translation) < 1e-9
        assert (found.inv() * true).rotation.magnitude() < 1e-8


def test_exact_outlines_through_a_lens_give_the_truth() -> None:
    session = simulate(6, camera=LENS, legs_seen=5)
    solution = refine(
        session.legs, session.measurements, session.outlines, disturbed_start(session)
    )
    assert np.abs(joint_errors(solution.parameters)).max() < 1e-9


def test_images_of_one_pose_share_it() -> None:
    session = simulate(8, shared_poses=True, legs_seen=5)
    solution = refine(
        session.legs, session.measurements, session.outlines, disturbed_start(session)
    )
    assert len(solution.T_Rb_Re) == 8
    assert np.abs(joint_errors(solution.parameters)).max() < 1e-9


def test_legs_that_no_image_shows_are_found_from_their_encoders(session: Session) -> None:
    shown = dataclasses.replace(session.outlines, used=session.outlines.leg != 2)
    solution = refine(session.legs, session.measurements, shown, disturbed_start(session))
    assert np.abs(joint_errors(solution.parameters)).max() < 1e-9
    assert (2, "rod") not in solution.radii


def test_encoders_carry_the_scale_so_that_a_wrong_radius_is_found() -> None:
    session = simulate(15, radius=1.01 * 0.010, sigma_px=0.01)
    start = disturbed_start(session)
    solution = refine(session.legs, session.measurements, session.outlines, start)
    # The prior, 2 % of the radius, pulls a little; what it costs is within sigma.
    sigma_radii = solution.sigma[-len(solution.radii) :]
    assert all(name.split(".")[1] == "radius" for name in solution.names[-len(sigma_radii) :])
    for radius, sigma in zip(solution.radii.values(), sigma_radii, strict=True):
        assert radius == pytest.approx(0.0101, abs=3e-6)
        assert sigma < 1e-5
    assert np.abs(joint_errors(solution.parameters)).max() < 20e-6


@pytest.mark.parametrize("n", thinned([12, 30], [12]))
def test_errors_agree_with_the_covariance(n: int) -> None:
    session = simulate(6, legs_seen=5)
    start = disturbed_start(session)
    normalised, z, scales, chi2 = [], [], [], []
    for seed in range(n):
        rng = np.random.default_rng(seed)
        measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
        found = refine(session.legs, measurements, outlines, start)
        error = joint_errors(found.parameters)
        normalised.append(error @ np.linalg.solve(found.kinematic_covariance, error) / len(error))
        z.append(error / found.sigma[: len(error)])
        scales.append(found.noise.scale)
        chi2.append(found.chi2 / found.dof)
    # The mean of n chi-squares of 30 degrees, over 30: 1 with standard deviation 0.26 / sqrt(n);
    # the noise is estimated from some 200 residuals a run, which widens it a little.
    assert np.mean(normalised) == pytest.approx(1.0, abs=1.1 / np.sqrt(n))
    assert 0.75 < np.mean(np.square(z)) < 1.3
    assert np.mean(scales) == pytest.approx(1.0, abs=0.05)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.08)


def with_wrong_outlines(outlines: Outlines, share: float, rng: np.random.Generator) -> Outlines:
    wrong = rng.random(len(outlines)) < share
    size = rng.uniform(2.0, 30.0, len(outlines)) * rng.choice([-1.0, 1.0], len(outlines))
    return moved_outlines(outlines, PINHOLE, np.where(wrong, size, 0.0)[:, None] * np.ones(2))


def test_a_fifth_of_the_outlines_wrong_costs_less_than_half_the_accuracy(session: Session) -> None:
    start = disturbed_start(session)
    clean, dirty = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
        wrong = with_wrong_outlines(outlines, 0.2, rng)
        moved = np.abs(wrong.ends - outlines.ends).max(axis=(1, 2)) > 1.0
        assert 40 < moved.sum() < 110
        clean.append(joint_errors(refine(session.legs, measurements, outlines, start).parameters))
        found = refine(session.legs, measurements, wrong, start)
        dirty.append(joint_errors(found.parameters))
        assert not found.outlines.used[moved].any()
        assert (~found.outlines.used[~moved]).sum() <= 2
    assert np.sqrt(np.mean(np.square(dirty)) / np.mean(np.square(clean))) < 1.5


def test_a_rejected_outline_carries_the_reason(session: Session) -> None:
    shift = np.zeros((len(session.outlines), 2))
    shift[7] = 3.2
    outlines = moved_outlines(session.outlines, PINHOLE, shift)
    found = refine(session.legs, session.measurements, outlines, disturbed_start(session))
    assert found.outlines.reason[7] == "disagrees with the fit by 3.2 px"
    assert np.flatnonzero(~found.outlines.used).tolist() == [7]
    assert np.abs(joint_errors(found.parameters)).max() < 1e-9


def assert_same(one: Solution, other: Solution, tolerance: float) -> None:
    for a, b in zip(vectors(one.parameters), vectors(other.parameters), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)


def vectors(parameters: KinematicParameters) -> tuple[Array, Array, Array]:
    return parameters.base_joints, parameters.platform_joints, parameters.offsets


def test_where_the_fit_starts_does_not_show_in_the_result(
    small: Session, noisy: tuple[Measurements, Outlines]
) -> None:
    starts = [disturbed_start(small, seed=seed) for seed in (1, 2)]
    one, other = (refine(small.legs, *noisy, start) for start in starts)
    assert_same(one, other, 1e-9)


def test_the_result_is_reproduced_and_rows_in_another_order_change_nothing(
    small: Session, noisy: tuple[Measurements, Outlines]
) -> None:
    measurements, outlines = noisy
    start = disturbed_start(small)
    found = refine(small.legs, measurements, outlines, start)
    assert_same(found, refine(small.legs, measurements, outlines, start), 0.0)
    order = np.random.default_rng(0).permutation(len(outlines))
    shuffled = Outlines(
        outlines.row[order],
        outlines.leg[order],
        outlines.part,
        outlines.edge[order],
        outlines.h[order],
        outlines.ends[order],
        outlines.covariance[order],
        outlines.used[order],
        outlines.reason,
        outlines.source,
    )
    assert_same(found, refine(small.legs, measurements, shuffled, start), 1e-12)


def test_moving_the_rough_camera_frame_changes_nothing(
    small: Session, noisy: tuple[Measurements, Outlines]
) -> None:
    start = disturbed_start(small)
    T = RigidTransform.from_components([0.004, -0.003, 0.005], Rotation.from_rotvec([0.01, 0, 0]))
    moved = dataclasses.replace(start, T_camera_Rb=tuple(c * T for c in start.T_camera_Rb))
    assert_same(refine(small.legs, *noisy, start), refine(small.legs, *noisy, moved), 1e-9)


def test_relabelling_legs_relabels_the_result(
    small: Session, noisy: tuple[Measurements, Outlines]
) -> None:
    measurements, outlines = noisy
    start = disturbed_start(small)
    found = refine(small.legs, measurements, outlines, start)
    order = np.array([3, 0, 5, 4, 2, 1])  # new leg i is old leg order[i]
    new_of_old = np.argsort(order)
    legs = FittedLegs(
        tuple(small.legs.names[i] for i in order),
        tuple(small.legs.nominal[i] for i in order),
        small.legs.sign[order],
        tuple(int(new_of_old[i]) for i in FRAME_LEGS),
        {(int(new_of_old[i]), part): r for (i, part), r in small.legs.radii.items()},
    )
    relabelled = dataclasses.replace(start, legs=tuple(start.legs[i] for i in order))
    again = refine(
        legs,
        dataclasses.replace(measurements, q=measurements.q[:, order]),
        dataclasses.replace(outlines, leg=new_of_old[outlines.leg]),
        relabelled,
    )
    for a, b in zip(vectors(found.parameters), vectors(again.parameters), strict=True):
        np.testing.assert_allclose(a[order], b, rtol=0, atol=1e-10)


def test_a_leg_that_shrinks_with_its_reading_is_fitted_as_well(small: Session) -> None:
    sign = np.array([1, -1, 1, 1, -1, 1])
    legs = dataclasses.replace(small.legs, sign=sign)
    measurements = dataclasses.replace(small.measurements, q=sign * small.measurements.q)
    found = refine(legs, measurements, small.outlines, disturbed_start(small))
    assert np.abs(joint_errors(found.parameters)).max() < 1e-9


def test_the_better_start_wins_and_is_named(
    small: Session, noisy: tuple[Measurements, Outlines]
) -> None:
    good = disturbed_start(small)
    bad = dataclasses.replace(
        disturbed_start(small, joints=0.1, camera=0.5, angle=2.0), label="staged"
    )
    for starts in ([good, bad], [bad, good]):
        settings = RefinementSettings(max_iterations=40)
        found = refine_from_best(small.legs, *noisy, starts, settings)
        assert found.start == "nominal"
        assert any("staged" in note for note in found.notes)
        assert any("nominal led to a cost of" in note for note in found.notes)


def test_between_equal_starts_the_first_wins(
    small: Session, noisy: tuple[Measurements, Outlines]
) -> None:
    nominal = disturbed_start(small)
    staged = dataclasses.replace(disturbed_start(small, seed=9), label="staged")
    assert refine_from_best(small.legs, *noisy, [nominal, staged]).start == "nominal"
    assert refine_from_best(small.legs, *noisy, [staged, nominal]).start == "staged"
