"""All four steps: exact recovery, invariance, noise."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from staged_hexapods import errors, exact_session, five_millimetres_away, noisy_session

from legcal.data.axes import LegAxes, axes_from_outlines
from legcal.geometry.types import IntArray
from legcal.machine import KinematicParameters
from legcal.paper.four_steps import StagedResult, run_steps
from legcal.paper.nominal import Criteria
from legcal.simulation.hexapod import HexapodSession, PaperHexapod, extreme_poses
from legcal.simulation.observe import OutlineNoise, TableNoise, shifted_outlines
from legcal.simulation.paper import nominal_of, platform_errors


def _run(
    session: HexapodSession, nominal: PaperHexapod, criteria: Criteria = "default"
) -> StagedResult:
    return run_steps(nominal_of(nominal), session.axes, session.measurements, criteria=criteria)


@pytest.mark.parametrize("coplanar", [False, True])
@pytest.mark.parametrize("noise", [OutlineNoise(), TableNoise()])
def test_exact_observations_give_exact_parameters_from_five_millimetres_away(
    noise: OutlineNoise | TableNoise, coplanar: bool
) -> None:
    session = exact_session(coplanar=coplanar, noise=noise)
    nominal = five_millimetres_away(session.machine)
    assert errors(nominal.parameters, session.machine).min() > 0.00499
    result = _run(session, nominal)
    assert errors(result.parameters, session.machine).max() < 1e-9
    assert result.diagnostics == ()


@given(seed=st.integers(0, 10**6))
@settings(max_examples=4, deadline=None)
def test_exact_recovery_on_other_machines_with_other_starts(seed: int) -> None:
    session = exact_session(seed)
    result = _run(session, five_millimetres_away(session.machine, seed))
    assert errors(result.parameters, session.machine).max() < 1e-9


def test_exact_recovery_from_three_cameras_that_share_poses_and_see_everything() -> None:
    session = exact_session(legs=((0, 1, 2, 3, 4, 5),) * 3, share_poses=True)
    assert session.measurements.n_poses == 6
    result = _run(session, five_millimetres_away(session.machine))
    assert errors(result.parameters, session.machine).max() < 1e-9


def _turned(axes: LegAxes, turns: Rotation) -> LegAxes:
    """Return the axes in camera frames that are turned, one rotation an axis."""
    basis = np.stack([turns.apply(axes.basis[:, 0]), turns.apply(axes.basis[:, 1])], axis=1)
    return replace(axes, u=turns.apply(axes.u), M=turns.apply(axes.M), basis=basis)


def test_turning_the_cameras_where_they_stand_changes_nothing() -> None:
    session, nominal = noisy_session(0, OutlineNoise(), n_poses=6)
    by_view = Rotation.random(3, rng=np.random.default_rng(1))
    view = session.measurements.view[session.axes.row]
    turned = replace(session, axes=_turned(session.axes, by_view[view]))
    first, second = _run(session, nominal), _run(turned, nominal)
    assert errors(first.parameters, replace(nominal, parameters=second.parameters)).max() < 1e-9


def _relabelled(
    session: HexapodSession, nominal: PaperHexapod, order: IntArray
) -> tuple[HexapodSession, PaperHexapod]:
    """Return the session and the nominal machine with leg order[i] in place i."""
    place = np.argsort(order)
    axes, measurements = session.axes, session.measurements
    p = nominal.parameters
    machine = replace(
        nominal,
        parameters=KinematicParameters(
            p.base_joints[order], p.platform_joints[order], p.offsets[order]
        ),
        sign=nominal.sign[order],
        frame_legs=tuple(int(place[j]) for j in nominal.frame_legs),
    )
    moved = replace(
        session,
        axes=replace(axes, leg=place[axes.leg]),
        measurements=replace(measurements, q=measurements.q[:, order]),
    )
    return moved, machine


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_relabelling_the_legs_relabels_the_result(criteria: Criteria) -> None:
    session, nominal = noisy_session(0, OutlineNoise(0.05), n_poses=6)
    order = np.array([3, 0, 5, 1, 4, 2])
    first = _run(session, nominal, criteria).parameters
    second = _run(*_relabelled(session, nominal, order), criteria).parameters
    assert np.allclose(second.base_joints, first.base_joints[order], atol=1e-8)
    assert np.allclose(second.platform_joints, first.platform_joints[order], atol=1e-8)
    assert np.allclose(second.offsets, first.offsets[order], atol=1e-8)


def test_reordering_the_images_changes_nothing() -> None:
    session, nominal = noisy_session(0, OutlineNoise(), n_poses=6)
    m, axes = session.measurements, session.axes
    order = np.random.default_rng(0).permutation(m.n_rows)
    place = np.argsort(order)
    shuffled = np.random.default_rng(1).permutation(len(axes))
    fields = ("leg", "u", "M", "basis", "covariance")
    moved = replace(
        session,
        axes=LegAxes(
            place[axes.row][shuffled], *(getattr(axes, name)[shuffled] for name in fields)
        ),
        measurements=replace(m, view=m.view[order], pose=m.pose[order], q=m.q[order]),
    )
    first, second = _run(session, nominal), _run(moved, nominal)
    assert errors(first.parameters, replace(nominal, parameters=second.parameters)).max() < 1e-10


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_scaling_all_lengths_scales_the_result(scale: float) -> None:
    session, nominal = noisy_session(0, OutlineNoise(), n_poses=6)
    axes, m, p = session.axes, session.measurements, nominal.parameters
    by = np.array([1.0, 1.0, scale, scale])
    larger = replace(
        session,
        axes=replace(axes, M=scale * axes.M, covariance=axes.covariance * np.outer(by, by)),
        measurements=replace(m, q=scale * m.q, sigma_q=scale * m.sigma_q),
    )
    machine = replace(
        nominal,
        parameters=KinematicParameters(
            scale * p.base_joints, scale * p.platform_joints, scale * p.offsets
        ),
    )
    first, second = _run(session, nominal), _run(larger, machine)
    difference = errors(second.parameters, replace(machine, parameters=_scaled(first, scale)))
    assert difference.max() < 1e-8 * scale


def _scaled(result: StagedResult, scale: float) -> KinematicParameters:
    p = result.parameters
    return KinematicParameters(scale * p.base_joints, scale * p.platform_joints, scale * p.offsets)


def _improvement(seeds: range, noise: OutlineNoise | TableNoise, criteria: Criteria) -> float:
    """Return by how much the steps reduce the mean displacement of eq (20), over all seeds."""
    before, after = [], []
    for seed in seeds:
        session, nominal = noisy_session(seed, noise)
        poses = extreme_poses(session.machine, 5, np.random.default_rng(99))
        result = _run(session, nominal, criteria)
        before.append(platform_errors(session.machine, nominal.parameters, poses).dX)
        after.append(platform_errors(session.machine, result.parameters, poses).dX)
    return float(np.mean(before) / np.mean(after))


def test_with_the_noise_of_table_1_the_default_improves_the_model_fivefold() -> None:
    assert _improvement(range(2), TableNoise(), "default") > 5.0


def test_with_the_noise_of_table_1_the_literal_criteria_make_the_model_worse() -> None:
    assert _improvement(range(2), TableNoise(), "literal") < 1.0


def test_with_good_outlines_of_thin_distant_legs_the_default_improves_the_model_fivefold() -> None:
    assert _improvement(range(2), OutlineNoise(0.25, 100), "default") > 5.0


def test_wrong_outlines_are_named_and_hardly_matter() -> None:
    session, nominal = noisy_session(0, OutlineNoise())
    assert session.outlines is not None
    offsets = np.zeros((len(session.outlines), 2))
    offsets[::40] = 15.0
    camera = session.cameras[0].camera
    h, ends = shifted_outlines(camera, session.outlines.h, session.outlines.ends, offsets)
    wrong = replace(session.outlines, h=h, ends=ends)
    axes = axes_from_outlines(wrong, session.measurements, session.machine.radius_of_part())
    result = run_steps(nominal_of(nominal), axes, session.measurements)
    assert len(result.diagnostics) == 9
    assert "Leg leg1 in image 1 was left out of steps 3 and 4" in result.diagnostics[0]
    clean = errors(_run(session, nominal).parameters, session.machine).max()
    assert errors(result.parameters, session.machine).max() < 2.0 * clean + 1e-4
