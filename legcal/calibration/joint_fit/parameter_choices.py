"""Estimated, fixed and prior-constrained parameters: choices, resolved from overrides."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import permutations
from typing import Literal

import numpy as np

from legcal.data.dataset_file import Action, Override
from legcal.data.measurements import View
from legcal.errors import DatasetError, UsageError
from legcal.files.schema import closest
from legcal.geometry.types import Array
from legcal.machine.leg import LINKS, LegKind, Link, ParameterId, radius_name
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    geometries,
    is_held_by_default,
    parametrization_of,
    vector_of,
)
from legcal.machine.tolerance import Tolerance
from legcal.vision.board import FixedBoard, board_name
from legcal.vision.camera import intrinsic_names, intrinsic_unit, intrinsic_values, shared_cameras

Group = Literal["zeros", "lengths", "all"]  # what --only reports, and writes into the model

_ALL_NAMES = "docs/formats.md, Parameter names, lists all kinds"


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior on a parameter: mean and standard deviation [its unit]."""

    mean: float
    sigma: float


@dataclass(frozen=True, eq=False)
class KnownIntrinsics:
    """A prior on all intrinsics of a camera, in the order of ``intrinsic_names``."""

    mean: Array  # (n,) [px; distortion without unit]
    covariance: Array  # (n, n) zero for what is exact


@dataclass(frozen=True)
class Choices:
    """Choices of parameters by their full names.

    By default the fit estimates all kinematic parameters except twists, radii with a prior, and
    intrinsics with the covariance of their camera file as a prior; others are fixed. A choice for
    an intrinsic replaces its part of that covariance.
    """

    fixed: frozenset[str] = frozenset()  # at nominal, or at ``values``
    free: frozenset[str] = frozenset()  # without a prior: radii, and what is fixed by default
    priors: Mapping[str, Prior] = field(default_factory=dict)  # in place of those by default
    values: Mapping[str, float] = field(default_factory=dict)  # [m, rad, px], axes as angles
    notes: tuple[str, ...] = ()  # on overridden choices
    least_shared_px: Mapping[str, float] = field(default_factory=dict)  # by outline_errors.KINDS
    of_photographs: bool = False  # whether outlines were measured in photographs
    # by the representative view of a camera, in place of the covariance of its file
    cameras: Mapping[str, KnownIntrinsics] = field(default_factory=dict)
    # complete tolerances that are priors of all kinematic parameters, beside those above
    built: Tolerance | None = None
    only: Group | None = None  # what is reported of these

    @classmethod
    def by_tolerances(cls, machine: Machine, only: Group | None) -> Choices:
        """Return the choices of ``--only``; no choices without it.

        Raises
        ------
        UsageError
            If neither the model nor the dataset states tolerances.
        """
        if only is None:
            return NO_CHOICES
        if not machine.tolerance.says_parts:
            raise UsageError(
                "--only could not be used: found no tolerance, needed how well the machine is "
                "built; state machine_kind: printed, machined or bought, or tolerance, in "
                "dataset.yaml or in the block legcal of the model."
            )
        return cls(built=machine.tolerance.completed(machine.size), only=only)

    def holds(self, name: str, *, by_default: bool = False) -> bool:
        """Whether a parameter is fixed; *by_default*: whether it is without a choice."""
        if name in self.fixed:
            return True
        return by_default and name not in self.free and name not in self.priors

    def document(self) -> dict[str, object]:
        """Return the choices for JSON, without empty entries."""
        document = {
            "fixed": sorted(self.fixed - self.values.keys()),
            "fixed_at": dict(sorted(self.values.items())),
            "free": sorted(self.free),
            "priors": {name: [p.mean, p.sigma] for name, p in sorted(self.priors.items())},
            "cameras": {
                name: [intrinsics.mean.tolist(), intrinsics.covariance.tolist()]
                for name, intrinsics in sorted(self.cameras.items())
            },
            "least_shared_px": dict(sorted(self.least_shared_px.items())),
            "built": None if self.built is None else vars(self.built),
            "only": self.only,
        }
        return {key: value for key, value in document.items() if value}


NO_CHOICES = Choices()

ParameterKind = Literal["kinematic", "radius", "intrinsic", "board"]
_MEASURED_RATIO = 1.15  # largest plausible ratio of measured and nominal distances of joints
_RATIO = 10.0  # of a radius or length to its nominal value; more is a wrong unit
_FOCAL_RATIO = 2.0
_COEFFICIENT = 1e3  # of distortion; far more than any lens has


@dataclass(frozen=True)
class KnownParameter:
    """A parameter with the limits of plausible values."""

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
    # names that look like parameters but are not, and the reason: the end of a sentence
    others: Mapping[str, str]
    # alternative names of intrinsics, to canonical names: views of one camera share them
    synonyms: Mapping[str, str]
    # distances of two joints, by both names with a colon: measurable by hand
    lengths: Mapping[str, KnownParameter] = field(default_factory=dict)

    def parameter(self, name: str) -> KnownParameter:
        """Return a parameter, or a distance of joints, by its canonical name."""
        return self.by_name[name] if name in self.by_name else self.lengths[name]

    @property
    def names(self) -> tuple[str, ...]:
        """All names of parameters, with synonyms."""
        return (*self.by_name, *self.synonyms)

    def canonical(self, name: str) -> str:
        """Return the canonical name."""
        return self.synonyms.get(name, name)


def board_scale(link: Link) -> str:
    """Name of the scale factor of the calibration board on a link."""
    return f"{board_name(link)}.scale"


def known_parameters(
    machine: Machine,
    views: Sequence[View],
    *,
    boards: Sequence[FixedBoard] = (),
) -> KnownParameters:
    """Return the parameters of a machine and of the cameras of its views."""
    by_name, others = _kinematic(machine), _rejected_names(machine)
    seen: dict[str, KnownParameter] = dict(_radii(machine))
    intrinsics, synonyms = _intrinsics(views)
    seen |= intrinsics
    board = {
        board_scale(fixed.link): KnownParameter(1.0, "", "board", 1.0 / _RATIO, _RATIO)
        for fixed in boards
    }
    lengths = _lengths(machine)
    return KnownParameters(by_name | seen | board, others, synonyms, lengths)


def _lengths(machine: Machine) -> dict[str, KnownParameter]:
    """Return the distances of joints on the base and on the platform, by LEG.SIDE:LEG.SIDE.

    Joints at A that move are where they are at reading 0.
    """
    lengths: dict[str, KnownParameter] = {}
    for side in ("base", "platform"):
        points = machine.A_base if side == "base" else machine.B_platform
        for (j, first_leg), (k, second_leg) in permutations(enumerate(machine.leg_names), 2):
            nominal = float(np.linalg.norm(points[j] - points[k]))
            limits = nominal / _RATIO, nominal * _RATIO
            name = f"{first_leg}.{side}:{second_leg}.{side}"
            lengths[name] = KnownParameter(nominal, "m", "kinematic", *limits)
    return lengths


def joints_of_length(name: str) -> tuple[tuple[str, str], tuple[str, str]] | None:
    """Parse the name of a distance: leg and side of both joints; None for another name."""
    ends = [tuple(end.rpartition(".")[::2]) for end in name.split(":")]
    if len(ends) != 2:
        return None
    (leg, side), (other_leg, other_side) = ends
    return (leg, side), (other_leg, other_side)


def _kinematic(machine: Machine) -> dict[str, KnownParameter]:
    """Return the kinematic parameters with their nominal values."""
    legs, parametrization = geometries(machine), parametrization_of(machine, twists=True)
    values = vector_of(parametrization, legs, legs)
    metres = np.array(parametrization.units) == "m"
    size = float(np.abs(values[metres]).max())
    parameters = {}
    for name, unit, nominal in zip(
        parametrization.names, parametrization.units, values.tolist(), strict=True
    ):
        least, most = -np.pi, np.pi
        if unit == "m":
            least, most = nominal - size, nominal + size
        if ParameterId.parse(name).kind == "length":
            least = nominal / _RATIO
        parameters[name] = KnownParameter(nominal, unit, "kinematic", least, most)
    return parameters


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
    parameters: dict[str, KnownParameter] = {}
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
            parameters[f"{owner}.{name}"] = KnownParameter(nominal, unit, "intrinsic", *limits)
    return parameters, synonyms


def _rejected_names(machine: Machine) -> dict[str, str]:
    """Names that look like parameters of a machine but are not, with the reason."""
    kinds = (
        *(f"{side}.{axis}" for side in LINKS for axis in "xyz"),
        *("base_axis.1", "base_axis.2", "platform_axis.1", "platform_axis.2", "twist"),
        *("offset", "length"),
    )
    known = parametrization_of(machine, twists=True).names
    others: dict[str, str] = {}
    for leg in machine.legs:
        number = "length" if leg.kind is LegKind.CONSTANT else "offset"
        for kind in kinds:
            if kind in ("offset", "length"):
                reason = f"a leg whose parameter is {leg.name}.{number}"
                if leg.kind is LegKind.PASSIVE:
                    reason = "a leg without an encoder, whose length is passive"
            elif kind[-2:] in (".x", ".y", ".z"):
                frame = "R_b" if kind.startswith("base") else "R_e"
                reason = f"a coordinate that has no effect or is zero by the definition of {frame}"
            else:
                reason = f"which is no parameter of a leg of type {leg.type} in this machine"
            if f"{leg.name}.{kind}" not in known:
                others[f"{leg.name}.{kind}"] = reason
    return others


_PAST_TENSE: Mapping[Action, str] = {"prior": "given a prior", "free": "freed", "fixed": "fixed"}


def resolve(overrides: Sequence[Override], known: KnownParameters) -> Choices:
    """Resolve overrides to choices.

    Raises
    ------
    UsageError, DatasetError
        One sentence for each unknown name, implausible value, and pair of contradictory overrides.
    """
    from_file, problems_of_file = _decisions([w for w in overrides if w.in_file], known)
    from_call, problems = _decisions([w for w in overrides if not w.in_file], known)
    if problems:
        raise UsageError([*problems, *problems_of_file])
    if problems_of_file:
        raise DatasetError(problems_of_file)
    decisions = from_file | from_call
    overridden = [
        name for name in from_file if from_call.get(name, from_file[name]) != from_file[name]
    ]
    note = f"This run overrides the choices of the dataset for {', '.join(overridden)}."
    stated = {name: (d.value, d.sigma) for name, d in decisions.items() if d.value is not None}
    choices = Choices(
        frozenset(name for name, d in decisions.items() if d.action == "fixed"),
        frozenset(name for name, d in decisions.items() if d.action == "free"),
        {name: Prior(value, sigma) for name, (value, sigma) in stated.items() if sigma is not None},
        {name: value for name, (value, sigma) in stated.items() if sigma is None},
        (note,) if overridden else (),
    )
    names = [name for name, p in known.by_name.items() if p.kind == "kinematic"]
    if all(choices.holds(n, by_default=is_held_by_default(n)) for n in names):
        raise UsageError(
            "All parameters of the mechanism are fixed: nothing is left to calibrate; fix fewer of "
            "them."
        )
    return choices


@dataclass(frozen=True)
class _Decision:
    """The action for one parameter, values in its unit."""

    action: Action
    value: float | None = None
    sigma: float | None = None


def _decisions(
    overrides: Sequence[Override], known: KnownParameters
) -> tuple[dict[str, _Decision], list[str]]:
    """Decisions of the overrides of one source by parameter, and problems."""
    decisions: dict[str, list[tuple[Override, _Decision]]] = {}
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
                decisions.setdefault(name, []).append(
                    (override, _decision(override, name, parameter))
                )
    problems += [
        p for name, group in decisions.items() if (p := _contradiction(name, group, known))
    ]
    # Of several consistent decisions, one with a value wins.
    strongest = {
        name: next((d for _, d in group if d.value is not None), group[0][1])
        for name, group in decisions.items()
    }
    return strongest, problems


def _matches(override: Override, known: KnownParameters) -> tuple[str, ...]:
    """Canonical names of the parameters that an override matches."""
    if override.name in known.names:
        return (known.canonical(override.name),)
    if ":" in override.name:
        return _matching_length(override, known)
    names = [known.canonical(name) for name in known.names if fnmatchcase(name, override.name)]
    return tuple(dict.fromkeys(names))


def _matching_length(override: Override, known: KnownParameters) -> tuple[str, ...]:
    """Return the distance of joints that an override matches; of both ends of a rod, its length."""
    if override.action != "prior":
        return ()
    joints = joints_of_length(override.name)
    if joints is not None and joints[0][0] == joints[1][0]:
        name = f"{joints[0][0]}.length"
        sides = {side for _, side in joints}
        return (name,) if name in known.by_name and sides == {"base", "platform"} else ()
    first, _, second = override.name.partition(":")
    pair = min(override.name, f"{second}:{first}")
    return (pair,) if pair in known.lengths else ()


def _no_match(override: Override, known: KnownParameters) -> str:
    """Describe an override that matches no parameter."""
    if ":" in override.name:
        return (
            f"{override.where} could not be used: it is not a distance between two joints; write "
            "LEG.base:LEG.base or LEG.platform:LEG.platform of different legs, or both ends of a "
            f"rod, with a value and its sigma; {closest(override.name, known.lengths)}"
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
        f"of its cameras; {closest(override.name, known.names, _ALL_NAMES)}"
    )


def _misstated(override: Override, name: str, parameter: KnownParameter) -> str:
    """Describe an implausible value of an override, if it is."""
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
            f"{override.where} could not be used: {_with_unit(stated.value, parameter)} differs by "
            f"more than {100.0 * (_MEASURED_RATIO - 1.0):.0f} % from the distance of these joints "
            f"in the model, {_with_unit(parameter.nominal, parameter)}; check the number, its unit "
            "and between which joints it was measured, or correct the model."
        )
    return (
        f"{override.where} could not be used: {_with_unit(stated.value, parameter)} for {name} is "
        f"implausible (nominal {_with_unit(parameter.nominal, parameter)}, accepted "
        f"{parameter.least:.4g} to {parameter.most:.4g}); check the number and its unit."
    )


def _decision(override: Override, name: str, parameter: KnownParameter) -> _Decision:
    """Decision of an override for one parameter."""
    if override.stated is None:
        return _Decision(override.action)
    value = override.stated.value
    if ParameterId.parse(name).kind == "twist":  # an angle between lines
        value -= float(np.pi * np.round((value - parameter.nominal) / np.pi))
    return _Decision(override.action, value, override.stated.sigma)


def _contradiction(
    name: str, several: Sequence[tuple[Override, _Decision]], known: KnownParameters
) -> str:
    """Describe contradictory overrides of one parameter, if they are."""
    fixed = [override for override, decision in several if decision.action == "fixed"]
    others = [override for override, decision in several if decision.action != "fixed"]
    stated = {(d.value, d.sigma): override for override, d in several if d.value is not None}
    if fixed and others:
        done, pair = f"both fixed and {_PAST_TENSE[others[0].action]}", (fixed[0], others[0])
    elif len(stated) > 1:
        first, second, *_ = stated.values()
        done = "fixed at two values" if fixed else "given two different priors"
        pair = (first, second)
    else:
        return ""
    other = next((w.name for w in pair if w.name in known.synonyms), "")
    also = f", which is {other} too," if other else ""  # views that have one camera
    return (
        f"{name}{also} could not be {done}: {_quoted(pair[0])} and {_quoted(pair[1])} are in "
        "conflict; keep one of them."
    )


def _quoted(override: Override) -> str:
    """Source of an override, inside a sentence."""
    return (
        override.where[:1].lower() + override.where[1:] if not override.in_file else override.where
    )


def _with_unit(value: float, parameter: KnownParameter) -> str:
    """Format a value with its unit."""
    return f"{value:.4g} {parameter.unit}".rstrip()
