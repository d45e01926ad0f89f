"""How many freedoms the platform of the closed mechanism has, idle spins of legs not counted.

The closures leave a null space of joint rates; the mobility is the rank of the twist that it
gives the platform. What is left of the null space moves no platform: legs with an S joint at
both ends spin about themselves. Overconstrained closures (a planar mechanism welded in space)
need no care: dependent rows do not change a null space.
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry import Array, BoolArray
from legcal.machine.equations import leg_scale
from legcal.machine.model import Mechanism

CLOSED = 1e-12  # [m], and [rad] for frames
EXACT = 1e-11  # [m, rad]: where a held platform is
NEAR = 2e-3  # [m, rad]: no other posture of a leg is as near as what axes may be off
RESTARTS = 60
RANK = 1e-10  # of the largest singular value

Equations = Callable[[Array], tuple[Array, Array]]


def leg_vectors(mechanism: Mechanism, T_base_platform: RigidTransform) -> Array:
    """Return the vectors from base to platform joint of every leg, (n_legs, 3), base link [m]."""
    return np.asarray(T_base_platform.apply(mechanism.B_platform)) - mechanism.A_base


def readings_at(mechanism: Mechanism, T_base_platform: RigidTransform) -> Array:
    """Return the joint value of every leg at a pose, q = sign (|AB| - q0), (n_legs,) [m]."""
    lengths = np.linalg.norm(leg_vectors(mechanism, T_base_platform), axis=1)
    return np.asarray(mechanism.sign * (lengths - mechanism.q0))


def close_at(
    mechanism: Mechanism,
    T_base_platform: RigidTransform,
    start: Array | None = None,
    restarts: int = RESTARTS,
) -> Array:
    """Return the configuration that closes every loop with the platform held at a pose.

    Sliders are set from the distance of their joints, so that no leg is ever flipped; the joint
    angles are found by Levenberg-Marquardt from ``start``, and from seeded random angles for
    the legs that do not close from there.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    T_base_platform : RigidTransform
        Pose of the platform link; it must meet what the legs demand.
    start : (nq,) array, optional
        Where the joint angles start; zero without it.
    restarts : int
        How often legs that do not close start from other angles.

    Returns
    -------
    (nq,) array
        Closed to 1e-12 m.

    Raises
    ------
    DidNotConverge
        If a leg does not close, naming its closure and the distance left.
    """
    configuration, residual = _posture(mechanism, T_base_platform, start, EXACT, restarts)
    if np.abs(residual).max(initial=0.0) >= CLOSED:
        held = partial(_equations, mechanism, T_base_platform, 1.0)
        configuration, residual = _levenberg_marquardt(
            mechanism, held, configuration, _angles(mechanism) | _sliders(mechanism)
        )
    _check(mechanism, T_base_platform, configuration, residual, EXACT)
    return configuration


def close_near(
    mechanism: Mechanism,
    T_base_platform: RigidTransform,
    start: Array | None = None,
    restarts: int = RESTARTS,
) -> Array:
    """Return the closed configuration nearest to a pose that meets the demands but for rounding.

    Parameters, exceptions and result are those of :func:`close_at`, but the platform is let go
    at the end: it moves by what the axes of the model are off, or not at all.
    """
    configuration, residual = _posture(mechanism, T_base_platform, start, NEAR, restarts)
    if np.abs(residual).max(initial=0.0) >= CLOSED:
        everything = np.ones(mechanism.chain.nv, dtype=np.bool_)
        configuration, residual = _levenberg_marquardt(
            mechanism, mechanism.chain.linearize, configuration, everything
        )
    _check(mechanism, T_base_platform, configuration, residual, NEAR)
    return configuration


def worst_closure(mechanism: Mechanism, residual: Array) -> str:
    """Return which closure is most open, in words."""
    row = 0
    worst = (0.0, "the platform pose")
    for closure in mechanism.chain.closures:
        gap = float(np.abs(residual[row : row + closure.rows]).max())
        worst = max(worst, (gap, f"'{closure.frame_1}' and '{closure.frame_2}'"))
        row += closure.rows
    return f"{worst[1]} stay {worst[0]:.3g} m apart"


def platform_pose(mechanism: Mechanism, configuration: Array) -> RigidTransform:
    """Return T_base_platform at a configuration."""
    return mechanism.chain.pose(configuration, mechanism.base, mechanism.platform)


def slider_columns(mechanism: Mechanism, legs: tuple[int, ...]) -> tuple[list[int], list[int]]:
    """Return where the sliders of some legs stand in configurations and in tangent vectors."""
    names = [mechanism.legs[j].prismatic for j in legs]
    joints = [name for name in names if name is not None]
    chain = mechanism.chain
    return [chain.q_index(j) for j in joints], [chain.v_index(j) for j in joints]


def _posture(
    mechanism: Mechanism,
    T_base_platform: RigidTransform,
    start: Array | None,
    astray: float,
    restarts: int = RESTARTS,
) -> tuple[Array, Array]:
    """Return joint angles of all legs with the platform held and sliders set, and what is open.

    Gaps of legs shorter than a metre are counted in leg lengths: beside angles in radians they
    would weigh too little to be closed, and :data:`NEAR` would be a large part of a leg.
    """
    configuration = _placed(mechanism, T_base_platform, start, astray)
    free = _angles(mechanism)
    lengths = np.linalg.norm(leg_vectors(mechanism, T_base_platform), axis=1)
    held = partial(_equations, mechanism, T_base_platform, min(1.0, float(lengths.mean())))
    rng = np.random.default_rng(20020701)
    residual = np.zeros(0)
    for _ in range(restarts):
        configuration, residual = _levenberg_marquardt(mechanism, held, configuration, free)
        if np.abs(residual).max(initial=0.0) < NEAR:
            break
        stuck = np.abs(residual) > NEAR
        jacobian = held(configuration)[1]
        columns = free & (np.abs(jacobian[stuck]).max(axis=0) > 1e-9)
        step = np.where(columns, rng.uniform(-np.pi, np.pi, len(columns)), 0.0)
        configuration = mechanism.chain.integrate(configuration, step)
    return configuration, _equations(mechanism, T_base_platform, 1.0, configuration)[0]


def _check(
    mechanism: Mechanism,
    T_base_platform: RigidTransform,
    configuration: Array,
    residual: Array,
    astray: float,
) -> None:
    """Refuse a chain that is not closed, or whose platform is not where it should be."""
    off = _off(mechanism, T_base_platform, configuration)
    if np.abs(residual).max(initial=0.0) >= CLOSED:
        problem = f"{worst_closure(mechanism, residual)}, needed less than 1e-12 m"
    elif max(off) > astray:
        problem = f"the platform went {_away(off)} away, needed a pose that the legs allow"
    else:
        return
    raise _not_closed(mechanism, T_base_platform, problem)


def _off(
    mechanism: Mechanism, T_base_platform: RigidTransform, configuration: Array
) -> tuple[float, float]:
    """Return how far the platform is from where it should be [m], and how far turned [rad]."""
    R, t = mechanism.chain.placement(configuration, mechanism.base, mechanism.platform)
    matrix = T_base_platform.as_matrix()
    chord = float(np.linalg.norm(R - matrix[:3, :3]))  # of small turns as good as of large ones
    turn = 2.0 * float(np.arcsin(min(1.0, chord / np.sqrt(8.0))))
    return float(np.linalg.norm(t - matrix[:3, 3])), turn


def _away(off: tuple[float, float]) -> str:
    """Return a distance and a turn in words, without the one that is rounding beside the other."""
    said = f"{1e3 * off[0]:.3g} mm", f"{np.degrees(off[1]):.3g} deg"
    return " and ".join(text for text, x in zip(said, off, strict=True) if x > 1e-6 * max(off))


def _not_closed(
    mechanism: Mechanism, T_base_platform: RigidTransform, problem: str
) -> DidNotConverge:
    """Return the error of a pose at which the chain does not close."""
    place = "(" + ", ".join(f"{1e3 * x:.1f}" for x in T_base_platform.translation) + ")"
    return DidNotConverge(
        f"{mechanism.yaml_path}: the legs could not be closed with the platform at {place} mm: "
        f"{problem}; check that the legs reach this pose (legcal.home)."
    )


def _placed(
    mechanism: Mechanism, T_base_platform: RigidTransform, start: Array | None, astray: float
) -> Array:
    """Return a configuration with the platform and the sliders set."""
    chain = mechanism.chain
    configuration = chain.neutral() if start is None else start.copy()
    if mechanism.platform_joint is not None:
        configuration = chain.with_platform(
            configuration,
            mechanism.platform_joint,
            mechanism.base,
            mechanism.platform,
            T_base_platform,
        )
        off = _off(mechanism, T_base_platform, configuration)
        if max(off) > astray:
            raise _not_closed(
                mechanism,
                T_base_platform,
                f"the virtual joint '{mechanism.platform_joint}' leaves it {_away(off)} away, "
                "needed a joint that reaches it",
            )
    q = readings_at(mechanism, T_base_platform)
    sliding = tuple(j for j, leg in enumerate(mechanism.legs) if leg.prismatic is not None)
    configuration[slider_columns(mechanism, sliding)[0]] = q[list(sliding)]
    return configuration


def _angles(mechanism: Mechanism) -> BoolArray:
    """Return the tangent coordinates that are joint angles of legs."""
    chain = mechanism.chain
    free = np.zeros(chain.nv, dtype=np.bool_)
    for joint in mechanism.urdf.joints.values():
        if joint.type in ("revolute", "continuous"):
            free[chain.v_index(joint.name)] = True
    return free


def _sliders(mechanism: Mechanism) -> BoolArray:
    """Return the tangent coordinates that are sliders of legs."""
    free = np.zeros(mechanism.chain.nv, dtype=np.bool_)
    every = tuple(range(mechanism.n_legs))
    free[slider_columns(mechanism, every)[1]] = True
    return free


def _equations(
    mechanism: Mechanism, T_base_platform: RigidTransform, metre: float, configuration: Array
) -> tuple[Array, Array]:
    """Return residual and Jacobian of the closures, and of the platform where legs carry it.

    Lengths are divided by ``metre``.
    """
    residual, jacobian = mechanism.chain.linearize(configuration)
    if mechanism.platform_joint is None:
        held, held_jacobian = mechanism.chain.welded(
            mechanism.base, mechanism.platform, T_base_platform
        )
        residual = np.concatenate([residual, held])
        jacobian = np.concatenate([jacobian, held_jacobian])
    weights = np.ones(len(residual))
    row = 0
    for rows in [closure.rows for closure in mechanism.chain.closures] + [6]:
        weights[row : row + 3] = 1.0 / metre
        row += rows
    return residual * weights, jacobian * weights[:, np.newaxis]


def _levenberg_marquardt(
    mechanism: Mechanism, equations: Equations, configuration: Array, free: BoolArray
) -> tuple[Array, Array]:
    """Return where the free coordinates end, and the residual there."""
    residual, jacobian = equations(configuration)
    cost = float(residual @ residual)
    damping = min(1e-3, cost)  # quadratic where the start is near
    for _ in range(60):
        if np.abs(residual).max(initial=0.0) < 0.01 * CLOSED:
            break
        J = jacobian[:, free]
        normal = J.T @ J
        scale = damping * max(float(np.trace(normal)) / max(len(normal), 1), 1e-12)
        step = np.zeros(len(free))
        if damping < 1e-12:
            step[free] = -np.linalg.lstsq(J, residual, rcond=RANK)[0]
        else:
            step[free] = -np.linalg.solve(normal + scale * np.eye(len(normal)), J.T @ residual)
        moved = mechanism.chain.integrate(configuration, step)
        new_residual, new_jacobian = equations(moved)
        new_cost = float(new_residual @ new_residual)
        if new_cost < cost:
            configuration, residual, jacobian, cost = moved, new_residual, new_jacobian, new_cost
            damping /= 10.0
        elif damping > 1e6 or np.abs(residual).max() < CLOSED:
            break
        else:
            damping = max(10.0 * damping, 1e-8)
    return configuration, residual


RANK_TOLERANCE = 1e-7  # of the largest singular value, lengths and angles made comparable
STEP = 0.05  # [rad], and of a leg length
CONFIGURATIONS = 3


def mobility(mechanism: Mechanism) -> int:
    """Return the rank of the platform's twist over the null space of the closures.

    It is taken where the closures have their largest rank, at closed configurations near home
    too, because a symmetric pose may be singular.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.

    Returns
    -------
    int
        The mobility; the motors determine the pose where it equals their number.
    """
    found = [freedoms(mechanism, c) for c in generic_configurations(mechanism, CONFIGURATIONS)]
    return min(found)[1]


def freedoms(mechanism: Mechanism, configuration: Array) -> tuple[int, int]:
    """Return the freedoms of all joints and of the platform alone at a closed configuration."""
    scale = leg_scale(mechanism, mechanism.home)
    null_space = free_motions(mechanism, configuration)
    twist = mechanism.chain.twist(mechanism.base, mechanism.platform) @ null_space
    twist[:3] /= scale
    values = np.linalg.svd(twist, compute_uv=False)
    return null_space.shape[1], int(np.sum(values > RANK_TOLERANCE))


def generic_configurations(mechanism: Mechanism, count: int) -> Iterator[Array]:
    """Yield home, then up to ``count - 1`` closed ones a little way off in seeded directions."""
    chain = mechanism.chain
    yield mechanism.home_configuration
    rng = np.random.default_rng(1965)
    scale = _column_scale(mechanism, leg_scale(mechanism, mechanism.home))
    jacobian = chain.linearize(mechanism.home_configuration)[1] * scale
    inverse = np.linalg.pinv(jacobian, rcond=RANK_TOLERANCE)
    for _ in range(count - 1):
        direction = rng.normal(size=chain.nv)
        direction -= inverse @ (jacobian @ direction)
        size = float(np.abs(direction).max())
        if size < RANK_TOLERANCE:
            return  # nothing moves
        step = STEP * scale * direction / size
        configuration = project(mechanism, chain.integrate(mechanism.home_configuration, step))
        if configuration is not None:
            yield configuration


def project(mechanism: Mechanism, configuration: Array) -> Array | None:
    """Return the closed configuration nearest to one that is almost closed, None if none is.

    Gauss-Newton steps of least norm, lengths counted in leg lengths.
    """
    chain = mechanism.chain
    scale = _column_scale(mechanism, leg_scale(mechanism, mechanism.home))
    worst = np.inf
    for _ in range(15):
        residual, jacobian = chain.linearize(configuration)
        gap = float(np.abs(residual).max(initial=0.0))
        if gap < CLOSED and gap > 0.1 * worst:
            return configuration  # rounding
        if gap > 2.0 * worst:
            return None
        worst = gap
        change = np.linalg.lstsq(jacobian * scale, residual, rcond=RANK_TOLERANCE)[0]
        configuration = chain.integrate(configuration, -scale * change)
    return configuration if worst < CLOSED else None


def free_motions(mechanism: Mechanism, configuration: Array) -> Array:
    """Return the tangent steps that keep all loops closed, orthonormal with lengths in leg lengths.

    Returns
    -------
    (nv, k) array
        A basis; idle spins of legs are among them.
    """
    scale = leg_scale(mechanism, mechanism.home)
    columns = _column_scale(mechanism, scale)
    jacobian = mechanism.chain.linearize(configuration)[1] * columns
    row = 0
    for closure in mechanism.chain.closures:
        jacobian[row : row + 3] /= scale
        row += closure.rows
    _, values, right = np.linalg.svd(jacobian)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0])) if len(values) else 0
    return np.asarray(columns[:, None] * right[rank:].T)


def _column_scale(mechanism: Mechanism, scale: float) -> Array:
    """Return what turns tangent steps without a unit into [m] and [rad]."""
    columns = np.full(mechanism.chain.nv, scale)
    columns[mechanism.chain.rotation_columns()] = 1.0
    return columns
