"""The mechanisms in one file: which bodies hang together, without the ground they stand on."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from legcal.errors import OutOfClass
from legcal.mechanism.bodies import frame_link
from legcal.mechanism.urdf import Urdf


def check_one_mechanism(urdf: Urdf, closures: Iterable[Sequence[str]], path: Path) -> None:
    """Check that a file holds one mechanism: loops that share a body other than the ground.

    Raises
    ------
    OutOfClass
        If it holds two, or more.
    """
    groups = moving_groups(urdf, closures)
    closed = [links for links, is_closed in groups if is_closed]
    if len(closed) > 1:
        names = ", ".join(f"'{links[0]}'" for links in closed[:4])
        raise OutOfClass(
            f"{path}: the mechanism could not be read: found {len(closed)} mechanisms, which have "
            f"no moving body in common (with {names}), needed one; write each to its own file."
        )


def moving_groups(urdf: Urdf, closures: Iterable[Sequence[str]]) -> list[tuple[list[str], bool]]:
    """Return the links that joints and closures join, without those of the ground.

    Parameters
    ----------
    urdf : Urdf
        The tree. The ground is its root and what fixed joints hold on it.
    closures : iterable of pairs of str
        Frames that coincide.

    Returns
    -------
    list of (links, closed)
        The links of each group in the order of the file, and whether a closure is among them.
    """
    group = {link: link for link in urdf.links}

    def find(link: str) -> str:
        while group[link] != link:
            group[link] = group[group[link]]
            link = group[link]
        return link

    for joint in urdf.joints.values():
        if not joint.moves:
            group[find(joint.child)] = find(joint.parent)
    ground = find(urdf.root)
    pairs = [(j.parent, j.child) for j in urdf.joints.values() if j.type != "floating" and j.moves]
    ends = [(frame_link(urdf, one), frame_link(urdf, two)) for one, two in closures]
    for one, two in (*pairs, *ends):
        if ground not in (find(one), find(two)):
            group[find(two)] = find(one)
    closed = {find(link) for pair in ends for link in pair} - {ground}
    groups: dict[str, list[str]] = {}
    for link in urdf.links:
        if find(link) != ground:
            groups.setdefault(find(link), []).append(link)
    return [(links, name in closed) for name, links in groups.items()]
