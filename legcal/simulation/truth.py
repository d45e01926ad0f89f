"""The true machine: the nominal model with drawn errors, written as a separate model.

With other rods, axes or twists the machine closes elsewhere than the nominal machine: its home is
the closed pose nearest to the nominal home.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, ModelError, OutOfClass, UsageError
from legcal.files.schema import MAX_TEXT, read_bytes
from legcal.machine.home import home_of_legs
from legcal.machine.leg import Leg, ParameterId
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.model_writer import check_closes, mechanism_text, model_name, write_urdf
from legcal.machine.parameters import (
    geometries,
    moved_legs,
    parametrization_of,
    reframed,
)
from legcal.machine.ties import machine_ties, on_ties
from legcal.machine.urdf import UrdfPatch
from legcal.simulation.settings import (
    ERRORS_OF,
    Distribution,
    ParameterErrors,
    Spread,
)
from legcal.simulation.solids import SolidCylinder, solids_of

# Maximum size of errors of radii, in units of the thinnest cylinder
_MAX_RADIUS_ERROR = {Distribution.UNIFORM: 0.5, Distribution.NORMAL: 0.1}
_ALIKE = 1e-9  # [m] maximum difference of radii of cylinders that form one tube
MAX_DRAWS = 20
MAX_HOME_SHIFT = 0.2  # maximum distance between nominal and true home, in leg lengths


def draw_errors(
    nominal: Machine, errors: ParameterErrors, rng: np.random.Generator
) -> tuple[Leg, ...]:
    """Return the legs of a machine with drawn errors, in R_b and R_e.

    Errors of all parameters are drawn in the same order, whatever their size: errors of one kind
    do not depend on errors of another kind. B of a leg that is fixed to the platform then slides
    along the leg to its place in models, the foot of the platform link's origin.
    """
    parametrization, legs = parametrization_of(nominal, twists=True), geometries(nominal)
    uniform, normal = (
        rng.uniform(-1.0, 1.0, len(parametrization)),
        rng.normal(size=len(parametrization)),
    )
    step = np.zeros(len(parametrization))
    for i, name in enumerate(parametrization.names):
        spread = _spread(errors, name)
        unit = normal if spread.distribution == Distribution.NORMAL else uniform
        step[i] = spread.size * unit[i]
    moved = moved_legs(legs, parametrization.place, step)
    scale = np.array([_spread(errors, name).size for name in parametrization.names])
    moved = on_ties(moved, legs, machine_ties(nominal), parametrization.place, scale)
    origin = np.asarray(nominal.T_platform_Re.inv().translation)
    return reframed(moved, nominal.frame_legs, origin)


def _spread(errors: ParameterErrors, name: str) -> Spread:
    """Return the size of the error of a parameter, by its name."""
    parameter = ParameterId.parse(name)
    kind = parameter.kind
    if kind == "gain":  # of motors: readings are true
        return Spread()
    if errors.coplanar and parameter.is_joint_coordinate and parameter.component == "z":
        return Spread()
    spread: Spread = getattr(errors, ERRORS_OF[kind])
    return spread


def draw_radii(
    nominal: Machine, spread: Spread, rng: np.random.Generator
) -> dict[tuple[str, int], float]:
    """Return the radii of the true legs."""
    if spread.size == 0.0:
        return {}
    counts: dict[str, int] = {}
    radii: dict[tuple[str, int], float] = {}
    tubes: dict[tuple[int, int], list[tuple[str, int]]] = {}
    for solid in solids_of(nominal, meshes_needed=False):
        if isinstance(solid.shape, SolidCylinder) and solid.link is not None:
            place = solid.link, counts.setdefault(solid.link, 0)
            counts[solid.link] += 1
            if solid.leg is not None:
                radii[place] = solid.shape.radius
                tube = solid.leg, round(solid.shape.radius / _ALIKE)
                tubes.setdefault(tube, []).append(place)
    thinnest = min(radii.values(), default=np.inf)
    most = _MAX_RADIUS_ERROR[Distribution(spread.distribution)] * thinnest
    if not spread.size <= most:
        raise UsageError(
            f"The errors of radii could not be drawn: found a size of {1e3 * spread.size:g} mm, "
            f"needed at most {1e3 * most:.3g} mm ({spread.distribution}) for cylinders as thin as "
            f"{1e3 * thinnest:g} mm; make it smaller."
        )
    uniform, normal = rng.uniform(-1.0, 1.0, len(tubes)), rng.normal(size=len(tubes))
    unit = normal if spread.distribution == Distribution.NORMAL else uniform
    for step, places in zip((spread.size * unit).tolist(), tubes.values(), strict=True):
        for place in places:
            radii[place] += step
    return radii


def write_true_model(
    nominal: Machine, errors: ParameterErrors, rng: np.random.Generator, folder: Path
) -> Machine:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a machine with errors, and load it.

    Errors with which the machine does not close, or closes into another mechanism, are drawn again.
    """
    problems: Counter[str] = Counter()
    of_radii = rng.spawn(1)[0]
    for _ in range(MAX_DRAWS):
        legs = draw_errors(nominal, errors, rng)
        radii = draw_radii(nominal, errors.radii, of_radii)
        home = home_of_legs(nominal, legs, MAX_HOME_SHIFT)
        if home is None:
            problems["legs that do not meet near home"] += 1
            continue
        path = write_model_with(nominal, legs, home, folder, radii)
        try:
            true = load_mechanism(path)
            if true.is_determined:
                check_closes(true)
        except (ModelError, OutOfClass, DidNotConverge):
            problems["a machine that no model can be, as with motors out of their travel"] += 1
            continue
        if _class_of(true) == _class_of(nominal):
            return true
        problems["a platform with other freedoms"] += 1
    for path in _places(nominal, folder):
        path.unlink(missing_ok=True)
    failures = ", ".join(f"{count} times {reason}" for reason, count in problems.most_common())
    raise ModelError(
        f"{nominal.yaml_path}: no true machine could be made: found {failures} in {MAX_DRAWS} "
        "draws of errors, needed one draw that closes as the nominal model does; give smaller "
        "errors, or none of the axes and lengths that close the loops."
    )


def write_model_with(
    nominal: Machine,
    legs: Sequence[Leg],
    home: RigidTransform,
    folder: Path,
    radii: Mapping[tuple[str, int], float],
) -> Path:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a mechanism with other numbers."""
    yaml_path, urdf_path = _places(nominal, folder)
    for path in (yaml_path, urdf_path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_urdf(nominal, legs, urdf_path)
    patch = UrdfPatch(read_bytes(urdf_path, MAX_TEXT))
    for (link, number), radius in radii.items():
        patch.set_radius(link, number, radius)
    urdf_path.write_bytes(patch.content())
    text = mechanism_text(replace(nominal, home=home), f"../urdf/{urdf_path.name}")
    yaml_path.write_text(text, encoding="utf-8")
    return yaml_path


def _places(nominal: Machine, folder: Path) -> tuple[Path, Path]:
    name = model_name(nominal)
    return folder / "models" / f"{name}.yaml", folder / "urdf" / f"{name}.urdf"


def _class_of(machine: Machine) -> tuple[object, ...]:
    """Return the structure of a machine, independent of its dimensions."""
    return machine.spatial, machine.mobility, tuple(leg.type for leg in machine.legs)
