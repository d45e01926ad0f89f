"""Values of MJCF elements: numbers, default classes, and the ways to write an orientation."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.mechanism.urdf_checks import Problems, number_list

ORIENTATIONS = {"quat": 4, "axisangle": 4, "xyaxes": 6, "zaxis": 3, "euler": 3}
Attributes = Mapping[str, str]


@dataclass(frozen=True)
class Compiler:
    """The options of ``<compiler>`` that matter for kinematics.

    Attributes
    ----------
    degrees : bool
        Whether angles are in degrees, as they are by default.
    eulerseq : str
        Three letters: small ones turn with the frame, capital ones about fixed axes.
    autolimits : bool
        Whether a range alone limits a joint.
    """

    degrees: bool = True
    eulerseq: str = "xyz"
    autolimits: bool = True

    def radians(self, angle: float) -> float:
        """Return an angle of the file in radians."""
        return float(np.deg2rad(angle)) if self.degrees else angle


def own_attributes(element: etree._Element) -> dict[str, str]:
    """Return the attributes that an element has itself."""
    return {str(key): str(value) for key, value in element.attrib.items()}


class Values:
    """What the elements of one MJCF file say, after defaults, with problems noted.

    Parameters
    ----------
    root : Element
        The ``<mujoco>``.
    problems : Problems
        Where to note what is wrong.
    """

    def __init__(self, root: etree._Element, problems: Problems) -> None:
        self.problems = problems
        self._defaults: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for top in root.iterfind("default"):
            self._read_defaults(top, "main", {})
        self.compiler = self._compiler(root)

    def attributes(self, element: etree._Element, childclass: str) -> dict[str, str]:
        """Return the attributes of an element over those of its default class."""
        own = own_attributes(element)
        name = own.get("class", childclass)
        if name not in self._defaults:
            self.problems.add(
                element, f"names the default class '{name}', which is not in the file",
                "correct the name",
            )  # fmt: skip
            name = "main"
        default = dict(self._defaults[name].get(str(element.tag), {}))
        if not ORIENTATIONS.keys().isdisjoint(own):
            default = {k: v for k, v in default.items() if k not in ORIENTATIONS}
        return {**default, **own}

    def has_class(self, name: str) -> bool:
        """Say whether there is a default class of that name."""
        return name in self._defaults

    def numbers(
        self, element: etree._Element, attributes: Attributes, key: str, counts: tuple[int, ...]
    ) -> Array | None:
        """Return the numbers of an attribute; None where it is missing or wrong."""
        text = attributes.get(key)
        if text is None:
            return None
        found = number_list(text, len(text.split()))
        if found is None or len(found) not in counts:
            wanted = " or ".join(map(str, counts))
            self.problems.add(
                element,
                f"has {key}={text[:60]!r}, needed {wanted} finite number{'s' * (wanted != '1')}",
                "correct the value",
            )
            return None
        return np.array(found)

    def pose(self, element: etree._Element, attributes: Attributes) -> RigidTransform:
        """Return the motion of ``pos`` and an orientation."""
        pos = self.numbers(element, attributes, "pos", (3,))
        return RigidTransform.from_components(
            np.zeros(3) if pos is None else pos, self.orientation(element, attributes)
        )

    def orientation(self, element: etree._Element, attributes: Attributes) -> Rotation:
        """Return the rotation of ``quat``, ``axisangle``, ``xyaxes``, ``zaxis`` or ``euler``."""
        written = [key for key in ORIENTATIONS if key in attributes]
        if len(written) > 1:
            self.problems.add(
                element, f"has {' and '.join(written)}, needed one orientation", "keep one"
            )
        if len(written) != 1:
            return Rotation.identity()
        key = written[0]
        numbers = self.numbers(element, attributes, key, (ORIENTATIONS[key],))
        if numbers is None:
            return Rotation.identity()
        rotation = self._rotation(key, numbers)
        if rotation is None:
            self.problems.add(
                element, f"has {key}={attributes[key]!r}, which gives no orientation",
                "correct the value",
            )  # fmt: skip
            return Rotation.identity()
        return rotation

    def _rotation(self, key: str, numbers: Array) -> Rotation | None:
        """Return the rotation of one way to write it, or None where it means none."""
        if key == "euler":
            angles = np.array([self.compiler.radians(float(angle)) for angle in numbers])
            return euler(self.compiler.eulerseq, angles)
        if key == "quat":
            return None if not numbers.any() else Rotation.from_quat(np.roll(numbers, -1))
        if key == "axisangle":
            if not numbers[:3].any():
                return None
            axis = numbers[:3] / np.linalg.norm(numbers[:3])
            return Rotation.from_rotvec(self.compiler.radians(float(numbers[3])) * axis)
        if key == "zaxis":
            return None if not numbers.any() else z_onto(numbers)
        x, y = numbers[:3], numbers[3:]
        z = np.cross(x, y)
        if not np.linalg.norm(z) > 1e-9 * np.linalg.norm(x) * np.linalg.norm(y):
            return None
        x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
        return Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))

    def _read_defaults(
        self, element: etree._Element, name: str, inherited: dict[str, dict[str, str]]
    ) -> None:
        """Read a default class and those within it."""
        here = {tag: dict(values) for tag, values in inherited.items()}
        for part in element:
            if part.tag != "default":
                values = here.setdefault(str(part.tag), {})
                if not ORIENTATIONS.keys().isdisjoint(own_attributes(part)):
                    for key in ORIENTATIONS:
                        values.pop(key, None)
                values.update(own_attributes(part))
        if name == "main":
            here = {**self._defaults["main"], **here}
            name = element.get("class", "main")
            self._defaults["main"] = here
        self._defaults[name] = here
        for part in element.iterfind("default"):
            inner = part.get("class", "")
            if not inner:
                self.problems.add(part, "is a default class without a name", "name it")
            elif inner in self._defaults:
                self.problems.add(
                    part, f"is the default class '{inner}' again", "give each its own name"
                )
            else:
                self._read_defaults(part, inner, here)

    def _compiler(self, root: etree._Element) -> Compiler:
        """Return the options of all ``<compiler>`` elements; later ones win."""
        found = Compiler()
        for element in root.iterfind("compiler"):
            for key, allowed in (
                ("angle", ("degree", "radian")),
                ("coordinate", ("local",)),
                ("autolimits", ("true", "false")),
            ):
                value = element.get(key)
                if value is not None and value not in allowed:
                    self.problems.add(
                        element, f"has {key}='{value}', needed {' or '.join(allowed)}",
                        "convert the model with MuJoCo first",
                    )  # fmt: skip
            sequence = element.get("eulerseq", found.eulerseq)
            if len(sequence) != 3 or not set(sequence.lower()) <= set("xyz"):
                self.problems.add(
                    element, f"has eulerseq='{sequence}', needed three letters of x, y, z",
                    "correct the value",
                )  # fmt: skip
                sequence = found.eulerseq
            found = Compiler(
                element.get("angle", "degree" if found.degrees else "radian") != "radian",
                sequence,
                element.get("autolimits", str(found.autolimits).lower()) != "false",
            )
        return found


def euler(sequence: str, angles: Array) -> Rotation:
    """Return rotations in turn: about the moved axis for small letters, the fixed for capitals."""
    rotation = Rotation.identity()
    for letter, angle in zip(sequence, angles, strict=True):
        turn = Rotation.from_euler(letter.lower(), float(angle))
        rotation = rotation * turn if letter.islower() else turn * rotation
    return rotation


def z_onto(direction: Array) -> Rotation:
    """Return the shortest rotation that takes z onto a direction."""
    unit = direction / np.linalg.norm(direction)
    axis = np.cross([0.0, 0.0, 1.0], unit)
    sine, cosine = float(np.linalg.norm(axis)), float(unit[2])
    if sine == 0.0:
        return Rotation.from_rotvec([0.0 if cosine > 0.0 else np.pi, 0.0, 0.0])
    return Rotation.from_rotvec(np.arctan2(sine, cosine) * axis / sine)
