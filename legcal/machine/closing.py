"""The closed chain at a platform pose: all joint values of all legs.

Sliders follow from the pose; joint angles are solved from the closures of the URDF in Pinocchio.
"""

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.mobility import CLOSED, leg_scale
from legcal.machine.model import Machine, readings_at, slider_columns
from legcal.machine.solver import Equations, Retraction, solve

# Tolerances [rad], and lengths relative to the leg length.
POSE_TOLERANCE = 2.5e-11  # pose error of the platform of a closed chain
AXIS_TOLERANCE = 2e-3  # closure error due to inexact axes; no other posture comes so close
RESTARTS = 60


def close_at(
    machine: Machine,
    T_base_platform: RigidTransform,
    start: Array | None = None,
    restarts: int = RESTARTS,
    *,
    exact: bool = True,
) -> Array:
    """Return the configuration (nq,) that closes every loop with the platform at a pose.

    Sliders, and motors that carry rods, are set from the pose, so that no leg is ever flipped; the
    other joint angles are solved from ``start``, and for legs that do not close from there also
    from seeded random angles. The pose must meet the constraints; unless it is *exact* the platform
    is free in the final solve and absorbs the errors of axes in the model.

    Raises
    ------
    DidNotConverge
        If a leg does not close; the message names its closure and the remaining distance.
    """
    chain, metre = machine.chain, leg_scale(machine, T_base_platform)
    most = POSE_TOLERANCE if exact else AXIS_TOLERANCE
    tolerance = metre * most, most
    angles = np.zeros(chain.nv, dtype=np.bool_)
    for joint in machine.urdf.joints.values():
        if joint.type in ("revolute", "continuous", "prismatic"):
            angles[chain.v_index(joint.name)] = True
    set_first = slider_columns(machine, range(machine.n_legs))[1]
    angles[set_first] = False
    configuration = _placed(machine, T_base_platform, start, tolerance)
    rng = np.random.default_rng(20020701)
    # Gaps in leg lengths: gaps of short legs would weigh too little beside angles.
    for _ in range(restarts):
        equations, retract = closure_equations(machine, T_base_platform, metre, angles)
        solution = solve(
            equations, retract, configuration[None], tolerance=0.01 * CLOSED, damped=True
        )
        configuration = solution.points[0]
        stuck = np.abs(solution.values[0]) > AXIS_TOLERANCE
        if not stuck.any():
            break
        columns = np.zeros(chain.nv, dtype=np.bool_)
        columns[angles] = np.abs(solution.jacobian[0, stuck]).max(axis=0) > 1e-9
        step = np.where(columns, rng.uniform(-np.pi, np.pi, chain.nv), 0.0)
        configuration = chain.integrate(configuration, step)
    everything = closure_equations(machine, T_base_platform, metre, angles)
    left = everything[0](configuration[None])[0][0]
    if np.abs(left).max(initial=0.0) >= CLOSED:
        angles[set_first] = True
        pose = T_base_platform if exact else None
        freedoms = angles if exact else np.ones(chain.nv, dtype=np.bool_)
        equations, retract = closure_equations(machine, pose, metre, freedoms)
        solution = solve(
            equations, retract, configuration[None], tolerance=0.01 * CLOSED, damped=True
        )
        configuration, left = solution.points[0], solution.values[0]
    off = _pose_error(machine, T_base_platform, configuration)
    if np.abs(left).max(initial=0.0) >= CLOSED:
        gap = worst_closure(machine, metre * left)
        problem = f"{gap}, needed less than {metre * CLOSED:.0e} m"
    elif off[0] > tolerance[0] or off[1] > tolerance[1]:
        problem = (
            f"the platform moved {_error_in_words(off)} away, needed a pose that the legs allow"
        )
    else:
        return configuration
    raise _not_closed(machine, T_base_platform, problem)


def worst_closure(machine: Machine, residual: Array) -> str:
    """Return the closure with the largest residual, in words."""
    row = 0
    worst = (0.0, "the platform pose")
    for closure in machine.chain.closures:
        gap = float(np.abs(residual[row : row + closure.rows]).max())
        worst = max(worst, (gap, f"'{closure.frame_1}' and '{closure.frame_2}'"))
        row += closure.rows
    return f"{worst[1]} stay {worst[0]:.3g} m apart"


def _placed(
    machine: Machine,
    T_base_platform: RigidTransform,
    start: Array | None,
    tolerance: tuple[float, float],
) -> Array:
    """Return a configuration with the platform and the sliders set."""
    chain = machine.chain
    configuration = chain.neutral() if start is None else start.copy()
    if machine.platform_joint is not None:
        configuration = chain.with_platform(
            configuration,
            machine.platform_joint,
            machine.base,
            machine.platform,
            T_base_platform,
        )
        off = _pose_error(machine, T_base_platform, configuration)
        if off[0] > tolerance[0] or off[1] > tolerance[1]:
            raise _not_closed(
                machine,
                T_base_platform,
                f"the virtual joint '{machine.platform_joint}' leaves it "
                f"{_error_in_words(off)} away, needed a joint that reaches it",
            )
    q = readings_at(machine, T_base_platform)
    sliding = [j for j, leg in enumerate(machine.legs) if leg.prismatic is not None]
    configuration[slider_columns(machine, sliding)[0]] = q[sliding]
    return configuration


def closure_equations(
    machine: Machine, T: RigidTransform | None, metre: float, free: BoolArray | IntArray
) -> tuple[Equations, Retraction]:
    """Return the closures as functions of free tangent coordinates, the platform fixed at T.

    Lengths are divided by ``metre``.
    """
    chain = machine.chain
    weld = T if machine.platform_joint is None else None
    weights = np.ones(chain.n_rows + 6 * (weld is not None))
    row = 0
    for rows in [closure.rows for closure in chain.closures] + [6]:
        weights[row : row + 3] = 1.0 / metre
        row += rows

    def equations(points: Array) -> tuple[Array, Array]:
        residual, jacobian = chain.linearize(points[0])
        if weld is not None:
            of_weld, by_joints = chain.welded(machine.base, machine.platform, weld)
            residual = np.concatenate([residual, of_weld])
            jacobian = np.concatenate([jacobian, by_joints])
        return (residual * weights)[None], (jacobian[:, free] * weights[:, None])[None]

    def retract(points: Array, step: Array) -> Array:
        full = np.zeros(chain.nv)
        full[free] = step[0]
        return chain.integrate(points[0], full)[None]

    return equations, retract


def _pose_error(
    machine: Machine, T_base_platform: RigidTransform, configuration: Array
) -> tuple[float, float]:
    """Return distance [m] and angle [rad] of the platform from its required pose."""
    R, t = machine.chain.placement(configuration, machine.base, machine.platform)
    matrix = T_base_platform.as_matrix()
    chord = float(np.linalg.norm(R - matrix[:3, :3]))  # accurate for small and large angles
    turn = 2.0 * float(np.arcsin(min(1.0, chord / np.sqrt(8.0))))
    return float(np.linalg.norm(t - matrix[:3, 3])), turn


def _error_in_words(off: tuple[float, float]) -> str:
    """Return a distance and an angle in words, without one that is negligible beside the other."""
    parts = f"{1e3 * off[0]:.3g} mm", f"{np.degrees(off[1]):.3g} deg"
    return " and ".join(text for text, x in zip(parts, off, strict=True) if x > 1e-6 * max(off))


def _not_closed(machine: Machine, T_base_platform: RigidTransform, problem: str) -> DidNotConverge:
    """Return the error of a pose at which the chain does not close."""
    place = "(" + ", ".join(f"{1e3 * x:.1f}" for x in T_base_platform.translation) + ")"
    return DidNotConverge(
        f"the legs could not be closed with the platform at {place} mm: "
        f"{problem}; check that the legs reach this pose ({machine.urdf.wording.home}).",
        file=machine.yaml_path,
    )
