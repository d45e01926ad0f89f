from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.detection.align import align_camera
from legcal.detection.prediction import PredictedLeg, predict_legs
from legcal.detection.strips import Strips
from legcal.errors import NotVisible
from legcal.geometry.types import Array
from legcal.mechanism.leg import Cylinder
from legcal.vision.camera import Camera

CAMERA = Camera(np.array([[1000.0, 0.0, 320.0], [0.0, 1000.0, 240.0], [0.0, 0.0, 1.0]]), 640, 480)
CYLINDERS = [(Cylinder("rod", 0.008, "base", 0.0, 0.25),)] * 4
ROUGH = RigidTransform.identity()
TRUE = ROUGH * RigidTransform.from_components(
    [0.012, -0.009, 0.008], Rotation.from_rotvec([0.02, 0.02, 0.018])
)


def joints(n_images: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(4)
    A = np.array([[-0.2, 0.12, 1.0], [-0.07, 0.13, 0.9], [0.08, 0.12, 1.1], [0.2, 0.13, 0.95]])
    tops = A + np.array([0.0, -0.25, 0.0]) + rng.uniform(-0.06, 0.06, (n_images, 4, 3))
    return np.repeat(A[None], n_images, axis=0), tops


def predicted(n_images: int, T_base_camera: RigidTransform) -> list[PredictedLeg]:
    A, B = joints(n_images)
    return [
        leg
        for row in range(n_images)
        for leg in predict_legs(CAMERA, T_base_camera, A[row], B[row], CYLINDERS, row)
    ]


def strips(legs: list[PredictedLeg], share_missing: float, n_clutter: int) -> list[Strips]:
    """Return what a search would find: often the leg, and always clutter with better scores."""
    rng = np.random.default_rng(5)
    found = []
    for leg in legs:
        T = TRUE.inv() * ROUGH
        A, B = T.apply(leg.A_camera), T.apply(leg.B_camera)
        ends = np.array([0.0, leg.band.length])
        shift = leg.band.offsets(np.cross(B - A, A), ends) + rng.normal(0.0, 0.7, 2)
        clutter = rng.uniform(-60.0, 60.0, (n_clutter, 1)) + rng.uniform(-10, 10, (n_clutter, 2))
        kept = [] if rng.random() < share_missing else [shift]
        scores = [0.5] * len(kept) + [0.6] * n_clutter
        found.append(Strips(np.array([*kept, *clutter]).reshape(-1, 2), np.array(scores)))
    return found


def apart(T: RigidTransform, legs: list[PredictedLeg]) -> float:
    """Return how far sideways the legs lie from where a pose puts them [px]."""
    gaps = []
    for leg in legs:
        t = np.array([0.0, leg.band.length])
        at = []
        for pose in (T, TRUE):
            A, B = (pose.inv().apply(ROUGH.apply(P)) for P in (leg.A_camera, leg.B_camera))
            at.append(leg.band.offsets(np.cross(B - A, A), t))
        gaps.append(np.abs(at[0] - at[1]).max())
    return float(max(gaps))


@pytest.mark.parametrize(
    ("n_images", "missing", "clutter"), [(1, 0.0, 0), (8, 0.3, 3), (15, 0.5, 4)]
)
def test_all_images_together_find_the_camera_among_clutter(
    n_images: int, missing: float, clutter: int
) -> None:
    legs = predicted(n_images, ROUGH)
    assert apart(ROUGH, legs) > 15.0
    found = strips(legs, missing, clutter)
    T = align_camera("c1", ROUGH, legs, found, np.full(len(legs), 7.0))
    assert apart(T, legs) < (7.0 if n_images == 1 else 2.5)


def test_one_edge_of_each_leg_does_not_pass_for_the_other() -> None:
    legs = predicted(8, ROUGH)
    right = strips(legs, 0.0, 0)
    width = 30.0  # the same edges, taken for those of the other side, lie this far away
    either = [
        Strips(
            np.concatenate([s.shift, s.shift - width]),
            np.array([0.25, 0.27]),
            np.array([0.25, 0.13]),
            np.array([0.13, 0.24]),
        )
        for s in right
    ]
    T = align_camera("c1", ROUGH, legs, either, np.full(len(legs), 7.0))
    assert apart(T, legs) < 2.5


def test_alignment_is_deterministic() -> None:
    legs = predicted(5, ROUGH)
    found = strips(legs, 0.2, 3)
    first, again = (
        align_camera("c1", ROUGH, legs, found, np.full(len(legs), 7.0)).as_matrix() for _ in "ab"
    )
    np.testing.assert_array_equal(first, again)


def test_a_pose_that_sees_no_leg_is_refused_by_name() -> None:
    away = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, np.pi, 0.0]))
    legs = predicted(5, away)
    assert legs == []
    with pytest.raises(NotVisible, match=r"view 'left'.*found 0 legs.*check T_base_camera.*board"):
        align_camera("left", away, legs, [], np.zeros(0))


def test_legs_that_agree_on_no_pose_are_refused() -> None:
    legs = predicted(10, ROUGH)
    rng = np.random.default_rng(6)
    nowhere = [Strips(rng.uniform(-60.0, 60.0, (2, 2)), np.full(2, 0.5)) for _ in legs]
    with pytest.raises(
        NotVisible, match=r"view 'c2'.* of 40 legs .* agree on one camera pose.*board"
    ):
        align_camera("c2", ROUGH, legs, nowhere, np.full(len(legs), 7.0))


def test_images_without_any_candidate_are_refused() -> None:
    legs = predicted(3, ROUGH)
    nothing = [Strips(np.zeros((0, 2)), np.zeros(0)) for _ in legs]
    with pytest.raises(NotVisible, match="0 of 12 legs"):
        align_camera("c1", ROUGH, legs, nothing, np.full(len(legs), 7.0))


def test_a_leg_behind_the_camera_or_seen_end_on_is_not_predicted() -> None:
    A, B = joints(1)
    A[0, 0], B[0, 0] = [0.0, 0.0, 0.5], [0.0, 0.0, 0.8]
    A[0, 1, 2] = B[0, 1, 2] = -1.0
    legs = predict_legs(CAMERA, ROUGH, A[0], B[0], CYLINDERS, 0)
    assert [leg.leg for leg in legs] == [2, 3]
    assert replace(legs[0], row=3).row == 3
