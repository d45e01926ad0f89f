"""Cameras and legs recognised from edge pairs of known geometry: right, or refused, never guessed.

Hypotheses of two pairs, scores and steps of poses, the search of a camera, and the fit of a view.
"""

from dataclasses import replace
from typing import ClassVar

import cv2
import leg_pictures as lp
import numpy as np
import pytest
from rendering import Bar, Light, render
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import inverse_kinematics, load_mechanism, random_configurations
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines, found_outlines
from legcal.geometry.types import Array, Image
from legcal.machine.leg import Cylinder
from legcal.perception import recognition
from legcal.perception.camera_search import (
    PoseCandidates,
    is_mirrored,
    mirrored,
    place_by_edges,
    place_camera,
    place_near,
)
from legcal.perception.candidate_pairs import (
    CandidatePairs,
    EdgeSegments,
    find_candidate_pairs,
    segments_of_reduced,
    still_picture,
)
from legcal.perception.pair_matching import (
    CameraPoses,
    EdgeMaps,
    LegSegments,
    PairMatches,
    Picture,
    Pictures,
    depth_reversed,
    match_pairs,
)
from legcal.perception.placement import Group, Search, group_views
from legcal.perception.view_fit import ViewFit, fit_view, min_evidence, with_common_shift
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis, steps_to_outlines

CAMERA = Camera(np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]), 640, 480)
OWN, TWIN = [0, 1, 2, 3, 4, 5], [1, 0, 3, 2, 5, 4]  # rods in pairs
HARD = {"missing": 0.2, "n_clutter": 8, "noise": 0.4}


def _scene(
    seed: int, n_legs: int = 6, n: int = 3, **difficulty: float
) -> tuple[list[Picture], RigidTransform]:
    """Return pictures of a machine at n poses of its platform, and T_base_camera."""
    rng = np.random.default_rng(seed)
    T, made = lp.camera(rng), lp.machine(n_legs, rng)
    platforms = [lp.platform(rng) for _ in range(n)]
    return lp.pictures(made, T, platforms, rng, **difficulty), T  # type: ignore[arg-type]


def _is_right(placed: PoseCandidates, T: RigidTransform) -> bool:
    away, angle = lp.apart(T, placed.pose())
    return angle < np.deg2rad(5.0) and away < 0.1


MOTION = lp.motion([0.3, -0.2, 0.5], [0.4, 1.0, -0.3])


def test_a_pair_counts_for_the_segment_that_it_suits_best() -> None:
    (picture, *_), T = _scene(0)
    doubled = LegSegments.joined([picture.targets] * 2)
    n = len(picture.targets)
    doubled.ends[n:] += 1.5e-3  # as good a pose, but for these segments
    poses = CameraPoses.one(T, np.zeros((6, 2, 3)))
    every = match_pairs(Pictures.of([replace(picture, targets=doubled)]), poses, 0.025)
    m = PairMatches(every.score[0], every.pair[0], every.visible[0])
    both = (m.score[0, :n] > 0.5) & (m.score[0, n:] > 0.1) & (m.pair[0, :n] == m.pair[0, n:])
    assert both.sum() > 5
    better = np.maximum(m.score[0, :n], m.score[0, n:])[both]
    exclusive = (m.exclusive_score[0, :n] + m.exclusive_score[0, n:])[both]
    assert np.mean(np.abs(exclusive - better) < 1e-6) > 0.7
    assert np.all(exclusive <= better + 1e-6)


def test_a_flat_machine_is_seen_alike_with_near_and_far_exchanged() -> None:
    rng = np.random.default_rng(4)
    X = np.append(rng.uniform(-0.2, 0.2, (16, 2)), np.zeros((16, 1)), axis=1)
    R = Rotation.random(5, rng=rng).as_matrix()
    far = np.array([0.3, -0.2, 200.0])
    poses = CameraPoses.rigid(R, far - R @ X.mean(axis=0), 4)
    other = depth_reversed(poses, X)
    assert np.allclose(np.linalg.det(other.R), 1.0)
    here, there = (X @ p.R.swapaxes(1, 2) + p.t[:, None] for p in (poses, other))
    assert np.abs(here[..., :2] / here[..., 2:] - there[..., :2] / there[..., 2:]).max() < 1e-5
    assert np.abs(here[..., 2] + there[..., 2] - 2.0 * far[2]).max() < 1e-3
    again = depth_reversed(other, X)
    np.testing.assert_allclose(again.R, poses.R, atol=1e-9)
    np.testing.assert_allclose(again.t, poses.t, atol=1e-6)


# The camera of a view.


def test_cameras_are_placed_among_clutter_and_missing_legs() -> None:
    for seed, n_legs in enumerate((3, 6)):
        pictures, T = _scene(seed, n_legs, 4, joint_error=2e-3, **HARD)
        placed = place_camera(pictures, n_legs)
        assert placed.is_convincing
        assert _is_right(placed, T)
        assert np.all(np.diff(placed.score) <= 0.0)
        assert placed.support.shape == placed.expected.shape == (len(placed.poses), 4)
        assert np.isfinite(placed.leg_error).any()


def _of_parallelograms(
    name: str, width: float, rng: np.random.Generator
) -> tuple[list[Picture], RigidTransform, Array, Array]:
    """Return pictures of rods *width* px wide in pairs 6 widths apart, arms or carriages beside.

    And T_base_camera, and A and B of the true rods (n, 6, 3).
    """
    model, n = load_mechanism(name), 4
    poses = random_configurations(model, n, rng).poses
    A = model.A_at(np.array([inverse_kinematics(model, T) for T in poses]))
    B = np.array([T.apply(model.B_platform) for T in poses])
    middle = np.concatenate([A, B]).mean(axis=(0, 1))
    shift = RigidTransform.from_translation(middle - [0.0, 0.0, 0.2])
    camera = shift * lp.camera(rng)
    radius = 0.5 * width * lp.PIXEL * float(np.linalg.norm(camera.translation - middle))
    across = A[:, 1::2] - A[:, ::2]
    across /= np.linalg.norm(across, axis=2, keepdims=True)
    for ends in (A, B):
        between = 0.5 * (ends[:, 1::2] + ends[:, ::2])
        ends[:, ::2], ends[:, 1::2] = (between + s * 6.0 * radius * across for s in (-1.0, 1.0))
    rod, arm = (Cylinder("", r, "base", 0.02, 0.38) for r in (radius, 2.0 * radius))
    true_A, true_B = (x + rng.uniform(-2e-3, 2e-3, (6, 3)) for x in (A, B))
    feet = np.array([a.point - 0.3 * a.axis * (not a.turns) for a in model.actuators])
    found = []
    for k in range(n):
        tips = 0.5 * (A[k, 1::2] + A[k, ::2])
        arms = np.array([lp.edges(lp.pieces(feet[j : j + 1], tips[j : j + 1], [
            replace(arm, end=float(np.linalg.norm(tips[j] - feet[j])))]), camera)[0]
            for j in range(3)])  # fmt: skip
        seen = lp.edges(lp.pieces(true_A[k], true_B[k], [rod]), camera)
        lines = np.concatenate([seen[rng.random(len(seen)) > 0.1], arms, lp.clutter(6, rng)])
        lines = lines + 0.3 * lp.PIXEL * rng.normal(size=lines.shape)
        pairs = find_candidate_pairs(lp.segments(lines))
        found.append(Picture(pairs, lp.pieces(A[k], B[k], [rod]), lp.CORNERS, lp.SIZE))
    return found, camera, true_A, true_B


@pytest.mark.parametrize(("name", "width"), [("delta", 6.0), ("linear-delta", 20.0)])
def test_the_two_rods_of_an_arm_are_not_exchanged(name: str, width: float) -> None:
    """Every rod of the model lies nearer to its own than to its twin in the picture."""
    pictures, T, A, B = _of_parallelograms(name, width, np.random.default_rng(5))
    placed = place_camera(pictures, 6)
    assert placed.is_convincing
    assert _is_right(placed, T)
    nowhere = place_camera(pictures[:0], 6)
    assert len(nowhere.poses) == 0
    assert not is_mirrored(placed, nowhere)
    for k, picture in enumerate(pictures):
        nominal = picture.targets.ends.mean(axis=1)[:6]
        at = [pose.inv().apply(x) for pose, x in ((placed.pose(), nominal), (T, (A[k] + B[k]) / 2))]
        shown, true = (x[:, :2] / x[:, 2:] for x in at)
        own, twin = (np.linalg.norm(shown - true[order], axis=1) for order in (OWN, TWIN))
        assert np.all(own < 0.5 * twin)


def test_where_joints_are_known_well_a_symmetric_machine_is_not_taken_for_its_turned_self() -> None:
    """One picture of a platform that is tilted a little: with usual errors any third turn fits."""
    right = {0.015: 0, 0.005: 0}
    for seed in range(6):
        rng = np.random.default_rng(seed)
        made, T = lp.machine(6), lp.camera(rng)
        tilted = lp.motion([0.03, -0.02, 0.38], [0.08, 0.04, 0.0])
        ends = made.A, made.posed(tilted)
        seen = lp.picture(ends, ends, T, rng, noise=0.3)
        for joint_error in right:
            placed = place_camera([replace(seen, joint_error=joint_error)], 6)
            turn = float((placed.pose().inv() * T).rotation.magnitude())
            right[joint_error] += turn < 0.02
    assert right[0.005] == 6
    assert right[0.015] < 5


def test_views_with_known_relative_poses_are_placed_together() -> None:
    rng = np.random.default_rng(5)
    made, joined = lp.machine(6, rng), []
    for _ in range(4):  # one image each
        T = lp.camera(rng)
        [picture] = lp.pictures(made, T, [lp.platform(rng)], rng, joint_error=2e-3, noise=0.4)
        T_camera_board = T.inv() * MOTION
        R, t = T_camera_board.rotation.as_matrix(), T_camera_board.translation
        joined.append(replace(picture, R=R, t=t))
    placed = place_camera(joined, 6)
    assert placed.is_convincing
    assert _is_right(placed, MOTION)


def test_the_rough_pose_of_a_group_is_that_of_its_frame_whichever_view_has_it() -> None:
    rng = np.random.default_rng(0)
    T_base_camera = [lp.camera(rng) for _ in range(3)]
    joined = [MOTION.inv() * T for T in T_base_camera]
    measurements = Measurements(
        tuple(View(f"c{v}", CAMERA) for v in range(3)), ("a", "b", "c"), np.arange(3),
        np.zeros(3, np.intp), np.zeros((3, 6)), np.full(6, 1e-6),
    )  # fmt: skip
    for v in range(3):
        hints = [T if w == v else None for w, T in enumerate(T_base_camera)]
        (group,) = group_views(measurements, np.arange(3), hints, joined)
        assert group.hint is not None
        np.testing.assert_allclose(group.hint.as_matrix(), MOTION.as_matrix(), atol=1e-12)


def test_poses_are_moved_to_where_edges_run_along_legs_that_show_no_clean_pair() -> None:
    rng = np.random.default_rng(5)
    made, T_base_camera = lp.machine(6, rng), lp.camera(rng)
    focal, size = 1.0 / lp.PIXEL, np.ptp(lp.CORNERS, axis=0) / lp.PIXEL
    K = np.array([[focal, 0.0, 0.5 * size[0]], [0.0, focal, 0.5 * size[1]], [0.0, 0.0, 1.0]])
    camera = Camera(K, int(size[0]), int(size[1]))
    seen, drawn = [], []
    for _ in range(3):
        B = made.posed(lp.platform(rng))
        targets = lp.pieces(made.A, B)
        picture = np.full((camera.height, camera.width), 60.0, dtype=np.float32)
        for edge in lp.edges(targets, T_base_camera).reshape(-1, 2, 2):
            # One side of each edge lies in shadow: bright and dark edges pair at no width.
            first, last = np.rint(camera.distort(edge)).astype(int).tolist()
            cv2.line(picture, first, last, float(rng.uniform(90.0, 160.0)), 2)
        drawn.append(picture + rng.normal(0.0, 3.0, picture.shape).astype(np.float32))
        none = find_candidate_pairs(lp.segments(np.zeros((0, 2, 2))))
        seen.append(Picture(none, targets, lp.CORNERS, lp.SIZE))
    maps = EdgeMaps.of(drawn, [None] * 3, [camera] * 3, [1] * 3)
    T = T_base_camera.inv()
    turns = Rotation.from_rotvec(np.deg2rad(7.0) * np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1.0]]))
    others = Rotation.random(8, rng=rng)
    R = np.concatenate([(turns * T.rotation).as_matrix(), others.as_matrix()])
    middle = np.array([0.0, 0.0, 0.2])
    away = (1.08 * T.apply(middle)) - np.einsum("nij,j->ni", R, middle)
    start = CameraPoses.rigid(R, away, 6)
    assert not place_by_edges(seen, maps, 6, start.choose(slice(0, 0))).is_convincing
    placed = place_by_edges(seen, maps, 6, start)
    off = T_base_camera.inv() * placed.pose()
    assert np.degrees(off.rotation.magnitude()) < 3.0
    assert np.linalg.norm(off.translation) < 0.05
    assert not placed.is_convincing  # pairs have no say: outlines decide
    other = place_by_edges(mirrored(seen), maps.mirrored(np.zeros(3)), 6, start)
    assert other.along_edges < 0.85 * placed.along_edges


def test_a_symmetric_machine_at_a_symmetric_reading_is_ambiguous_and_others_resolve_it() -> None:
    rng = np.random.default_rng(2)
    T, made = lp.camera(rng), lp.machine(3)
    home = lp.pictures(made, T, [lp.platform()] * 3, rng)
    placed = place_camera(home, 3)
    assert placed.is_enough
    assert not placed.is_convincing
    other = placed.pose(1).inv() * placed.pose(0)
    assert other.rotation.magnitude() == pytest.approx(2.0 * np.pi / 3.0, abs=0.05)
    near = place_near(home, T, 3)
    assert near.is_convincing
    assert _is_right(near, T)
    more = lp.pictures(made, T, [lp.platform(rng) for _ in range(3)], rng)
    resolved = place_camera([*home, *more], 3)
    assert resolved.is_convincing
    assert _is_right(resolved, T)


def test_a_rough_pose_is_improved_and_that_of_another_place_is_not_clear() -> None:
    pictures, T = _scene(4, 6, 4, joint_error=2e-3, **HARD)
    off = lp.motion([0.02, -0.02, 0.03], [0.03, -0.02, 0])
    placed = place_near(pictures, T * off, 6)
    assert placed.hinted
    assert placed.is_convincing
    assert _is_right(placed, T)
    assert np.all(placed.leg_error[np.isfinite(placed.leg_error)] < 0.015)  # from its edge pairs
    assert lp.apart(T, placed.pose())[1] < 0.5 * lp.apart(T, T * off)[1]
    other = RigidTransform.from_rotation(Rotation.from_euler("z", 1.9)) * T
    assert not place_near(pictures, other, 6).is_clear
    pictures, T = _scene(11, 3, 1, joint_error=2e-3)  # a single image of three legs
    assert not place_camera(pictures, 3).is_clear
    near = place_near(pictures, T, 3)
    assert near.is_convincing
    assert _is_right(near, T)


def test_pictures_of_other_things_give_no_pose() -> None:
    (empty,), _ = _scene(0, n=1, missing=1.1)
    (clutter,), _ = _scene(0, n=1, missing=1.1, n_clutter=12)
    assert len(place_camera([empty] * 2, 6).poses) == 0
    assert not place_camera([clutter] * 2, 6).is_convincing


class _Made(Search):
    """A search whose pictures are made already."""

    made: ClassVar[list[Picture]] = []

    def picture(
        self, row: int, view: int | None = None, pairs: CandidatePairs | None = None
    ) -> Picture:
        return self.made[row]


def _no_image(row: int) -> Image:
    raise AssertionError(row)


def _search(kind: type[Search], made: lp.MachineSpec, B: Array) -> Search:
    n, n_legs = len(B), made.n_legs
    rows = np.arange(n)
    measurements = Measurements(
        (View("c1", CAMERA),), tuple(f"{row}.png" for row in rows), np.zeros(n, np.intp), rows,
        np.zeros((n, n_legs)), np.full(n_legs, 1e-6),
    )  # fmt: skip
    A = np.broadcast_to(made.A, B.shape)
    wanted = np.ones((1, n_legs), dtype=np.bool_)
    names = ["leg"] * n_legs
    return kind(_no_image, measurements, A, B, [lp.CYLINDERS] * n_legs, wanted, names, lp.SIZE)


def test_a_wrong_rough_pose_gives_way_to_a_better_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    T, made = lp.camera(rng), lp.machine(6)
    spread = [
        lp.motion([*rng.uniform(-0.03, 0.03, 2), 0.38], rng.uniform(-0.1, 0.1, 3)) for _ in range(4)
    ]
    _Made.made[:] = lp.pictures(made, T, spread, rng, n_clutter=6)
    turned = RigidTransform.from_rotation(Rotation.from_euler("z", 120.0, degrees=True)) * T
    search = _search(_Made, made, np.array([made.posed(P) for P in spread]))
    monkeypatch.setattr(  # there are no images to measure outlines in
        recognition, "_decided_by_outlines", lambda search, group, pictures, one: one
    )
    for hint in (T, turned):
        placement = recognition.place_views(search, np.arange(4), [hint])
        placed = placement.T_base_camera[0]
        assert placed is not None
        assert lp.apart(T, placed)[1] < np.deg2rad(2.0)


def test_clicks_that_agree_place_a_view_whose_images_show_too_little(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(1)
    T, made, poses = lp.camera(rng), lp.machine(6), [lp.platform(rng) for _ in range(4)]
    _Made.made[:] = lp.pictures(made, T, poses, rng, missing=1.1)
    search = _search(_Made, made, np.array([made.posed(P) for P in poses]))
    monkeypatch.setattr(
        recognition, "_decided_by_outlines", lambda search, group, pictures, one: one
    )
    monkeypatch.setattr(
        recognition,
        "_by_edges",
        lambda search, group, pictures, known: place_camera([], 6),
    )
    view = search.measurements.views[0]
    for is_placed in (False, True):
        views = (replace(view, is_placed=is_placed),)
        search = replace(search, measurements=replace(search.measurements, views=views))
        placement = recognition.place_views(search, np.arange(4), [T])
        assert (placement.T_base_camera[0] is not None) == is_placed
        assert ("c1" in placement.unplaced) != is_placed
    placed = placement.T_base_camera[0]
    assert placed is not None
    np.testing.assert_allclose(placed.as_matrix(), T.as_matrix(), atol=1e-12)


def test_a_view_that_contradicts_the_others_is_placed_again_by_what_these_show(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Near its rough pose, and its joints are where the others have them: not twice as far off."""
    rng = np.random.default_rng(2)
    nominal, n = lp.machine(6, rng), 3
    shift = 0.01 * lp.SIZE * rng.normal(size=(6, 2, 3))
    true = lp.MachineSpec(nominal.A + shift[:, 0], nominal.B + shift[:, 1])
    T, platforms = lp.camera(rng), [lp.platform(rng) for _ in range(n)]
    seen = lp.pictures(true, T, platforms, rng)
    nothing = lp.pictures(true, T, platforms[:1], rng, missing=1.1)
    B = np.array([nominal.posed(P) for P in [*platforms, platforms[0]]])
    search = _search(Search, nominal, B)
    views = View("c1", CAMERA), View("c2", CAMERA)
    m = replace(search.measurements, views=views, view=np.array([0] * n + [1]))
    pairs = dict(enumerate(picture.pairs for picture in [*seen, *nothing]))
    wanted = np.ones((2, 6), dtype=np.bool_)
    search = replace(search, measurements=m, edge_pairs=pairs, wanted=wanted)
    moved = replace(search, A_base=search.A_base + shift[:, 0], B_base=search.B_base + shift[:, 1])
    patched = {
        "_decided_by_outlines": lambda search, group, pictures, one: one,
        "_by_edges": lambda *_: place_camera([], 6),
        "_is_mirrored": lambda *_: False,
        "_fitted": lambda *_: object(),
        "with_common_shift": lambda *_: (moved, shift, np.array([False])),
    }
    for name, made in patched.items():  # there are no images to measure outlines in
        monkeypatch.setattr(recognition, name, made)
    placement = recognition.place_views(search, np.arange(n + 1), [T, None])
    assert [*placement.unplaced] == ["c2"]
    assert np.abs(placement.shift[0] - shift).max() < 0.3 * np.abs(shift).max()


# The fit of a view to outlines.

N_LEGS, N_IMAGES = 6, 4
SIGMA = 0.1  # of outlines [px]


def _outlines(T: RigidTransform, A: Array, B: Array) -> Outlines:
    """Return both outlines of all tubes."""
    row, leg, edge = (x.ravel() for x in np.indices((N_IMAGES, N_LEGS, 2)))
    n = len(row)
    X = T.inv().apply(np.stack([A[row, leg], B[row, leg]], 1).reshape(-1, 3)).reshape(-1, 2, 3)
    u = X[:, 1] - X[:, 0]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    steps = steps_to_outlines(outlines_of_axis(u, X[:, 0], lp.TUBE), lp.TUBE)
    ends = X[:, :1] + np.array([0.03, 0.2])[:, None] * u[:, None] + steps[np.arange(n), edge, None]
    covariance = np.tile(SIGMA**2 * np.eye(2), (n, 1, 1))
    h, px = np.full((n, 3), np.nan), CAMERA.project(ends)
    return found_outlines(row, leg, ("tube",) * n, edge + 1, h, px, covariance)


def _fitted(
    seed: int, is_used: bool = True
) -> tuple[ViewFit | None, Search, Group, RigidTransform]:
    """Fit a view that starts three degrees off."""
    rng = np.random.default_rng(seed)
    made, T = lp.machine(N_LEGS, rng), lp.camera(rng)
    B = np.array([made.posed(lp.platform(rng)) for _ in range(N_IMAGES)])
    search = _search(Search, made, B)
    (group,) = group_views(search.measurements, np.arange(N_IMAGES), [None], None)
    off = lp.motion([0.02, -0.01, 0.02], [0.0, 0.05, 0.0])
    outlines = _outlines(T, search.A_base, search.B_base)
    outlines = replace(outlines, used=np.full(len(outlines), is_used))
    return fit_view(search, group, T * off, np.zeros((N_LEGS, 2, 3)), outlines), search, group, T


def test_exact_outlines_give_back_the_camera() -> None:
    for seed in range(3):
        fit, _, group, T = _fitted(seed)
        assert fit is not None
        assert max(lp.apart(T, fit.T_base_group)) < 1e-3
        assert not fit.outliers.any()
        assert np.abs(fit.offset).max() < 2e-4
        assert fit.evidence == pytest.approx(2.0 * 2 * N_IMAGES * N_LEGS, rel=0.01)
        assert fit.evidence > min_evidence(group)
        assert fit.is_good
    assert _fitted(0, is_used=False)[0] is None  # no outline is used


def _seen_by_cameras(seed: int, n_right: int, n_other: int) -> tuple[Search, Array, list[ViewFit]]:
    """Return the model, errors of its joints of 1 % of the legs, and the fits of cameras.

    First of those that see these errors, then of others, each with joints three times as far off.
    """
    rng = np.random.default_rng(seed)
    made = lp.machine(N_LEGS, rng)
    B = np.array([made.posed(lp.platform(rng)) for _ in range(N_IMAGES)])
    search = _search(Search, made, B)
    (group,) = group_views(search.measurements, np.arange(N_IMAGES), [None], None)
    wrong, *others = 0.01 * lp.SIZE * rng.normal(size=(1 + n_other, N_LEGS, 2, 3))
    fits = []
    for shown in (*(wrong for _ in range(n_right)), *(3.0 * other for other in others)):
        T, A, B = lp.camera(rng), search.A_base + shown[:, 0], search.B_base + shown[:, 1]
        fit = fit_view(search, group, T, np.zeros((N_LEGS, 2, 3)), _outlines(T, A, B))
        assert fit is not None
        fits.append(fit)
    return search, wrong, fits


def test_views_of_one_machine_share_the_errors_of_its_joints() -> None:
    """Four cameras agree on them, and not better than is stated.

    What others saw, of other joints, is told from them and left out, the farthest first.
    """
    for seed in range(4):
        search, wrong, fits = _seen_by_cameras(seed, 4, 1)
        moved, shift, agree = with_common_shift(search, fits)
        assert agree.tolist() == [True] * 4 + [False]
        before, after = (_own_errors(search, errors) for errors in (wrong, wrong - shift))
        assert np.square(after).sum() < 0.1 * np.square(before).sum()
        whitening = moved.shift_whitening
        assert whitening is not None
        assert np.square(np.einsum("lij,lj->li", whitening, after)).mean() < 1.0
        assert moved.joint_error < 0.6 * search.joint_error
        search, _, fits = _seen_by_cameras(seed, 3, 2)
        assert with_common_shift(search, fits)[2].tolist() == [True] * 3 + [False] * 2


def _own_errors(search: Search, errors: Array) -> Array:
    """Return errors (n_legs, 6) of A and B without the motion of all joints as one body."""
    X = np.stack([search.A_base[0], search.B_base.mean(axis=0)], axis=1).reshape(-1, 3)
    turns = np.cross(np.eye(3)[:, None], X - X.mean(axis=0)).reshape(3, -1).T
    bodily = np.hstack([np.tile(np.eye(3), (len(X), 1)), turns])
    own = errors.ravel() - bodily @ np.linalg.lstsq(bodily, errors.ravel())[0]
    return np.asarray(own.reshape(-1, 6))


# Edges of what stands still


def test_what_stands_still_in_the_pictures_of_a_view_is_no_edge_of_a_leg() -> None:
    F = 500.0
    camera = Camera(np.array([[F, 0.0, 160.2], [0.0, F, 119.1], [0.0, 0.0, 1.0]]), 320, 240)
    still = Bar(np.array([-0.12, 0.14, 0.8]), np.array([-0.05, -0.14, 0.85]), 0.013, 170.0)
    matte = Light(ambient=1.0, diffuse=0.0)

    def moving(x: float) -> list[Bar]:
        ends = np.array([[0.0, -0.15, 0.8], [0.01, 0.13, 0.82]])
        aside = [np.array([x + k, 0.0, 0.0]) for k in (0.0, 0.055, 0.11, 0.165)]
        return [Bar(ends[0] + step, ends[1] + step, 0.008, 150.0) for step in aside]

    moved = [moving(x) for x in (-0.02, -0.008, 0.005, 0.017, 0.03)]
    rendered = [render(camera, [still, *bars], 40.0, matte, 0.6, 1.5, 3) for bars in moved]
    pictures = [np.clip(np.rint(image), 0, 255).astype(np.float32) for image in rendered]
    background = still_picture(pictures, 1)
    assert background is not None

    def offsets(found: EdgeSegments, bar: Bar) -> list[float]:
        """Return how far the nearest edges are from both outlines of a bar [px]."""
        lines = outlines_of_axis((bar.B - bar.A) / np.linalg.norm(bar.B - bar.A), bar.A, bar.radius)
        lines = lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
        away = [np.abs(found.ends @ line[:2] + line[2]).max(axis=1).min() for line in lines]
        return [float(offset * F) for offset in away]

    for picture, bars in zip(pictures, moved, strict=True):
        every, found = (segments_of_reduced(picture, camera, 1, b) for b in (None, background))
        assert max(offsets(every, still)) < 1.5
        for bar in bars:
            assert max(*offsets(every, bar), *offsets(found, bar)) < 1.5
        assert min(offsets(found, still)) > 10.0
    assert still_picture(pictures[:3], 1) is None  # of which legs stand still in most
