"""Camera poses with what speaks for them, and which of them are to be believed."""

from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.recognition.agreement import Poses

# Of a pose that leaves no doubt, and of one that is believed at all: share of the expected legs,
# lead over the next pose in legs of all images together, and as a part.
CLEAR_SUPPORT, CLEAR_LEAD, CLEAR_PART = 0.35, 1.2, 0.35
ENOUGH_SUPPORT, ENOUGH_LEAD, ENOUGH_PART = 0.2, 0.6, 0.16
FEW_SUPPORT, FEW_LEAD, FEW_PART = 0.12, 0.9, 0.3  # of one that shows few legs and has no rival
HINTED_SUPPORT = 0.6  # share near a rough pose that leaves no doubt
LEAST_SUPPORT = 2.8  # legs in all images together: two of them always fit some pose
HINTED_LEAST = 1.6  # the same near a rough pose


@dataclass(frozen=True, eq=False)
class Placed:
    """Poses of a camera, best first, each far from the better ones or with legs on other bars.

    Attributes
    ----------
    poses : Poses
        T_camera_base.
    support : (n, n_pictures) array
        How many legs agree in each picture, weighted by how well and how much of them.
    expected : (n, n_pictures) array
        How many legs each picture would show.
    score : (n,) array
        The support in all pictures together, less what the shifts of the joints cost: legs.
    leg_error : (n_legs,) array
        Root mean square distance of the legs from their bars at the first pose [m]; infinite for
        legs without any.
    hinted : bool
        Whether the pose was searched for near a rough one only.
    by_outlines : bool or None
        Whether outlines that were measured at the poses speak for the first one; None where bars
        left no doubt.
    """

    poses: Poses
    support: Array
    expected: Array
    score: Array
    leg_error: Array
    hinted: bool = False
    by_outlines: bool | None = None

    @property
    def needed(self) -> float:
        """How many legs must agree in a picture on average for a pose to be believed."""
        n = self.support.shape[1]
        alone = not self.hinted and self._leads(FEW_LEAD, FEW_PART)
        share = FEW_SUPPORT if alone else ENOUGH_SUPPORT
        least = HINTED_LEAST if self.hinted else LEAST_SUPPORT
        return float(max(share * self.expected[0].mean(), least / n))

    @property
    def is_enough(self) -> bool:
        """Whether enough legs agree with the first pose."""
        return len(self.poses) > 0 and float(self.support[0].mean()) >= self.needed

    @property
    def lead(self) -> float:
        """Score of the first pose beyond that of the second one, in legs."""
        if len(self.poses) < 2:
            return float("inf")
        return float(self.score[0] - self.score[1])

    @property
    def leads_clearly(self) -> bool:
        """Whether bars leave no doubt that the first pose is better than the second one."""
        return self._leads(CLEAR_LEAD, CLEAR_PART)

    @property
    def leads(self) -> bool:
        """Whether bars tell the first pose from the second one."""
        return self._leads(ENOUGH_LEAD, ENOUGH_PART)

    @property
    def is_convincing(self) -> bool:
        """Whether the first pose is to be believed."""
        if self.by_outlines is not None:
            return self.by_outlines
        return self.is_enough and (self.hinted or self.leads)

    @property
    def is_clear(self) -> bool:
        """Whether the first pose leaves no doubt, so that no further search is needed."""
        if not self.is_enough or self.by_outlines is False:
            return False
        if self.hinted:
            return self.share >= HINTED_SUPPORT
        return self.share >= CLEAR_SUPPORT and self.leads_clearly

    @property
    def share(self) -> float:
        """Share of the expected legs that agree with the first pose."""
        return float(self.support[0].sum() / self.expected[0].sum()) if len(self.poses) else 0.0

    def _leads(self, legs: float, part: float) -> bool:
        """Say whether the first pose leads by so many legs and such a part of its score."""
        return self.lead >= max(legs, part * float(self.score[0]))

    def pose(self, i: int = 0) -> RigidTransform:
        """Return T_base_camera of a pose."""
        R = Rotation.from_matrix(self.poses.R[i])
        return RigidTransform.from_components(self.poses.t[i], R).inv()
