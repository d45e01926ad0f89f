"""What the model says of the legs of a picture."""

import leg_pictures as lp
import numpy as np

from legcal.machine import Cylinder
from legcal.perception.agreement import targets_of


def test_pieces_lie_on_their_legs_and_make_up_all_that_is_seen_of_them() -> None:
    rng = np.random.default_rng(0)
    made = lp.machine(6, rng)
    A, B = made.A, made.posed(lp.platform(rng))
    targets = lp.pieces(A, B)
    assert len(targets) == 12
    for leg in range(6):
        own = np.flatnonzero(targets.leg == leg)
        assert abs(targets.share[own].sum() - 1.0) < 1e-12
        u = (B[leg] - A[leg]) / np.linalg.norm(B[leg] - A[leg])
        for k in own:
            assert np.linalg.norm(np.cross(targets.ends[k] - A[leg], u)) < 1e-12
            at = A[leg] + targets.place[k][:, None] * (B[leg] - A[leg])
            np.testing.assert_allclose(targets.ends[k], at, atol=1e-12)
            assert 0.0 < targets.place[k, 0] < targets.place[k, 1] < 1.0
        assert set(targets.radius[own]) == {lp.TUBE, lp.ROD}


def test_legs_that_are_not_wanted_or_show_nothing_have_no_pieces() -> None:
    made = lp.machine(3)
    B = made.posed(lp.platform())
    cylinders: list[tuple[Cylinder, ...]] = [lp.CYLINDERS, (), lp.CYLINDERS]
    assert set(targets_of(made.A, B, cylinders, np.arange(3)).leg) == {0, 2}
    assert set(targets_of(made.A, B, cylinders, np.array([2])).leg) == {2}
    assert len(targets_of(made.A, B, cylinders, np.array([1]))) == 0
