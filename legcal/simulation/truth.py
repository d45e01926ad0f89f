"""The true machine: the nominal model with drawn errors, written as a model of its own.

With other rods, axes or twists the machine closes elsewhere than the nominal one: its home is the
closed pose nearest to the nominal home.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, ModelError, OutOfClass
from legcal.mechanism.home import home_with
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.report.model_files import mechanism_text, model_name
from legcal.report.urdf import check_closes, write_urdf
from legcal.report.urdf_patch import patch_radii
from legcal.simulation.parameter_errors import ParameterErrors, draw_errors
from legcal.simulation.radii import draw_radii

DRAWS = 20
FURTHEST = 0.2  # of a leg length, by which the nominal home may miss what the true legs demand


def write_true_model(
    nominal: Mechanism, errors: ParameterErrors, rng: np.random.Generator, folder: Path
) -> Mechanism:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a machine with errors, and load it.

    Errors with which the machine does not close, or closes into another mechanism, are drawn again.

    Parameters
    ----------
    nominal : Mechanism
        The nominal model.
    errors : ParameterErrors
        How large the errors are.
    rng : numpy.random.Generator
        Source of the errors.
    folder : Path
        The folder that gets ``models`` and ``urdf``.

    Returns
    -------
    Mechanism
        The true machine, as loaded from these files.

    Raises
    ------
    UsageError
        If an error is negative, not finite or beyond reason.
    ModelError
        If no machine with such errors closes.
    OutOfClass
        If the tree of the URDF does not let its legs move one by one.
    """
    problems: Counter[str] = Counter()
    of_radii = rng.spawn(1)[0]
    for _ in range(DRAWS):
        legs = draw_errors(nominal, errors, rng)
        radii = draw_radii(nominal, errors.radii, of_radii)
        home = home_with(nominal, legs, FURTHEST)
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
    found = ", ".join(f"{count} times {what}" for what, count in problems.most_common())
    raise ModelError(
        f"{nominal.yaml_path}: no true machine could be made: found {found} in {DRAWS} draws of "
        "errors, needed one draw that closes as the nominal model does; give smaller errors, or "
        "none of the axes and lengths that close the loops."
    )


def write_model_with(
    nominal: Mechanism,
    legs: Sequence[LegGeometry],
    home: RigidTransform,
    folder: Path,
    radii: Mapping[tuple[str, int], float],
) -> Path:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a mechanism with other numbers.

    Parameters
    ----------
    nominal : Mechanism
        The nominal model.
    legs : sequence of LegGeometry
        The legs in R_b and R_e, see :func:`legcal.report.urdf.write_urdf`.
    home : RigidTransform
        T_base_platform of a pose in which they close.
    folder : Path
        The folder that gets ``models`` and ``urdf``.
    radii : mapping
        Of cylinders, as from :func:`draw_radii` [m]; the others keep theirs.

    Returns
    -------
    Path
        The YAML.
    """
    yaml_path, urdf_path = _places(nominal, folder)
    for path in (yaml_path, urdf_path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_urdf(nominal, legs, urdf_path)
    urdf_path.write_bytes(patch_radii(urdf_path.read_bytes(), radii))
    text = mechanism_text(replace(nominal, home=home), f"../urdf/{urdf_path.name}")
    yaml_path.write_text(text, encoding="utf-8")
    return yaml_path


def _places(nominal: Mechanism, folder: Path) -> tuple[Path, Path]:
    """Return where the files of the true model stand."""
    name = model_name(nominal)
    return folder / "models" / f"{name}.yaml", folder / "urdf" / f"{name}.urdf"


def _class_of(mechanism: Mechanism) -> tuple[object, ...]:
    """Return what a machine is, whatever its numbers are."""
    return mechanism.spatial, mechanism.mobility, tuple(leg.type for leg in mechanism.legs)
