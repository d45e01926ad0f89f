"""What a person should know of a mechanism that loads: diagnostics, one sentence each."""

from legcal.mechanism.closing import readings_at
from legcal.mechanism.leg import LegKind
from legcal.mechanism.mobility import idle_spins
from legcal.mechanism.model import Mechanism


def diagnose(mechanism: Mechanism, *, home_is_given: bool) -> tuple[str, ...]:
    """Return what deserves attention in a mechanism, one sentence each."""
    notes = []
    if not home_is_given:
        xyz = ", ".join(f"{x:.6g}" for x in mechanism.home.translation)
        quat = ", ".join(f"{x:.6g}" for x in mechanism.home.rotation.as_quat(canonical=True))
        notes.append(
            "legcal.home is not given: a pose with all legs at mid-travel was taken, xyz "
            f"[{xyz}], quat_xyzw [{quat}]; write it down if the machine is assembled this way."
        )
    q = readings_at(mechanism, mechanism.home)
    for j, leg in enumerate(mechanism.legs):
        lower, upper = leg.travel
        if leg.kind is not LegKind.CONSTANT and not lower <= q[j] <= upper:
            notes.append(
                f"leg '{leg.name}' is at {1e3 * q[j]:.2f} mm at home, outside its travel of "
                f"{1e3 * lower:.2f} to {1e3 * upper:.2f} mm; check legcal.home or the limits."
            )
        if not leg.cylinders:
            notes.append(
                f"leg '{leg.name}' has no <visual> cylinder along its axis: it cannot be seen in "
                "images; add one with its radius."
            )
    n_motors = len(mechanism.motors)
    if mechanism.mobility != n_motors:
        notes.append(
            f"the motors do not determine the pose: mobility {mechanism.mobility}, motors "
            f"{n_motors}; forward kinematics is refused."
        )
    spins = idle_spins(mechanism)
    if spins:
        notes.append(
            f"{spins} legs have an S joint at both ends and spin about themselves; this is not "
            "counted as mobility."
        )
    return tuple(notes)
