"""Whether the legs that were found keep their equations where Pinocchio closes the loops."""

import numpy as np

from legcal.errors import ModelError, OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import CONCURRENT, PERPENDICULAR
from legcal.mechanism.closing import leg_vectors, platform_pose, slider_columns
from legcal.mechanism.equations import linearize
from legcal.mechanism.leg import LONGEST, SHORTEST, THICKEST, THINNEST, LegKind
from legcal.mechanism.leg_geometry import Demand, geometry_of
from legcal.mechanism.mobility import CONFIGURATIONS, generic_configurations
from legcal.mechanism.model import Mechanism
from legcal.mechanism.urdf import Urdf

FARTHEST = 1e4  # [m]; beyond, floats do not resolve the tolerances of joints

_FOUND = {
    Demand.BASE_AXIS: "its revolute axis at the base {0:.3g} deg from perpendicular to the leg",
    Demand.PLATFORM_AXIS: "its revolute axis at the platform {0:.3g} deg from perpendicular to it",
    Demand.ALONG_1: "it turned {0:.3g} deg in the platform to which it is fixed",
    Demand.ALONG_2: "it turned {0:.3g} deg in the platform to which it is fixed",
    Demand.TWIST: "it twisted by {0:.3g} deg although it has no S joint",
}


def check_equations(mechanism: Mechanism) -> None:
    """Check the equations of all legs against Pinocchio at home and at poses near it.

    The closed configurations come from the URDF alone, the equations from the geometry that was
    found: both must describe one machine. Origins and axes of a file are rounded, so the same
    tolerances hold as for joints.

    Parameters
    ----------
    mechanism : Mechanism
        The mechanism, with its chain closed at home.

    Raises
    ------
    OutOfClass
        If a length is more than 10 um off, or an axis, a direction or a twist more than 1 mrad.
    """
    problems: dict[str, str] = {}
    for configuration in generic_configurations(mechanism, CONFIGURATIONS):
        T = platform_pose(mechanism, configuration)
        R, t = T.rotation.as_matrix()[None], np.asarray(T.translation)[None]
        for j, leg in enumerate(mechanism.legs):
            equations = linearize(geometry_of(leg), R, t, by_local=False)
            values = equations.values[0].copy()
            if leg.kind is not LegKind.CONSTANT:
                values[0] -= leg.sign * configuration[slider_columns(mechanism, (j,))[0][0]]
            for demand, value in zip(equations.demands, np.abs(values), strict=True):
                problem = _problem(demand, float(value))
                if problem is not None:
                    problems.setdefault(
                        leg.name,
                        f"{mechanism.yaml_path}: leg '{leg.name}' is outside the method: found "
                        f"{problem} at a closed pose; check the origins and axes along the leg.",
                    )
    if problems:
        raise OutOfClass(list(problems.values()))


def check_across(mechanism: Mechanism) -> None:
    """Check that the closures of a planar mechanism hold across its plane too.

    Raises
    ------
    OutOfClass
        If one is more than 10 um open, or turned by more than 1 mrad.
    """
    row, residual = 0, mechanism.chain.residual(mechanism.home_configuration)
    problems = []
    for closure in mechanism.chain.closures:
        gap = float(np.linalg.norm(residual[row : row + 3]))
        tilt = float(np.linalg.norm(residual[row + 3 : row + closure.rows]))
        row += closure.rows
        if gap > CONCURRENT or tilt > PERPENDICULAR:
            problems.append(
                f"{mechanism.yaml_path}: the loops could not be closed: found "
                f"'{closure.frame_1}' and '{closure.frame_2}' {1e3 * gap:.3g} mm and "
                f"{np.degrees(tilt):.3f} deg apart across the plane in which the legs move, needed "
                f"at most 0.01 mm and {np.degrees(PERPENDICULAR):.2g} deg; correct the origins and "
                "axes along this leg."
            )
    if problems:
        raise OutOfClass(problems)


def check_origins(urdf: Urdf) -> None:
    """Check that no joint is so far out that rounding hides how joints lie to each other.

    Raises
    ------
    ModelError
        If an origin is more than 10 km away from the parent link.
    """
    for joint in urdf.joints.values():
        away = float(np.linalg.norm(joint.T_parent_origin.translation))
        if away > FARTHEST:
            raise ModelError(
                f"{urdf.path}: the lengths could not be used: found the origin of joint "
                f"'{joint.name}' {away:.4g} m away from its parent link, needed at most "
                f"{FARTHEST:g} m; write all lengths in metres (are they millimetres?)."
            )


def check_spread(mechanism: Mechanism) -> None:
    """Check that the joints are as near each other as metres put them, before home is looked for.

    Raises
    ------
    ModelError
        If the joints of base or platform lie more than 20 m apart.
    """
    sizes = {
        "the joints on the base": float(np.linalg.norm(np.ptp(mechanism.A_base, axis=0))),
        "the joints on the platform": float(np.linalg.norm(np.ptp(mechanism.B_platform, axis=0))),
    }
    for name, size in sizes.items():
        if size > LONGEST:
            raise ModelError(
                f"{mechanism.urdf_path}: the lengths could not be used: found {name} {size:.4g} m "
                f"apart, needed at most {LONGEST:g} m; write all lengths in metres (are they "
                "millimetres?)."
            )


def check_unit(mechanism: Mechanism) -> None:
    """Check that the legs are as long at home, and move as far, as those written in metres.

    Raises
    ------
    ModelError
        If one is longer than 20 m or shorter than 1 mm, its motor moves further than 20 m, or a
        cylinder along it is thicker than half of it or thinner than 2e-4 of it.
    """
    lengths = np.linalg.norm(leg_vectors(mechanism, mechanism.home), axis=1)
    fixed = np.array([leg.platform_joint == "" for leg in mechanism.legs])
    odd = np.flatnonzero(~fixed & ((lengths < SHORTEST) | (lengths > LONGEST)))
    if len(odd):
        raise ModelError(
            f"{mechanism.urdf_path}: the lengths could not be used: found leg "
            f"'{mechanism.leg_names[odd[0]]}' {lengths[odd[0]]:.4g} m long at home, needed 1 mm to "
            "20 m; write all lengths in metres (are they millimetres?)."
        )
    for leg in mechanism.legs:
        reach = leg.travel[1] - leg.travel[0]
        if leg.kind is LegKind.ACTUATED and reach > LONGEST:
            raise ModelError(
                f"{mechanism.urdf_path}: the travel of leg '{leg.name}' could not be used: found "
                f"{leg.travel[0]:.4g} to {leg.travel[1]:.4g} m, needed at most 20 m; write the "
                "limits of its slider in metres (are they millimetres?)."
            )
    _check_radii(mechanism, np.where(fixed, lengths.max(), lengths))


def _check_radii(mechanism: Mechanism, lengths: Array) -> None:
    """Check that what a camera sees of each leg is no thicker and no thinner than a leg is."""
    for leg, length in zip(mechanism.legs, lengths, strict=True):
        for cylinder in leg.cylinders:
            if not THINNEST < cylinder.radius / length < THICKEST:
                raise ModelError(
                    f"{mechanism.urdf_path}: the <visual> cylinder of link '{cylinder.link}' "
                    f"could not be used: found a radius of {1e3 * cylinder.radius:.4g} mm along "
                    f"leg '{leg.name}', which is {1e3 * length:.4g} mm long at home, needed "
                    f"{THINNEST:g} to {THICKEST:g} of the length; correct radius and its unit."
                )


def _problem(demand: Demand, value: float) -> str | None:
    """Return how an equation is broken, None if it is kept."""
    if demand is Demand.LENGTH:
        if value <= CONCURRENT:
            return None
        return f"its length {1e3 * value:.3g} mm from reading plus offset, needed at most 0.01 mm,"
    if value <= PERPENDICULAR:
        return None
    angle = np.degrees(np.arcsin(min(value, 1.0)))
    return f"{_FOUND[demand].format(angle)}, needed at most {np.degrees(PERPENDICULAR):.2g} deg,"
