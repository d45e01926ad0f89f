"""What views of known machines identify: the examples that counts get wrong, all shipped models."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from authoring import made
from thinned import thinned

import legcal
from legcal.calibration.identify.identifiability import identifiability
from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.report import Identifiability
from legcal.calibration.identify.session import planned_session
from legcal.machine import Machine

MODELS = sorted(path.stem for path in (Path(__file__).parents[1] / "models").glob("*.yaml"))
WEAK_JOINT = ((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (4, 5))


@cache
def model(name: str) -> Machine:
    return legcal.load_mechanism(name)


def report(name: str, views: Sequence[Sequence[int]], images: int = 15) -> Identifiability:
    machine = model(name)
    return identifiability(
        machine, [[machine.leg_names[j] for j in view] for view in views], images
    )


def rank_of(found: Identifiability, name: str, criteria: str) -> tuple[int, int]:
    return next((s.rank, s.of) for s in found.steps if (s.name, s.criteria) == (name, criteria))


def counts(found: Identifiability) -> list[tuple[int | None, int | None]]:
    return [(c.equations, c.unknowns) for c in found.conditions[:3]]


def test_the_papers_views_of_a_hexapod_determine_all_30_parameters() -> None:
    found = report("hexapod", [(0, 1, 2, 3), (2, 3, 4, 5), (0, 1, 4, 5)])
    assert counts(found) == [(18, 12), (18, 6), (18, 12)]
    assert found.conditions_hold
    assert (found.staged.rank, found.full.rank, found.full.of) == (30, 30, 30)
    assert found.identifiable
    assert not found.remedies
    assert found.platform_sigma is not None
    assert 1e-5 < found.platform_sigma.dX_m < 2e-3


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("3-rpr", [(12, 4), (3, 3), (3, 3)]),
        ("3-upu", [(3, 3), (3, 3), (3, 3)]),
        ("3-rps", [(12, 9), (3, 3), (3, 3)]),
    ],
)
def test_three_legs_count_as_the_paper_prints(name: str, expected: list[tuple[int, int]]) -> None:
    assert counts(report(name, [(0, 1, 2)])) == expected


def test_counts_pass_where_a_joint_hangs_on_one_distance() -> None:
    found = report("hexapod", WEAK_JOINT)
    assert counts(found)[0] == (21, 12)
    assert found.conditions_hold
    assert rank_of(found, "base_joints", "default") == (10, 12)
    assert rank_of(found, "platform_joints", "default") == (10, 12)
    assert found.staged.rank == 26
    assert {p.split(".")[0] for d in found.staged.weak for p in d.parameters} == {"leg6"}
    assert "z of base joint 6" in [d.direction for d in found.staged.weak]
    assert (found.full.rank, found.identifiable) == (30, True)


@pytest.mark.parametrize("views", [((0, 1, 2), (3, 4, 5), (0, 1, 2)), ((0, 1), (2, 3), (4, 5))])
def test_counts_fail_where_everything_at_once_is_determined(
    views: tuple[tuple[int, ...], ...],
) -> None:
    found = report("hexapod", views)
    assert not found.conditions_hold
    assert found.staged.rank < 30
    assert (found.full.rank, found.identifiable) == (30, True)


def test_even_a_leg_that_no_image_shows_is_found_from_its_encoder() -> None:
    found = report("hexapod", [(0, 1, 2, 3), (1, 2, 3, 4), (0, 2, 3, 4)])
    assert [c.ok for c in found.conditions if c.name == "every_leg_seen"] == [False]
    assert (found.staged.rank, found.full.rank) == (23, 30)  # seven of leg 6


def test_printed_criteria_do_not_see_z_of_coplanar_joints() -> None:
    found = report("hexapod", [(0, 1, 2, 3, 4, 5)])
    assert rank_of(found, "base_joints", "literal") == (9, 12)
    assert rank_of(found, "platform_joints", "literal") == (9, 12)
    assert rank_of(found, "base_joints", "default") == (12, 12)


def test_a_symmetric_3_rps_passes_the_count_with_printed_rank_6() -> None:
    found = report("3-rps", [(0, 1, 2)] * 3)
    assert counts(found)[0] == (36, 9)
    assert rank_of(found, "base_joints", "literal") == (6, 9)
    assert rank_of(found, "base_joints", "default") == (9, 9)


def test_a_translating_3_upu_shows_only_differences_of_its_axes() -> None:
    found = report("3-upu", [(0, 1, 2)] * 3)
    assert (found.full.rank, found.full.of) == (15, 21)
    assert all(d.harmless for d in found.full.weak)
    assert {p.split(".")[1] for d in found.full.weak for p in d.parameters} == {
        "base_axis",
        "platform_axis",
    }
    assert found.identifiable
    assert not found.remedies
    assert report("3-upu-tilted", [(0, 1, 2)] * 3).full.rank == 21


def test_legs_on_one_platform_joint_have_no_distance(tmp_path: Path) -> None:
    """An octahedral hexapod: three joints on either side, each of two legs."""
    base = [[300, 0, 0], [-150, 260, 0], [-150, -260, 0]]
    platform = [[100, 173, 0], [-200, 0, 0], [100, -173, 0]]
    machine = made(
        tmp_path,
        type="6-SPS",
        base_joints=[base[k // 2] for k in range(6)],
        platform_joints=[platform[(k + 5) // 2 % 3] for k in range(6)],
        offsets=350,
        home={"xyz": [0, 0, 350], "rpy_deg": [0, 0, 0]},
    )
    found = identifiability(machine, [machine.leg_names] * 2)
    # coplanar joints: the distances do not see the three free heights, nor what separates a pair
    assert rank_of(found, "platform_joints", "literal") == (9, 12)
    assert rank_of(found, "platform_joints", "default") == (12, 12)
    assert (found.staged.rank, found.full.rank, found.full.of) == (30, 30, 30)


def test_an_unseen_strut_is_not_determined_and_harmless() -> None:
    found = report("hexapod-strut", [(0, 1, 2, 3, 4, 5)] * 2)
    assert (found.full.rank, found.full.of) == (30, 36)
    assert all(d.harmless and d.dX_m == pytest.approx(0.0, abs=1e-9) for d in found.full.weak)
    assert found.identifiable


@pytest.mark.parametrize("name", thinned(MODELS, ["hexapod", "3-rpr", "3-upu", "tricept"]))
def test_every_shipped_model_is_identifiable_from_what_is_recommended(name: str) -> None:
    found = identifiability(model(name))
    assert found.recommendation
    assert found.views == found.recommendation[0].views
    assert found.conditions_hold
    assert found.identifiable
    assert found.staged.complete
    harmless = 6 if name == "3-upu" else 0
    assert found.full.rank == found.full.of - harmless
    assert sum(s.of for s in found.steps[2:] if s.criteria == "default") == found.full.of


def test_what_moves_the_platform_is_judged_at_more_poses_than_one_image_shows() -> None:
    machine = model("hexapod")
    found = identifiability(machine, [machine.leg_names], images=1)
    assert not found.identifiable
    assert not any(direction.harmless for direction in found.full.weak)


def test_fewer_camera_positions_have_to_show_more_legs_of_a_hexapod() -> None:
    found = identifiability(model("hexapod"))
    assert found.recommendation is not None
    sizes = [(len(r.views), r.legs_a_view) for r in found.recommendation]
    assert sizes == [(1, 6), (2, 5), (3, 4)]
    assert found.views == found.recommendation[0].views


@pytest.mark.parametrize("name", MODELS)
def test_what_is_determined_and_what_is_not_lie_far_apart(name: str) -> None:
    """The limit of one leg length is no fine line: nothing lies within a factor of two of it."""
    machine = model(name)
    every = tuple(range(machine.n_legs))
    for views in ([every] * 3, [every[:3], every[-3:], every]):
        session = planned_session(machine, views)
        singular = np.linalg.svd(Analysis(session).information, compute_uv=False)
        sigma = 1.0 / np.maximum(singular, 1e-30) / session.mean_length
        assert not np.any((sigma > 0.2) & (sigma < 5.0)), sigma


def test_the_report_does_not_depend_on_the_order_of_views() -> None:
    one = report("hexapod", WEAK_JOINT)
    other = report("hexapod", WEAK_JOINT[::-1])
    assert (one.staged.rank, one.full.rank) == (other.staged.rank, other.full.rank)
    assert [d.direction for d in one.staged.weak] == [d.direction for d in other.staged.weak]


def test_remedies_were_tried_and_are_true() -> None:
    found = report("hexapod", WEAK_JOINT)
    text = [r.remedy for r in found.remedies]
    assert all(r.enough and r.staged_rank == r.full_rank == 30 for r in found.remedies)
    assert "add a fourth camera position (legs 1, 2, 5 and 6)" in text
    wider = [(0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 4), (4, 5)]
    assert "see legs 1, 2, 3, 4, 5 and 6 together in view 1" in text
    assert report("hexapod", wider).staged.rank == 30
    assert report("hexapod", [*WEAK_JOINT, (0, 1, 4, 5)]).staged.rank == 30


def test_one_image_a_view_is_told_to_be_too_few() -> None:
    found = report("hexapod", [(0, 1, 2, 3), (2, 3, 4, 5), (0, 1, 4, 5)], images=1)
    assert found.images == (1, 1, 1)
    assert found.staged.rank < 30
    assert found.remedies[0].remedy == "take 15 images a view instead of 1"


def test_a_direction_hides_what_moving_its_parameters_does_to_the_platform() -> None:
    """The platform error of a weak direction, by forward kinematics of another model."""
    found = report("hexapod", WEAK_JOINT)
    weak = next(d for d in found.staged.weak if d.direction == "z of base joint 6")
    assert weak.parameters == ("leg6.base.z",)
    assert weak.components == pytest.approx((1e-3,))
    session = planned_session(model("hexapod"), WEAK_JOINT)
    moved = []
    for R, t in zip(session.R, session.t, strict=True):
        A = session.A.copy()
        B = np.array([leg.B for leg in session.legs])
        length = np.linalg.norm(B @ R.T + t - A, axis=1)
        A[5, 2] += 1e-3
        x = np.zeros(6)
        for _ in range(5):
            turn = np.eye(3) + _cross(x[3:])
            arm = B @ R.T @ turn.T
            legs = arm + t + x[:3] - A
            norms = np.linalg.norm(legs, axis=1)
            u = legs / norms[:, None]
            x += np.linalg.solve(np.hstack([u, np.cross(arm, u)]), length - norms)
        moved.append(np.linalg.norm(x[:3]))
    assert weak.dX_m == pytest.approx(np.sqrt(np.mean(np.square(moved))), rel=0.05)


def _cross(w: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
