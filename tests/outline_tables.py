"""Outlines of random legs in a small camera, for tests of the tables that hold them."""

from collections.abc import Sequence

import numpy as np

from legcal.data.measurements import Measurements, View
from legcal.data.outlines import MEASURED, Outlines
from legcal.data.reasons import USED, Reason, Rejection
from legcal.machine.leg import Cylinder, JointType, Leg, LegKind
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON, outlines_of_axis

LENS = Camera(
    np.array([[800.0, 0, 320], [0, 810.0, 240], [0, 0, 1]]),
    640,
    480,
    np.array([-0.1, 0.02, 1e-3, -5e-4, 0.0]),
)
LEGS = tuple(
    Leg(
        name=name,
        base_joint=JointType("U"),
        platform_joint=JointType("S"),
        kind=LegKind.ACTUATED,
        prismatic=f"{name}_slider",
        A=np.zeros(3),
        B=np.zeros(3),
        q0=0.3,
        sign=1,
        travel=(0.0, 0.1),
        cylinders=(
            Cylinder(f"{name}_tube", 0.02, "base", 0.0, 0.2),
            Cylinder(f"{name}_rod", 0.01, "platform", -0.3, 0.0),
        ),
    )
    for name in ("legB", "legA", "leg, C")
)
LEG_NAMES = tuple(leg.name for leg in LEGS)


def recorded(
    images: Sequence[str] = ("i/2.png", "i/1.png", "", ""), labels: Sequence[str] = ()
) -> Measurements:
    """Rows in two views, alternating; each its own pose."""
    n = len(images)
    views = (View("right", LENS), View("left", LENS))
    q = np.random.default_rng(n).uniform(0.0, 0.1, (n, len(LEGS)))
    return Measurements(
        views=views,
        image=tuple(images),
        view=np.arange(n, dtype=np.intp) % 2,
        pose=np.arange(n, dtype=np.intp),
        q=q,
        sigma_q=np.full(len(LEGS), 1e-6),
        pose_labels=tuple(labels),
    )


def outlines_of(
    seed: int,
    rows: Sequence[int] = (0, 1, 2, 3),
    *,
    legs: Sequence[int] = (0, 1, 2),
    rejected: float = 0.3,
) -> Outlines:
    """Both edges of the rods of some legs in some rows; some of them rejected, some not found."""
    rng = np.random.default_rng(seed)
    places = [(row, leg, edge) for row in rows for leg in legs for edge in (0, 1)]
    row, leg, edge = (np.array(index, dtype=np.intp) for index in zip(*places, strict=True))
    n = len(rows) * len(legs)
    u = rng.normal(size=(n, 3)) * [1.0, 1.0, 0.3]
    u[:, :2] /= np.linalg.norm(u[:, :2], axis=-1, keepdims=True)  # none towards the camera
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    M = rng.uniform([-0.1, -0.1, 0.8], [0.1, 0.1, 1.0], size=(n, 3))
    h = outlines_of_axis(u, M, 0.01).reshape(-1, 3)
    u, M = np.repeat(u, 2, axis=0), np.repeat(M, 2, axis=0)
    P = M - 0.01 * EPSILON[edge][:, None] * h
    ends = np.stack([LENS.project(P - 0.1 * u), LENS.project(P + 0.1 * u)], axis=1)
    root = rng.normal(size=(len(places), 2, 2))
    covariance = root @ np.swapaxes(root, 1, 2) + 1e-3 * np.eye(2)
    covariance[:, 1, 0] = covariance[:, 0, 1]
    used = rng.uniform(size=len(places)) > rejected
    lost = ~used & (rng.uniform(size=len(places)) < 0.5)
    quality = rng.uniform(0.0, [100.0, 500.0, 1.0], size=(len(places), 3))
    encoding = np.stack([np.full(len(places), 2.2), *rng.normal(size=(2, len(places)))], axis=1)
    for numbers in (h, ends, covariance, quality, encoding):
        numbers[lost] = np.nan
    return Outlines(
        row=row,
        leg=leg,
        part=tuple(LEGS[j].cylinders[1].link for j in leg),
        edge=edge + 1,
        h=h,
        ends=ends,
        covariance=covariance,
        used=used,
        reason=tuple(
            USED if ok else Rejection(Reason.OTHER, 'hidden, by "another" leg') for ok in used
        ),
        source=("detected",) * len(places),
        contrast=quality[:, 0],
        length=quality[:, 1],
        residual=quality[:, 2],
        gamma=encoding[:, 0],
        by_gamma=encoding[:, 1],
        polish=encoding[:, 2],
    )


def assert_same(found: Outlines, expected: Outlines) -> None:
    """Fail unless both tables are the same to the last bit."""
    for name in ("row", "leg", "edge", "h", "ends", "covariance", "used", *MEASURED):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert found.part == expected.part
    assert found.reason == expected.reason
    assert found.source == expected.source
