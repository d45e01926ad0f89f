"""The parameters that somebody may name: of the mechanism, of legs, of cameras, of the board."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from legcal.mechanism.leg import Leg, LegKind
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parameters import free_coordinates, radius_name
from legcal.mechanism.parametrization import geometries, parametrization_of, vector_of
from legcal.observations.measurements import View
from legcal.vision.intrinsics import (
    intrinsic_names,
    intrinsic_unit,
    intrinsic_values,
    shared_cameras,
)

Kind = Literal["kinematic", "radius", "intrinsic", "board"]
BOARD_SCALE = "board.scale"  # the factor on the dimensions of a calibration board
_RATIO = 10.0  # between a radius or length and its nominal value: more is a mistake of the unit
_FOCAL_RATIO = 2.0
_COEFFICIENT = 1e3  # of distortion; far more than any lens has


@dataclass(frozen=True)
class KnownParameter:
    """A parameter and what values make sense for it.

    Attributes
    ----------
    nominal : float
        Its value in the model or camera file [unit].
    unit : {"m", "rad", "px", ""}
        Its unit; "" for coefficients of distortion and for the size of a board.
    kind : {"kinematic", "radius", "intrinsic", "board"}
        What it belongs to.
    least, most : float
        Between these a stated value is believed [unit].
    sigma : float or None
        What its camera file says of its uncertainty, one standard deviation [unit].
    """

    nominal: float
    unit: str
    kind: Kind
    least: float
    most: float
    sigma: float | None = None


@dataclass(frozen=True, eq=False)
class KnownParameters:
    """The parameters of a machine and of the cameras that look at it.

    Attributes
    ----------
    by_name : mapping
        The parameters, in the order kinematic ones with twists, radii, intrinsics, the size of the
        calibration board.
    others : mapping
        Names that look like parameters and are none, and why: the end of a sentence.
    synonyms : mapping
        Other names of intrinsics, and the one that counts: views of one camera share them.
    """

    by_name: Mapping[str, KnownParameter]
    others: Mapping[str, str]
    synonyms: Mapping[str, str]

    @property
    def names(self) -> tuple[str, ...]:
        """All names by which a parameter may be called."""
        return (*self.by_name, *self.synonyms)

    def counted(self, name: str) -> str:
        """Return the name that counts for a name."""
        return self.synonyms.get(name, name)


def known_parameters(
    mechanism: Mechanism,
    views: Sequence[View],
    *,
    axes_given: bool = False,
    with_board: bool = False,
) -> KnownParameters:
    """Return the parameters of a machine and of the cameras of its views.

    Parameters
    ----------
    mechanism : Mechanism
        The nominal model.
    views : sequence of View
        The views of the dataset.
    axes_given : bool
        Leg axes were measured in place of outlines: radii and intrinsics are in them already.
    with_board : bool
        A calibration board stands on the base.
    """
    by_name, others = _kinematic(mechanism), _no_parameters(mechanism)
    seen: dict[str, KnownParameter] = dict(_radii(mechanism))
    intrinsics, synonyms = _intrinsics(views)
    seen |= intrinsics
    board = (
        {BOARD_SCALE: KnownParameter(1.0, "", "board", 1.0 / _RATIO, _RATIO)} if with_board else {}
    )
    if axes_given:
        reason = "measured axes, in which cameras and radii are contained already"
        others |= dict.fromkeys((*seen, *synonyms), reason)
        return KnownParameters(by_name | board, others, {})
    return KnownParameters(by_name | seen | board, others, synonyms)


def _kinematic(mechanism: Mechanism) -> dict[str, KnownParameter]:
    """Return the kinematic parameters with their nominal values."""
    legs, found = geometries(mechanism), parametrization_of(mechanism, twists=True)
    values = vector_of(found, legs, legs)
    metres = np.array(found.units) == "m"
    size = float(np.abs(values[metres]).max())
    known = {}
    for name, unit, nominal in zip(found.names, found.units, values.tolist(), strict=True):
        least, most = -np.pi, np.pi
        if unit == "m":
            least, most = nominal - size, nominal + size
        if name.endswith(".length"):
            least = nominal / _RATIO
        known[name] = KnownParameter(nominal, unit, "kinematic", least, most)
    return known


def _radii(mechanism: Mechanism) -> Iterator[tuple[str, KnownParameter]]:
    """Yield the radii of the visible parts of the legs."""
    for leg in mechanism.legs:
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
            sigma = camera.sigma.get(name) or None
            known[f"{owner}.{name}"] = KnownParameter(nominal, unit, "intrinsic", *limits, sigma)
    return known, synonyms


def _no_parameters(mechanism: Mechanism) -> dict[str, str]:
    """Return the names that look like parameters of a machine and are none, and why."""
    free = free_coordinates(len(mechanism.legs), mechanism.frame_legs)
    known = parametrization_of(mechanism, twists=True).names
    others: dict[str, str] = {}
    for j, leg in enumerate(mechanism.legs):
        for side, frame in (("base", "R_b"), ("platform", "R_e")):
            for axis, letter in enumerate("xyz"):
                name = f"{leg.name}.{side}.{letter}"
                if name in known:
                    continue
                is_zero = not free[j, axis] and (axis < 2 or len(mechanism.frame_legs) == 3)
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
