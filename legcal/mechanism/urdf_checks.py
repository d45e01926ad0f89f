"""What a URDF must satisfy before anything is built from it: numbers, names and one tree."""

import math
import re
from collections import Counter
from pathlib import Path

from lxml import etree

from legcal.errors import ModelError

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\Z", re.ASCII)

LARGEST = 1e12  # squares of larger numbers overflow; none of them is a length, an angle or a limit

# element -> attribute -> how many numbers it holds, and whether they must be positive
_NUMERIC: dict[str, dict[str, tuple[int, bool]]] = {
    "origin": {"xyz": (3, False), "rpy": (3, False)},
    "axis": {"xyz": (3, False)},
    "limit": dict.fromkeys(("lower", "upper", "effort", "velocity"), (1, False)),
    "mass": {"value": (1, False)},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), (1, False)),
    "cylinder": {"radius": (1, True), "length": (1, True)},
    "sphere": {"radius": (1, True)},
    "box": {"size": (3, False)},
    "mesh": {"scale": (3, False)},
    "dynamics": {"damping": (1, False), "friction": (1, False)},
}


class Problems:
    """The problems of one URDF, collected to be raised together."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.sentences: list[str] = []

    def __len__(self) -> int:
        return len(self.sentences)

    def add(self, element: etree._Element, found: str, remedy: str) -> None:
        """Note what is wrong with an element of the file and how to mend it."""
        what = f"{element.tag} '{element.get('name')}'" if element.get("name") else element.tag
        self.sentences.append(
            f"{self.path}, line {element.sourceline}: {what} could not be used: it {found}; "
            f"{remedy}{'' if remedy.endswith('?') else '.'}"
        )

    def raise_if_any(self) -> None:
        """Raise all problems as one error."""
        if self.sentences:
            raise ModelError(self.sentences)


def number_list(text: str, count: int) -> list[float] | None:
    """Return ``count`` finite numbers of sensible size, with spaces between them, or None."""
    words = text.split()
    if len(words) != count or not all(_NUMBER.match(word) for word in words):
        return None
    numbers = [float(word) for word in words]
    return numbers if all(math.isfinite(x) and abs(x) < LARGEST for x in numbers) else None


def check_numbers(element: etree._Element, problems: Problems) -> None:
    """Check every number that describes a link or a joint."""
    for part in element.iter(*_NUMERIC):
        for attribute, (count, positive) in _NUMERIC[str(part.tag)].items():
            text = part.get(attribute)
            if text is None:
                if part.tag == "cylinder":
                    problems.add(element, f"has a <cylinder> without {attribute}", "write it [m]")
                continue
            numbers = number_list(text, count)
            if numbers is None:
                needed = "a finite number" if count == 1 else f"{count} finite numbers"
                problems.add(
                    element,
                    f'has <{part.tag} {attribute}="{_short(text)}">, needed {needed}',
                    "correct the value",
                )
            elif positive and min(numbers) <= 0.0:
                problems.add(
                    element,
                    f'has <{part.tag} {attribute}="{_short(text)}">, needed more than zero',
                    "correct the value",
                )


def check_tree(
    links: list[etree._Element], joints: list[etree._Element], problems: Problems
) -> str:
    """Check that links and joints are one tree, and return its root link."""
    for elements in (links, joints):
        _check_names(elements, problems)
    known = {e.get("name", "") for e in links}
    children: dict[str, list[str]] = {}
    parent_joint: dict[str, str] = {}
    for joint in joints:
        ends = {}
        for tag in ("parent", "child"):
            end = joint.find(tag)
            link = None if end is None else end.get("link")
            if link is None:
                problems.add(joint, f"has no <{tag} link=...>", "name the link")
            elif link not in known:
                problems.add(
                    joint, f"names the {tag} link '{link}', which is not in the file",
                    "correct the name",
                )  # fmt: skip
            else:
                ends[tag] = link
        if len(ends) < 2:
            continue
        child = ends["child"]
        if child in parent_joint:
            problems.add(
                joint,
                f"gives the link '{child}' a second parent (the first is by joint "
                f"'{parent_joint[child]}')",
                "a URDF is a tree: give the loop's end a link of its own and close the loop in "
                "closed_loop of the mechanism YAML",
            )
            continue
        parent_joint[child] = joint.get("name", "")
        children.setdefault(ends["parent"], []).append(child)
    return _root(links, parent_joint, children, problems)


def _check_names(elements: list[etree._Element], problems: Problems) -> None:
    """Check that every element has a name of its own."""
    counts = Counter(e.get("name", "") for e in elements)
    seen: set[str] = set()
    for element in elements:
        name = element.get("name", "")
        if not name.strip():
            problems.add(element, "has no name", "name it")
        elif name in seen:
            problems.add(
                element, f"has a name that {counts[name]} of them share", "give each its own name"
            )
        seen.add(name)


def _root(
    links: list[etree._Element],
    parent_joint: dict[str, str],
    children: dict[str, list[str]],
    problems: Problems,
) -> str:
    """Return the one link without a parent, from which all others must hang."""
    roots = [e for e in links if e.get("name", "") not in parent_joint]
    if not links:
        problems.sentences.append(
            f"{problems.path}: the URDF could not be used: found no <link>, needed the links of a "
            "mechanism; expand it with xacro first if it is a xacro file."
        )
        return ""
    if len(roots) > 1:
        names = ", ".join(f"'{e.get('name')}'" for e in roots[:6])
        problems.sentences.append(
            f"{problems.path}: the URDF could not be used: found {len(roots)} links without a "
            f"parent ({names}), needed one; join them with joints, a platform by a floating one."
        )
    root = roots[0].get("name", "") if roots else ""
    reached: set[str] = set()
    pending = [e.get("name", "") for e in roots]
    while pending:
        link = pending.pop()
        if link not in reached:
            reached.add(link)
            pending.extend(children.get(link, ()))
    cyclic = [e.get("name", "") for e in links if e.get("name", "") not in reached]
    if cyclic:
        problems.sentences.append(
            f"{problems.path}: the URDF could not be used: the links "
            f"{', '.join(repr(name) for name in cyclic[:6])} hang from each other in a cycle, "
            "needed a tree; cut the loop and close it in closed_loop of the mechanism YAML."
        )
    return root


def _short(text: str) -> str:
    """Return a value, cut to what a message can show."""
    return text if len(text) <= 60 else f"{text[:57]}..."
