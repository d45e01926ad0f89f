"""Where the legs stand at home beside their travel: inside, a little outside, or nowhere near.

A home may lie outside a travel by a little: drawings are, and limits are often set before the
machine is. Up to :data:`FAR` of the travel that is a note. Further out the pose is no pose of this
machine, and everything computed there would be judged where no motor goes.
"""

from legcal.errors import ModelError
from legcal.mechanism.closing import readings_at
from legcal.mechanism.leg import LegKind
from legcal.mechanism.model import Mechanism

NEAR = 0.05  # of the travel: as good as inside
FAR = 1.0  # of the travel: refused beyond, if it is also beyond
_FAR_OF_LEG = 0.01  # of the leg length at home, for sliders that hardly move


def check_home_travel(mechanism: Mechanism) -> None:
    """Check that the home that a file gives is not far outside the travel of its motors.

    Raises
    ------
    ModelError
        If an actuated leg is outside its travel by more than the travel itself and by more than
        1 % of its length.
    """
    far = {}
    q = readings_at(mechanism, mechanism.home)
    for j, excess in legs_outside(mechanism, FAR).items():
        leg = mechanism.legs[j]
        length = leg.sign * float(q[j]) + leg.q0
        if leg.kind is LegKind.ACTUATED and excess > _FAR_OF_LEG * length:
            far[j] = excess
    if not far:
        return
    worst = max(far, key=lambda j: far[j])
    leg = mechanism.legs[worst]
    others = ""
    if len(far) > 1:
        others = f" ({len(far) - 1} more {'leg is' if len(far) == 2 else 'legs are'} as far off)"
    raise ModelError(
        f"{mechanism.yaml_path}: legcal.home could not be used: found leg '{leg.name}' at "
        f"{1e3 * q[worst]:.2f} mm there{others}, needed a reading near its travel of "
        f"{1e3 * leg.travel[0]:.2f} to {1e3 * leg.travel[1]:.2f} mm; correct legcal.home or the "
        "limits of the slider."
    )


def legs_outside(mechanism: Mechanism, share: float = 0.0) -> dict[int, float]:
    """Return which legs are outside their travel at home by more than a share of it, and how far.

    Parameters
    ----------
    mechanism : Mechanism
        The machine with its home.
    share : float
        Of the travel.

    Returns
    -------
    dict of int to float
        Index of the leg, and distance of its reading from the travel [m].
    """
    found = {}
    q = readings_at(mechanism, mechanism.home)
    for j, leg in enumerate(mechanism.legs):
        lower, upper = leg.travel
        excess = max(lower - float(q[j]), float(q[j]) - upper)
        if leg.kind is not LegKind.CONSTANT and excess > share * (upper - lower):
            found[j] = excess
    return found
