"""From bodies to legs: what connects base and platform, joint by joint (section 2).

Nothing here reads names for meaning. A leg is a chain of bodies from base to platform.
"""

from itertools import pairwise

import numpy as np

from legcal.errors import OutOfClass
from legcal.mechanism.axes import CONCURRENT, Axis, Step, nearest
from legcal.mechanism.bodies import Bodies, Connection
from legcal.mechanism.leg_chain import LegChain
from legcal.mechanism.understanding import understand
from legcal.mechanism.urdf import Urdf


def find_chains(bodies: Bodies, urdf: Urdf, base: str, platform: str) -> list[LegChain]:
    """Return the legs between two links, each understood as joint, slider, joint.

    Parameters
    ----------
    bodies : Bodies
        The bodies of the mechanism.
    urdf : Urdf
        The tree, for axes.
    base, platform : str
        Links.

    Raises
    ------
    OutOfClass
        If the mechanism is not a platform on separate legs of this kind.
    """
    ends = bodies.body_of[base], bodies.body_of[platform]
    if ends[0] == ends[1]:
        raise OutOfClass(
            f"{urdf.path}: this is not a parallel mechanism: found the platform '{platform}' fixed "
            f"to the base '{base}', needed legs between them; correct legcal.base or "
            "legcal.platform."
        )
    origin = np.asarray(bodies.T_body_link[platform].translation)
    return [understand(steps, origin, urdf.path) for steps in _paths(bodies, urdf, *ends)]


def _paths(bodies: Bodies, urdf: Urdf, base: str, platform: str) -> list[list[Step]]:
    """Return the joints of every leg from base to platform."""
    _refuse_second_mechanism(bodies, urdf, base, platform)
    at: dict[str, list[Connection]] = {}
    for connection in bodies.connections:
        _refuse_unsupported(connection, urdf, base, platform)
        for body in connection.bodies:
            at.setdefault(body, []).append(connection)
    paths, used = [], set[int]()
    for first in at.get(base, []):
        body, steps, connection = base, list[Step](), first
        while True:
            used.add(id(connection))
            near = connection.bodies.index(body)
            steps.append(_step(connection, near, urdf))
            body = connection.bodies[1 - near]
            if body == platform:
                break
            onward = [c for c in at[body] if c is not connection]
            if body == base or len(onward) != 1 or id(onward[0]) in used:
                raise OutOfClass(_not_a_chain(urdf, steps, body, base, len(onward)))
            connection = onward[0]
        paths.append(steps)
    stray = [c for c in bodies.connections if id(c) not in used]
    if stray:
        raise OutOfClass(
            f"{urdf.path}: this is not a platform on legs: found {_name(stray[0])} on no chain "
            "from base to platform, needed every joint on a leg; fix it or remove it."
        )
    return paths


def _refuse_second_mechanism(bodies: Bodies, urdf: Urdf, base: str, platform: str) -> None:
    """Refuse loops of other bodies than those that hang together with the platform."""
    group = {body: body for body in bodies.body_of.values()}

    def find(body: str) -> str:
        while group[body] != body:
            body = group[body]
        return body

    for connection in bodies.connections:
        if base not in connection.bodies:
            one, two = (find(body) for body in connection.bodies)
            group[two] = one
    others = [
        next(find(body) for body in c.bodies if body != base)
        for c in bodies.connections
        if base in c.bodies and set(c.bodies) != {base}
    ]
    for other in others:
        if other != find(platform) and others.count(other) > 1:
            member = _most_joined(bodies, {body for body in group if find(body) == other})
            raise OutOfClass(
                f"{urdf.path}: the mechanism could not be read: found a second mechanism on the "
                f"base, with link '{member}', that has no moving body in common with the platform "
                f"'{platform}', needed one; write each to its own file."
            )


def _most_joined(bodies: Bodies, members: set[str]) -> str:
    """Return the body of some where most joints meet."""
    ends = [body for c in bodies.connections for body in c.bodies if body in members]
    return max(sorted(members), key=ends.count)


def _step(connection: Connection, near: int, urdf: Urdf) -> Step:
    """Return a connection as passed from one of its bodies."""
    axis = urdf.joints[connection.joint].axis if connection.joint else np.zeros(3)
    return Step(connection, near, 1 - near, axis)


def _refuse_unsupported(connection: Connection, urdf: Urdf, base: str, platform: str) -> None:
    """Refuse joints that are not part of any leg."""
    if connection.joint is not None and urdf.joints[connection.joint].type in (
        "floating",
        "planar",
    ):
        raise OutOfClass(
            f"{urdf.path}: this mechanism is outside the method: found the "
            f"{urdf.joints[connection.joint].type} joint '{connection.joint}' inside it, needed "
            "at most the virtual one that carries the platform; name that one in "
            "legcal.platform_joint."
        )
    if connection.bodies[0] == connection.bodies[1]:
        raise OutOfClass(
            f"{urdf.path}: this mechanism is outside the method: found {_name(connection)} "
            "between two links that are rigidly connected, needed a joint that can move; remove it."
        )
    if set(connection.bodies) == {base, platform}:
        raise OutOfClass(
            f"{urdf.path}: this mechanism is outside the method: found {_name(connection)} "
            "directly between base and platform, needed legs; name it in legcal.platform_joint if "
            "it is the virtual joint that carries the platform."
        )


def _not_a_chain(urdf: Urdf, steps: list[Step], body: str, base: str, n_onward: int) -> str:
    """Return why the leg that starts with some joints is not a chain."""
    needed = "needed one unbranched chain from base to platform for each leg"
    first = steps[0].connection
    if body == base:
        found = "returns to the base"
    elif n_onward == 0:
        found = f"ends at link '{body}' without reaching the platform"
    elif n_onward > 1 and _is_an_arm(steps):
        found = f"carries {n_onward} rods on the moving link '{body}', so that the joints at A move"
        needed = "needed joints whose centres are fixed in the base"
    else:
        found = f"shares link '{body}' with another leg or branches there"
    return (
        f"{urdf.path}: this is not a platform on separate legs: the chain that starts with "
        f"{_name(first)} {found}, {needed}; check closed_loop, legcal.base and legcal.platform."
    )


def _is_an_arm(steps: list[Step]) -> bool:
    """Say whether joints make an arm whose end moves: one revolute, or several apart."""
    if any(step.connection.type != "revolute" for step in steps):
        return False
    if len(steps) == 1:
        return True
    for one, two in pairwise(steps):
        near, far = nearest(Axis(one.name, *one.line(one.far)), Axis(two.name, *two.line(two.near)))
        if near is None or far is None or float(np.linalg.norm(far - near)) > CONCURRENT:
            return True
    return False


def _name(connection: Connection) -> str:
    """Return a joint or closure as a message names it."""
    if connection.joint is not None:
        return f"joint '{connection.joint}'"
    return f"the 3d closure number {(connection.closure or 0) + 1}"
