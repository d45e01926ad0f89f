"""The information of images before a fit: what it depends on, and its poses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layouts import Layout, write_machine
from machines import MACHINES, with_round_arms
from uncertainty import compared

import legcal
from legcal.calibration.identify.ranks import Analysis, is_scale_open
from legcal.calibration.identify.session import planned_session
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.descriptions.new_model import create_model
from legcal.estimation.uncertainty import compress, eliminate
from legcal.geometry.motions import motion_of
from legcal.machine.equations import leg_equations as linearize_leg
from legcal.machine.kinematics import forward_kinematics_many
from legcal.machine.leg import EquationKind, Leg, LegKind
from legcal.machine.model import Machine

FAST = settings(deadline=None, max_examples=4)
SEEDS = st.integers(0, 2**32 - 1)


def round_arms(folder: Path) -> Machine:
    """Return a Delta whose arms are cylinders."""
    return create_model(with_round_arms("delta"), folder).machine


def test_arms_tell_of_motors_but_not_of_the_scale(tmp_path: Path) -> None:
    machine, bare = round_arms(tmp_path), legcal.load_mechanism("delta")
    with_arms, without = (Analysis(planned_session(m, [range(6)] * 2, 15)) for m in (machine, bare))
    sigma, other = (a.motion.sigma(a.information) for a in (with_arms, without))
    assert sigma is not None
    assert other is not None
    assert 0.5 * other.dX_m < sigma.dX_m < 0.9 * other.dX_m
    assert is_scale_open(with_arms)
    radii = {f"leg{j}.radius.arm{a}_link": Prior(0.008, 1e-5) for j, a in ((1, 1), (3, 2), (5, 3))}
    assert not is_scale_open(replace(with_arms, choices=Choices(priors=radii)))


@FAST
@given(seed=SEEDS, rank=st.integers(0, 4), rows=st.integers(1, 12))
def test_elimination_keeps_what_is_said_whatever_the_own_unknowns_do(
    seed: int, rank: int, rows: int
) -> None:
    """Against projection on what the own unknowns cannot explain."""
    rng = np.random.default_rng(seed)
    left = np.linalg.qr(rng.normal(size=(3, rows, min(rows, rank))))[0]
    right = np.linalg.qr(rng.normal(size=(3, 4, min(rows, rank))))[0]
    own = left * rng.uniform(0.5, 2.0, left.shape[2]) @ np.swapaxes(right, 1, 2)
    shared = rng.normal(size=(3, rows, 5))
    found = eliminate(np.concatenate([own, shared], axis=2), 4)
    expected = np.zeros((5, 5))
    for N, J in zip(own, shared, strict=True):
        rest = J - N @ np.linalg.pinv(N, rcond=1e-10) @ J
        expected += rest.T @ rest
    for upper in (found, compress(found)):
        np.testing.assert_allclose(upper.T @ upper, expected, atol=1e-9)


def test_legs_that_a_view_is_said_to_show_have_outlines_whatever_hides_them() -> None:
    machine = legcal.load_mechanism("hexapod")
    session = planned_session(machine, [range(6), (1, 4)], 5)
    shown = session.outlines
    for image in range(10):
        legs = set(shown.leg[shown.row == image].tolist())
        assert legs == (set(range(6)) if image < 5 else {1, 4})


def larger(leg: Leg, size: float) -> Leg:
    cylinders = tuple(
        replace(c, radius=size * c.radius, start=size * c.start, end=size * c.end)
        for c in leg.cylinders
    )
    return replace(leg, A=size * leg.A, B=size * leg.B, q0=size * leg.q0, cylinders=cylinders)


def test_what_is_determined_does_not_depend_on_the_size_of_the_machine() -> None:
    """A thousand times as large and as far, before the same cameras: relative figures stay."""
    session, size = planned_session(legcal.load_mechanism("3-rps"), [range(3)] * 3, 3), 1e3
    assert session.home is not None
    other = replace(
        session,
        legs=tuple(larger(leg, size) for leg in session.legs),
        home=motion_of(session.home.rotation.as_matrix(), size * session.home.translation),
        t=size * session.t,
        t_reached=size * session.t_reached,
        cameras=tuple(
            replace(view, T_base_camera=motion_of(T.rotation.as_matrix(), size * T.translation))
            for view, T in zip(session.cameras, session.places, strict=True)
        ),
        sigma_q=size * session.sigma_q,
    )
    found = [Analysis(each) for each in (session, other)]
    singular = [np.linalg.svd(each.information, compute_uv=False) for each in found]
    np.testing.assert_allclose(size * singular[1], singular[0], rtol=1e-3)


@pytest.mark.parametrize(
    "name",
    ["3-RPR", "hexapod with a strut"],
)
def test_planned_poses_close_every_leg_inside_its_travel(
    name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Pinocchio closes the loops of the nominal machine; ours is a micrometre away from it."""
    folder = tmp_path_factory.getbasetemp() / name.replace(" ", "_")
    machine = legcal.load_mechanism(write_machine(folder / "m", MACHINES[name](), Layout()))
    session = planned_session(machine, [range(machine.n_legs)], 8)
    assert len(session.t) == 8
    for j, (leg, nominal) in enumerate(zip(session.legs, machine.legs, strict=True)):
        found = linearize_leg(leg, session.R, session.t)
        for demand, value in zip(found.kinds, found.values.T, strict=True):
            if demand is not EquationKind.LENGTH or leg.kind is LegKind.CONSTANT:
                assert np.abs(value).max() < 1e-8
        if leg.kind is not LegKind.CONSTANT:
            q = nominal.sign * (session.length[:, j] - nominal.q0)
            slack = 0.06 * (nominal.travel[1] - nominal.travel[0]) + 1e-5
            assert nominal.travel[0] - slack < q.min()
            assert q.max() < nominal.travel[1] + slack
    assert np.ptp(session.u, axis=0).max() > 0.02
    if machine.is_determined and "strut" not in name:
        q = machine.sign * (session.length - machine.q0)
        q[:, [leg.kind is LegKind.CONSTANT for leg in machine.legs]] = 0.0
        for T, R, t in zip(
            forward_kinematics_many(machine, q[:3]), session.R[:3], session.t[:3], strict=True
        ):
            T_Rb_Re = machine.T_base_Rb.inv() * T * machine.T_platform_Re
            np.testing.assert_allclose(T_Rb_Re.translation, t, atol=1e-4)
            np.testing.assert_allclose(T_Rb_Re.rotation.as_matrix(), R, atol=1e-4)


@pytest.mark.parametrize("name", ["planar", pytest.param("revolute", marks=pytest.mark.system)])
def test_identify_and_plan_predict_what_calibrate_states(name: str) -> None:
    """At the same poses, cameras and used outlines, with the noise of the result."""
    _, (stated, *predicted) = compared(Path(__file__).parent / "data/recorded" / name)
    np.testing.assert_allclose(predicted, stated, rtol=0.02)
