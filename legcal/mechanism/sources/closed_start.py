"""A configuration that closes the loops of a tree, near the one that its file is drawn in.

It gives home where the file has none: the assembly mode is then that of the drawing. And it gives
the readings about which a travel is assumed where none is written.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError
from legcal.geometry.types import Array
from legcal.mechanism.chain import ClosedChain, Closure
from legcal.mechanism.robot_xml import parse_robot
from legcal.mechanism.sources.source import Source
from legcal.mechanism.sources.travel import (
    assumed_travel,
    set_travel,
    sliders_without_travel,
    travel_note,
)
from legcal.mechanism.urdf import parse_urdf

TRIALS = 24
STEPS = 200
CLOSED = 1e-10  # [m] and [rad]
_SPREAD = 0.1  # [rad] and [m], of the start of a trial, times its number
_LONGEST = 0.3  # step [rad, m]


def completed(source: Source) -> Source:
    """Return a mechanism without a block with the poses where it is closed, and all travels.

    Parameters
    ----------
    source : Source
        A mechanism as its file has it.

    Returns
    -------
    Source
        The same with ``poses`` where a closed configuration was found, and a travel about it
        for sliders that have none.

    Raises
    ------
    ModelError
        If Pinocchio cannot build the tree.
    """
    known = {*source.urdf.links, *source.urdf.joints}
    if not all(name in known for pair in source.file.closed_loop for name in pair):
        return source  # refused later, with the place of the name
    closures = [
        Closure("3d" if kind == "3d" else "6d", one, two)
        for (one, two), kind in zip(source.file.closed_loop, source.file.type, strict=True)
    ]
    try:
        chain = ClosedChain(source.urdf.text, closures)
    except ModelError as error:
        raise ModelError(
            [f"{source.urdf.path}: {problem}" for problem in error.problems]
        ) from error
    start = chain.neutral()
    for joint, value in source.values.items():
        start[chain.q_index(joint)] = value
    found = closed_near(chain, start, source.urdf.links)
    configuration = start if found is None else found
    urdf = source.urdf
    poses = {link: chain.pose(configuration, urdf.root, link) for link in urdf.links}
    sliders = sliders_without_travel(urdf)
    if sliders:
        readings = {name: float(configuration[chain.q_index(name)]) for name in sliders}
        source = _with_travel(source, readings, poses)
    return source if found is None else replace(source, poses=poses)


def closed_near(chain: ClosedChain, start: Array, links: Sequence[str]) -> Array | None:
    """Return a closed configuration near a given one, or None where none was found.

    Of what several starts find, the one is taken where links have turned least.
    """
    if _off(chain, start) <= CLOSED:
        return start
    rng = np.random.default_rng(1965)
    best: tuple[float, Array] | None = None
    drawn = chain.turns(start, links[0], links)
    for trial in range(TRIALS):
        away = chain.integrate(start, _SPREAD * trial * rng.normal(size=chain.nv))
        found = _close(chain, away)
        if found is None:
            continue
        turned = _turned(drawn, chain.turns(found, links[0], links))
        if best is None or turned < best[0] - 1e-6:
            best = turned, found
    return None if best is None else best[1]


def _turned(before: Array, after: Array) -> float:
    """Return by how much rotations (n, 3, 3) differ, all together [rad]."""
    apart = np.swapaxes(before, 1, 2) @ after
    return float(Rotation.from_matrix(apart).magnitude().sum())


def _close(chain: ClosedChain, configuration: Array) -> Array | None:
    """Close the loops by damped Gauss-Newton steps, or return None."""
    damping = 1e-2
    residual, jacobian = chain.linearize(configuration)
    for _ in range(STEPS):
        if float(np.abs(residual).max()) <= CLOSED:
            return configuration
        square = jacobian @ jacobian.T + damping * np.eye(len(residual))
        if not np.linalg.cond(square) < 1e15:  # numbers of hugely different size
            return None
        step = -jacobian.T @ np.linalg.solve(square, residual)
        step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-300))
        tried = chain.integrate(configuration, step)
        new_residual, new_jacobian = chain.linearize(tried)
        if new_residual @ new_residual < residual @ residual:
            configuration, residual, jacobian = tried, new_residual, new_jacobian
            damping = max(0.2 * damping, 1e-12)
        elif damping > 1e6:
            return None
        else:
            damping *= 10.0
    return None


def _off(chain: ClosedChain, configuration: Array) -> float:
    """Return how far the loops are from closed."""
    residual = chain.residual(configuration)
    return float(np.abs(residual).max()) if len(residual) else 0.0


def _with_travel(
    source: Source, readings: Mapping[str, float], poses: Mapping[str, RigidTransform]
) -> Source:
    """Write a travel about some readings into the URDF, and note it."""
    travel = assumed_travel(poses)
    robot = parse_robot(source.urdf.path, source.urdf.content)
    set_travel(robot, readings, travel)
    content = etree.tostring(robot, xml_declaration=True, encoding="utf-8") + b"\n"
    names: Sequence[str] = list(readings)
    return replace(
        source,
        urdf=parse_urdf(source.urdf.path, content),
        converted=True,
        notes=(*source.notes, travel_note(names, travel)),
    )
