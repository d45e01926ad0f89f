"""Which parameters are estimated, fixed or known: choices, and how overrides resolve to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import permutations
from typing import Literal

import numpy as np

from legcal.data.measurements import View
from legcal.data.overrides import Action, Override
from legcal.errors import DatasetError, UsageError
from legcal.files.schema import closest
from legcal.geometry.types import Array
from legcal.machine.leg import Leg, LegKind, radius_name
from legcal.machine.model import Machine
from legcal.machine.parameter_id import ParameterId
from legcal.machine.parameters import (
    free_coordinates,
    geometries,
    is_held_by_default,
    parametrization_of,
    vector_of,
)
from legcal.vision.board import FixedBoard, Link, board_name
from legcal.vision.camera import intrinsic_names, intrinsic_unit, intrinsic_values, shared_cameras


@dataclass(frozen=True)
class Prior:
    """What is known of a parameter before the fit: a mean and a standard deviation [its unit]."""

    mean: float
    sigma: float


@dataclass(frozen=True, eq=False)
class KnownIntrinsics:
    """What is known of all intrinsics of a camera, in the order of ``intrinsic_names``."""

    mean: Array  # (n,) [px; distortion without unit]
    covariance: Array  # (n, n) zero for what is exact


@dataclass(frozen=True)
class Choices:
    """Choices of parameters by their full names.

    Without any the fit estimates all kinematic parameters except twists, radii with a prior, and
    intrinsics whose camera file states a covariance, which is their prior; others are fixed. What
    is chosen of an intrinsic takes it out of that covariance, whose others stay as they are.
    """

    fixed: frozenset[str] = frozenset()  # at nominal, or at ``values``
    free: frozenset[str] = frozenset()  # without a prior: radii, and what is fixed by default
    priors: Mapping[str, Prior] = field(default_factory=dict)  # in place of those by default
    values: Mapping[str, float] = field(default_factory=dict)  # [m, rad, px], axes as angles
    notes: tuple[str, ...] = ()  # what gave way to what
    least_shared_px: Mapping[str, float] = field(default_factory=dict)  # by edge_biases.KINDS
    # by the view that stands for a camera, in place of what its file states
    cameras: Mapping[str, KnownIntrinsics] = field(default_factory=dict)

    def holds(self, name: str, *, by_default: bool = False) -> bool:
        """Say whether a parameter is held; ``by_default``: whether it is without a choice."""
        if name in self.fixed:
            return True
        return by_default and name not in self.free and name not in self.priors

    def document(self) -> dict[str, object]:
        """Return what was chosen as JSON has it; nothing where nothing was."""
        found = {
            "fixed": sorted(self.fixed - self.values.keys()),
            "fixed_at": dict(sorted(self.values.items())),
            "free": sorted(self.free),
            "priors": {name: [p.mean, p.sigma] for name, p in sorted(self.priors.items())},
            "cameras": {
                name: [known.mean.tolist(), known.covariance.tolist()]
                for name, known in sorted(self.cameras.items())
            },
            "least_shared_px": dict(sorted(self.least_shared_px.items())),
        }
        return {key: value for key, value in found.items() if value}


NO_CHOICES = Choices()

ParameterKind = Literal["kinematic", "radius", "intrinsic", "board"]
_MEASURED_RATIO = 1.15  # between a measured distance of joints and that of a model that is usable
_RATIO = 10.0  # between a radius or length and its nominal value: more is a mistake of the unit
_FOCAL_RATIO = 2.0
_COEFFICIENT = 1e3  # of distortion; far more than any lens has


@dataclass(frozen=True)
class KnownParameter:
    """A parameter and what values make sense for it."""

    nominal: float  # its value in the model or camera file [unit]
    unit: str  # its unit; "" for coefficients of distortion and for the size of a board
    kind: ParameterKind  # what it belongs to
    least: float  # limits of a stated value [unit]
    most: float  # limits of a stated value [unit]


@dataclass(frozen=True, eq=False)
class KnownParameters:
    """The parameters of a machine and of the cameras that look at it."""

    # the parameters, in the order kinematic ones with twists, radii, intrinsics, the size of the
    # calibration board
    by_name: Mapping[str, KnownParameter]
    # names that look like parameters and are none, and why: the end of a sentence
    others: Mapping[str, str]
    # other names of intrinsics, and the one that counts: views of one camera share them
    synonyms: Mapping[str, str]
    # distances of two joints, by both names with a colon: what a person can measure
    lengths: Mapping[str, KnownParameter] = field(default_factory=dict)

    def parameter(self, name: str) -> KnownParameter:
        """Return a parameter, or a distance of joints, by the name that counts."""
        return self.by_name[name] if name in self.by_name else self.lengths[name]

    @property
    def names(self) -> tuple[str, ...]:
        """All names by which a parameter may be called."""
        return (*self.by_name, *self.synonyms)

    def counted(self, name: str) -> str:
        """Return the name that counts for a name."""
        return self.synonyms.get(name, name)


def board_scale(link: Link) -> str:
    """Return the name of the factor on the dimensions of the calibration board on a link."""
    return f"{board_name(link)}.scale"


def known_parameters(
    machine: Machine,
    views: Sequence[View],
    *,
    axes_given: bool = False,
    boards: Sequence[FixedBoard] = (),
) -> KnownParameters:
    """Return the parameters of a machine and of the cameras of its views."""
    by_name, others = _kinematic(machine), _no_parameters(machine)
    seen: dict[str, KnownParameter] = dict(_radii(machine))
    intrinsics, synonyms = _intrinsics(views)
    seen |= intrinsics
    board = {
        board_scale(fixed.link): KnownParameter(1.0, "", "board", 1.0 / _RATIO, _RATIO)
        for fixed in boards
    }
    lengths = _lengths(machine)
    if axes_given:
        reason = "measured axes, in which cameras and radii are contained already"
        others |= dict.fromkeys((*seen, *synonyms), reason)
        return KnownParameters(by_name | board, others, {}, lengths)
    return KnownParameters(by_name | seen | board, others, synonyms, lengths)


def _lengths(machine: Machine) -> dict[str, KnownParameter]:
    """Return the distances of joints on the base and on the platform, by LEG.SIDE:LEG.SIDE.

    Joints at A that move are where they are at reading 0.
    """
    found: dict[str, KnownParameter] = {}
    for side in ("base", "platform"):
        points = machine.A_base if side == "base" else machine.B_platform
        for (j, one), (k, other) in permutations(enumerate(machine.leg_names), 2):
            nominal = float(np.linalg.norm(points[j] - points[k]))
            limits = nominal / _RATIO, nominal * _RATIO
            name = f"{one}.{side}:{other}.{side}"
            found[name] = KnownParameter(nominal, "m", "kinematic", *limits)
    return found


def joints_of_length(name: str) -> tuple[tuple[str, str], tuple[str, str]] | None:
    """Return leg and side of both joints that a measured length is between, None if it is none."""
    ends = [tuple(end.rpartition(".")[::2]) for end in name.split(":")]
    if len(ends) != 2:
        return None
    (one, side), (other, there) = ends
    return (one, side), (other, there)


def _kinematic(machine: Machine) -> dict[str, KnownParameter]:
    """Return the kinematic parameters with their nominal values."""
    legs, found = geometries(machine), parametrization_of(machine, twists=True)
    values = vector_of(found, legs, legs)
    metres = np.array(found.units) == "m"
    size = float(np.abs(values[metres]).max())
    known = {}
    for name, unit, nominal in zip(found.names, found.units, values.tolist(), strict=True):
        least, most = -np.pi, np.pi
        if unit == "m":
            least, most = nominal - size, nominal + size
        if ParameterId.parse(name).kind == "length":
            least = nominal / _RATIO
        known[name] = KnownParameter(nominal, unit, "kinematic", least, most)
    return known


def _radii(machine: Machine) -> Iterator[tuple[str, KnownParameter]]:
    """Yield the radii of the visible parts of the legs."""
    for leg in machine.legs:
        for part, radius in leg.radius_of_part.items():
            limits = radius / _RATIO, radius * _RATIO
            yield radius_name(leg.name, part), KnownParameter(radius, "m", "radius", *limits)


def _intrinsics(views: Sequence[View]) -> tuple[dict[str, KnownParameter], dict[str, str]]:
    """Return the numbers of cameras, and the other names that they have."""
    cameras = [view.camera for view in views]
    owners = shared_cameras([view.name for view in views], cameras)
    known: dict[str, KnownParameter] = {}
    synonyms: dict[str, str] = {}
    for view, camera, owner in zip(views, cameras, owners, strict=True):
        values = intrinsic_values(camera).tolist()
        for name, nominal in zip(intrinsic_names(camera), values, strict=True):
            if view.name != owner:
                synonyms[f"{view.name}.{name}"] = f"{owner}.{name}"
                continue
            limits = {
                "cx": (-0.5, camera.width - 0.5),
                "cy": (-0.5, camera.height - 0.5),
                "fx": (nominal / _FOCAL_RATIO, nominal * _FOCAL_RATIO),
                "fy": (nominal / _FOCAL_RATIO, nominal * _FOCAL_RATIO),
            }.get(name, (-_COEFFICIENT, _COEFFICIENT))
            unit = intrinsic_unit(name)
            known[f"{owner}.{name}"] = KnownParameter(nominal, unit, "intrinsic", *limits)
    return known, synonyms


def _no_parameters(machine: Machine) -> dict[str, str]:
    """Return the names that look like parameters of a machine and are none, and why."""
    free = free_coordinates(len(machine.legs), machine.frame_legs)
    known = parametrization_of(machine, twists=True).names
    others: dict[str, str] = {}
    for j, leg in enumerate(machine.legs):
        for side, frame in (("base", "R_b"), ("platform", "R_e")):
            for axis, letter in enumerate("xyz"):
                name = f"{leg.name}.{side}.{letter}"
                if name in known:
                    continue
                is_zero = not free[j, axis] and (axis < 2 or machine.spatial)
                others[name] = (
                    f"a coordinate that is zero by the definition of {frame}"
                    if is_zero
                    else "a coordinate on which nothing depends"
                )
        angles = ("base_axis.1", "base_axis.2", "platform_axis.1", "platform_axis.2", "twist")
        names = [f"{leg.name}.{angle}" for angle in angles]
        reason = f"an angle that is no parameter of a leg of type {leg.type} in this machine"
        others |= {name: reason for name in names if name not in known}
        others |= _other_lengths(leg)
    return others


def _other_lengths(leg: Leg) -> dict[str, str]:
    """Return the names of the length and offset that a leg does not have, and why."""
    offset, length = f"{leg.name}.offset", f"{leg.name}.length"
    if leg.kind is LegKind.CONSTANT:
        return {offset: f"a leg of constant length, whose parameter is {length}"}
    if leg.kind is LegKind.ACTUATED:
        return {length: f"a leg with an encoder, whose parameter is {offset}"}
    reason = "a leg without an encoder, whose length is whatever the platform makes it"
    return {offset: reason, length: reason}


_DONE: Mapping[Action, str] = {"prior": "given a prior", "free": "freed", "fixed": "fixed"}


def resolve(overrides: Sequence[Override], known: KnownParameters) -> Choices:
    """Return the choices that overrides come to.

    Raises
    ------
    UsageError, DatasetError
        With one sentence for each name that is no parameter's, value that cannot be meant, and
        pair of overrides that contradict each other.
    """
    in_file, its_problems = _decisions([w for w in overrides if w.in_file], known)
    of_call, problems = _decisions([w for w in overrides if not w.in_file], known)
    if problems:
        raise UsageError([*problems, *its_problems])
    if its_problems:
        raise DatasetError(its_problems)
    decisions = in_file | of_call
    given_way = [name for name in in_file if of_call.get(name, in_file[name]) != in_file[name]]
    note = f"What the dataset says of {', '.join(given_way)} gave way to what this run asks for."
    stated = {name: (d.value, d.sigma) for name, d in decisions.items() if d.value is not None}
    choices = Choices(
        frozenset(name for name, d in decisions.items() if d.action == "fixed"),
        frozenset(name for name, d in decisions.items() if d.action == "free"),
        {name: Prior(value, sigma) for name, (value, sigma) in stated.items() if sigma is not None},
        {name: value for name, (value, sigma) in stated.items() if sigma is None},
        (note,) if given_way else (),
    )
    names = [name for name, p in known.by_name.items() if p.kind == "kinematic"]
    if all(choices.holds(n, by_default=is_held_by_default(n)) for n in names):
        raise UsageError(
            "The mechanism could not be calibrated: found all of its parameters fixed, needed one "
            "at least that is not; fix fewer of them."
        )
    return choices


@dataclass(frozen=True)
class _Decision:
    """What is to be done with one parameter, in its unit."""

    action: Action
    value: float | None = None
    sigma: float | None = None


def _decisions(
    overrides: Sequence[Override], known: KnownParameters
) -> tuple[dict[str, _Decision], list[str]]:
    """Return what overrides of one source mean for each parameter, and what is wrong with them."""
    found: dict[str, list[tuple[Override, _Decision]]] = {}
    problems: list[str] = []
    for override in overrides:
        names = _matches(override, known)
        if not names:
            problems.append(_no_match(override, known))
        for name in names:
            parameter = known.parameter(name)
            problem = _misstated(override, name, parameter)
            if problem:
                problems.append(problem)
            else:
                found.setdefault(name, []).append((override, _decision(override, name, parameter)))
    problems += [
        p for name, several in found.items() if (p := _contradiction(name, several, known))
    ]
    # Of several that agree one that states a value says most.
    strongest = {
        name: next((d for _, d in several if d.value is not None), several[0][1])
        for name, several in found.items()
    }
    return strongest, problems


def _matches(override: Override, known: KnownParameters) -> tuple[str, ...]:
    """Return the parameters that an override is about, by the names that count."""
    if override.name in known.names:
        return (known.counted(override.name),)
    if ":" in override.name:
        return _matching_length(override, known)
    names = [known.counted(name) for name in known.names if fnmatchcase(name, override.name)]
    return tuple(dict.fromkeys(names))


def _matching_length(override: Override, known: KnownParameters) -> tuple[str, ...]:
    """Return the distance of joints that an override is about; that of a rod is its length."""
    if override.action != "prior":
        return ()
    joints = joints_of_length(override.name)
    if joints is not None and joints[0][0] == joints[1][0]:
        name = f"{joints[0][0]}.length"
        sides = {side for _, side in joints}
        return (name,) if name in known.by_name and sides == {"base", "platform"} else ()
    one, _, other = override.name.partition(":")
    pair = min(override.name, f"{other}:{one}")
    return (pair,) if pair in known.lengths else ()


def _no_match(override: Override, known: KnownParameters) -> str:
    """Return the sentence about a name that is no parameter's."""
    if ":" in override.name:
        return (
            f"{override.where} could not be used: found no two joints whose distance is that, "
            "needed LEG.base:LEG.base or LEG.platform:LEG.platform of different legs, or both ends "
            f"of a rod, with a value and its sigma; {closest(override.name, known.lengths)}"
        )
    others = [
        name for name in known.others if name == override.name or fnmatchcase(name, override.name)
    ]
    if others:
        return (
            f"{override.where} could not be used: found {others[0]}, {known.others[others[0]]}, "
            "needed a parameter; leave it out."
        )
    is_pattern = not set(override.name).isdisjoint("*?[")
    found = "a pattern that no name matches" if is_pattern else "an unknown name"
    return (
        f"{override.where} could not be used: found {found}, needed a parameter of this machine or "
        f"of its cameras; {closest(override.name, known.names)}"
    )


def _misstated(override: Override, name: str, parameter: KnownParameter) -> str:
    """Return what is wrong with the value that an override states for a parameter, if anything."""
    stated = override.stated
    if stated is None:
        return ""
    if stated.dimension not in ("", parameter.unit):
        needed = f"a number in {parameter.unit}" if parameter.unit else "a number without unit"
        return (
            f"{override.where} could not be used: found a number in {stated.dimension} for {name}, "
            f"needed {needed}; correct the unit."
        )
    if parameter.least <= stated.value <= parameter.most:
        lengths = sorted((stated.value, parameter.nominal))
        if ":" not in override.name or lengths[1] <= _MEASURED_RATIO * lengths[0]:
            return ""
        return (
            f"{override.where} could not be used: found {_with_unit(stated.value, parameter)} "
            f"between joints that the model has {_with_unit(parameter.nominal, parameter)} apart, "
            f"needed a distance within {100.0 * (_MEASURED_RATIO - 1.0):.0f} % of that; check the "
            "number, its unit and between which joints it was measured, or correct the model."
        )
    return (
        f"{override.where} could not be used: found {_with_unit(stated.value, parameter)} for "
        f"{name}, needed one between {parameter.least:.4g} and {parameter.most:.4g}, not so far "
        f"from the nominal {_with_unit(parameter.nominal, parameter)}; check the number and its "
        "unit."
    )


def _decision(override: Override, name: str, parameter: KnownParameter) -> _Decision:
    """Return what an override comes to for one parameter."""
    if override.stated is None:
        return _Decision(override.action)
    value = override.stated.value
    if ParameterId.parse(name).kind == "twist":  # an angle between lines
        value -= float(np.pi * np.round((value - parameter.nominal) / np.pi))
    return _Decision(override.action, value, override.stated.sigma)


def _contradiction(
    name: str, several: Sequence[tuple[Override, _Decision]], known: KnownParameters
) -> str:
    """Return the sentence about overrides of one parameter that contradict each other, if any."""
    fixed = [override for override, decision in several if decision.action == "fixed"]
    others = [override for override, decision in several if decision.action != "fixed"]
    stated = {(d.value, d.sigma): override for override, d in several if d.value is not None}
    if fixed and others:
        done, pair = f"both fixed and {_DONE[others[0].action]}", (fixed[0], others[0])
    elif len(stated) > 1:
        first, second, *_ = stated.values()
        done = "fixed at two values" if fixed else "given two different priors"
        pair = (first, second)
    else:
        return ""
    other = next((w.name for w in pair if w.name in known.synonyms), "")
    also = f", which is {other} too," if other else ""  # views that have one camera
    return (
        f"{name}{also} could not be {done}: found {_quoted(pair[0])} and {_quoted(pair[1])}, "
        "needed one of them; remove the other."
    )


def _quoted(override: Override) -> str:
    """Return where an override was said, as part of a sentence."""
    return (
        override.where[:1].lower() + override.where[1:] if not override.in_file else override.where
    )


def _with_unit(value: float, parameter: KnownParameter) -> str:
    """Return a value and its unit."""
    return f"{value:.4g} {parameter.unit}".rstrip()
