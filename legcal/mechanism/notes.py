"""What a person should know of a mechanism that loads: diagnostics, one sentence each."""

from legcal.mechanism.closing import readings_at
from legcal.mechanism.home_travel import legs_outside
from legcal.mechanism.model import Mechanism
from legcal.mechanism.schema import LegcalBlock
from legcal.mechanism.singularity import singularity

REGULAR = 1e-4  # singularity measure: less than that is the rounding of a file


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
    outside = legs_outside(mechanism)
    for j, leg in enumerate(mechanism.legs):
        lower, upper = leg.travel
        if j in outside:
            notes.append(
                f"leg '{leg.name}' is at {1e3 * q[j]:.2f} mm at home, outside its travel of "
                f"{1e3 * lower:.2f} to {1e3 * upper:.2f} mm; check legcal.home or the limits."
            )
    return (*notes, *_unseen_notes(mechanism), *_motor_notes(mechanism), *_spin_notes(mechanism))


def proposal_notes(written: LegcalBlock | None, mechanism: Mechanism) -> tuple[str, ...]:
    """Return what of the block ``legcal`` was proposed because the file does not have it."""
    frame = ", ".join(mechanism.leg_names[j] for j in mechanism.frame_legs)
    if written is None:
        return (
            f"the file has no block legcal: base '{mechanism.base}', platform "
            f"'{mechanism.platform}', legs {', '.join(mechanism.leg_names)} and base_frame "
            f"[{frame}] were taken from its bodies; write them down to choose others.",
        )
    if written.base_frame is None:
        return (
            f"legcal.base_frame is not given: [{frame}] was taken, whose joints span most; write "
            "it down to choose others.",
        )
    return ()


def singular_note(mechanism: Mechanism) -> str | None:
    """Return that the motors do not hold the platform at home, None where they do."""
    if not 0 < mechanism.mobility <= len(mechanism.motors):
        return None
    measure = singularity(mechanism, mechanism.home)
    if measure > REGULAR:
        return None
    return (
        "the mechanism is singular at home: the platform moves there although all motors stand "
        f"(singularity measure {measure:.1g}, needed above {REGULAR:g}); correct legcal.home, or "
        "the joints if they make similar figures on base and platform."
    )


def _unseen_notes(mechanism: Mechanism) -> list[str]:
    """Return which legs show no cylinder."""
    unseen = [leg.name for leg in mechanism.legs if not leg.cylinders]
    if not unseen:
        return []
    if len(unseen) == 1:
        who, add = f"leg '{unseen[0]}' has no <visual> cylinder along its axis: it", "add one"
    else:
        who = f"legs {', '.join(unseen)} have no <visual> cylinder along their axes: they"
        add = "add one to each"
    return [f"{who} cannot be seen in images; {add} with its radius."]


def _motor_notes(mechanism: Mechanism) -> list[str]:
    """Return where forward kinematics has too few motors, or too many, or a singular start."""
    notes = []
    if mechanism.mobility == 0:
        return ["the platform cannot move: mobility 0; check the joints and axes of the legs."]
    if not mechanism.is_determined:
        n_motors = len(mechanism.motors)
        found = "the motors do not determine the pose"
        if n_motors > mechanism.mobility:
            found = "there are more motors than the pose needs"
        notes.append(
            f"{found}: mobility {mechanism.mobility}, motors {n_motors}; forward kinematics is "
            "refused."
        )
    singular = singular_note(mechanism)
    return notes if singular is None else [*notes, singular]


def _spin_notes(mechanism: Mechanism) -> list[str]:
    """Return what spins idly: legs with an S joint at both ends, and revolutes too many."""
    notes = []
    chains = mechanism.leg_chains
    both = sum(leg.base_joint == leg.platform_joint == "S" for leg in mechanism.legs)
    if both:
        legs, spin = "1 leg has", "spins about itself"
        if both > 1:
            legs, spin = f"{both} legs have", "spin about themselves"
        notes.append(f"{legs} an S joint at both ends and {spin}; this is not counted as mobility.")
    others = sum(chain.idle_spins for chain in chains) - both
    if others:
        joints = "1 revolute repeats" if others == 1 else f"{others} revolutes repeat"
        notes.append(
            f"{joints} what an S joint of the leg does, or another revolute; this is not counted "
            "as mobility."
        )
    return notes
