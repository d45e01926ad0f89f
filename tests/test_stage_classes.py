"""Steps 1 to 3 on every shipped machine, and against the ranks that are foretold."""

from dataclasses import replace

import numpy as np
import pytest
from machine_session import SHIPPED
from staged_machines import Observed, Steps, planned, shipped, three_steps

from legcal.calibration.identify.planning import planned_session
from legcal.calibration.identify.ranks import Analysis
from legcal.errors import NotIdentifiable
from legcal.machine import LegKind, load_mechanism
from legcal.paper.joints_in_base import locate_joints_in_base
from legcal.paper.joints_in_camera import locate_joints_in_cameras
from legcal.paper.nominal import Criteria

FULL_RANK = ("3-rpr", "3-spr", "3-upu-tilted")  # of (9): in a plane, or three joints and no axis
LIKE_HEXAPOD = ("nategh-agheli", "6-sps", "hexapod-strut")
EVEN = ("3-rps", "tricept", "hexapod-rod")


def base_errors(observed: Observed, steps: Steps) -> tuple[float, float]:
    """Return the largest errors of A [m] and of base axes [rad]."""
    revolute = observed.nominal.revolute
    turned = np.cross(steps.base.base_axes[revolute], observed.v_Rb[revolute])
    return float(np.abs(steps.base.A_Rb - observed.A_Rb).max()), float(
        np.abs(turned).max(initial=0.0)
    )


def offset_error(observed: Observed, steps: Steps) -> float:
    """Return the largest error of offsets and constant lengths [m]."""
    q0 = np.array([leg.q0 for leg in observed.true_legs])
    passive = [leg.kind is LegKind.PASSIVE for leg in observed.true_legs]
    assert np.isnan(steps.offsets.q0).tolist() == passive
    return float(np.nanmax(np.abs(steps.offsets.q0 - q0)))


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in LIKE_HEXAPOD else n for n in SHIPPED]
)
def test_exact_outlines_give_joints_axes_cameras_and_offsets_from_3_mm_and_1_degree(
    name: str,
) -> None:
    observed = shipped(name)
    nominal = observed.nominal
    away = np.abs(nominal.parameters.base_joints - observed.A_Rb)
    assert np.all(np.isclose(away, 0.003) | (away == 0.0))
    steps = three_steps(observed)
    A, v = base_errors(observed, steps)
    assert A < 1e-8
    assert v < 1e-7
    assert offset_error(observed, steps) < 1e-8
    for T, true in zip(steps.base.T_Rb_camera, observed.T_camera_Rb, strict=True):
        assert T is not None
        assert np.linalg.norm((T * true).translation) < 1e-8
        assert (T * true).rotation.magnitude() < 1e-7
    assert np.isnan(steps.base.base_axes[~nominal.revolute]).all()
    sides = np.sum(steps.base.base_axes * nominal.base_axes, axis=1)[nominal.revolute]
    assert np.all(sides > 0.9)


@pytest.mark.parametrize("name", [*FULL_RANK, *EVEN])
def test_literal_steps_are_exact_where_their_equations_have_full_rank(name: str) -> None:
    observed = shipped(name)
    steps = three_steps(observed, "literal")
    assert offset_error(observed, steps) < 1e-8
    A, v = base_errors(observed, steps)
    if name in FULL_RANK:
        assert A < 1e-8
        assert v < 1e-7
    else:  # 3 mm in z, or 1 degree in the axes, are not seen at all by even equations
        assert max(A, v) > 1e-7


def test_the_ranks_of_9_tell_for_which_machines_it_is_exact() -> None:
    for name in ("3-rpr", "3-rps"):
        machine = load_mechanism(name)
        views = [tuple(range(machine.n_legs))]
        ranks = Analysis(planned_session(machine, views, 4)).step_ranks
        (rank,) = [r for r in ranks if (r.name, r.criteria) == ("base_joints", "literal")]
        assert (rank.rank == rank.of) == (name in FULL_RANK)


VIEWS = [
    pytest.param(
        "hexapod-rod",
        ((0, 1, 2, 3), (2, 3, 4, 5), (0, 1, 4, 5)),
        marks=pytest.mark.slow,
    ),
    ("hexapod", ((0, 1, 2, 3), (3, 4, 5))),
    ("3-rpr", ((0, 1, 2),)),
    ("3-rpr", ((0, 1), (1, 2), (0, 2))),
    ("3-rpr", ((0, 1), (1, 2))),
    ("3-rps", ((0, 1, 2), (0, 1))),
    ("3-rps", ((0, 1), (1, 2), (0, 2))),
    ("3-rps", ((0, 1), (1, 2))),
    pytest.param("tricept", ((0, 1, 2, 3),), marks=pytest.mark.slow),
    ("tricept", ((0, 1, 2), (1, 2, 3))),
]


@pytest.mark.parametrize(("name", "views"), VIEWS)
def test_steps_find_what_ranks_call_determined_and_refuse_the_rest(
    name: str, views: tuple[tuple[int, ...], ...]
) -> None:
    machine = load_mechanism(name)
    session = planned_session(machine, views, 8)
    ranks = [r for r in Analysis(session).step_ranks if r.criteria == "default"]
    determined = {r.name: r.rank == r.of for r in ranks}
    observed = planned(session, machine.sign)
    assert determined["joints_in_cameras"]
    if determined["base_joints"]:
        steps = three_steps(observed)
        A, v = base_errors(observed, steps)
        assert A < 1e-8
        assert v < 1e-7
        assert determined["offsets"]
        assert offset_error(observed, steps) < 1e-8
    else:
        with pytest.raises(NotIdentifiable, match="could not be tied together"):
            three_steps(observed)


@pytest.mark.parametrize("name", ["3-rps", "3-rpr"])
def test_relabelling_legs_and_views_relabels_the_result(name: str) -> None:
    observed = shipped(name, noise=0.1)
    nominal, axes, m = observed.nominal, observed.axes, observed.measurements
    legs, views = np.array([2, 0, 1]), np.array([1, 2, 0])
    place, place_of_view = np.argsort(legs), np.argsort(views)
    moved = replace(
        observed,
        nominal=replace(
            nominal,
            leg_names=tuple(nominal.leg_names[j] for j in legs),
            legs=tuple(nominal.legs[j] for j in legs),
            sign=nominal.sign[legs],
            frame_legs=tuple(int(place[j]) for j in nominal.frame_legs),
        ),
        axes=replace(axes, leg=place[axes.leg]),
        measurements=replace(
            m,
            views=tuple(m.views[v] for v in views),
            view=place_of_view[m.view],
            q=m.q[:, legs],
        ),
    )
    first, second = three_steps(observed), three_steps(moved)
    assert np.allclose(second.base.A_Rb, first.base.A_Rb[legs], atol=1e-9)
    assert np.allclose(second.base.base_axes, first.base.base_axes[legs], atol=1e-8, equal_nan=True)
    assert np.allclose(second.offsets.q0, first.offsets.q0[legs], atol=1e-8)


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_turning_cameras_where_they_stand_changes_nothing(criteria: Criteria) -> None:
    observed = shipped("3-rps", noise=0.1)
    axes = observed.axes
    turns = np.array([T.rotation.as_matrix() for T in observed.T_camera_Rb])
    R = turns[observed.measurements.view[axes.row]]  # any rotations, one a view
    moved = replace(
        axes,
        u=np.einsum("nij,nj->ni", R, axes.u),
        M=np.einsum("nij,nj->ni", R, axes.M),
        basis=np.einsum("nij,nkj->nki", R, axes.basis),
    )
    found = []
    for seen in (axes, moved):
        joints = locate_joints_in_cameras(
            observed.nominal, seen, observed.measurements, criteria=criteria
        )
        found.append(locate_joints_in_base(observed.nominal, joints, criteria=criteria))
    assert np.allclose(found[0].A_Rb, found[1].A_Rb, atol=1e-7)
    assert np.allclose(found[0].base_axes, found[1].base_axes, atol=1e-6)
