"""What recognition makes of the images: where the legs and the cameras are."""

from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, IntArray
from legcal.recognition.radii import OtherRadii


@dataclass(frozen=True, eq=False)
class Recognised:
    """Where the legs and the cameras are.

    Attributes
    ----------
    T_base_camera : list of RigidTransform or None, for each view
        None where a view could not be placed, or has no images.
    shift : (n_views, n_legs, 2, 3) array
        Where each view sees A and B of the legs, against the model, in the base link [m].
    joint_error : (n_views, n_legs) array
        How far the legs may still be from there [m].
    unplaced : dict of str
        Why views could not be placed, by view: one sentence for each.
    radii : OtherRadii
        Radii that the images contradict: the cameras were placed with those that they show.
    """

    T_base_camera: list[RigidTransform | None]
    shift: Array
    joint_error: Array
    unplaced: dict[int, str]
    radii: OtherRadii


def shifted(found: Recognised, view: IntArray, A: Array, B: Array) -> tuple[Array, Array]:
    """Return joint centres (n_rows, n_legs, 3) where the view of each row sees them [m]."""
    return A + found.shift[view][:, :, 0], B + found.shift[view][:, :, 1]
