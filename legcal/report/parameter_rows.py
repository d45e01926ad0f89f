"""The parameters of a calibration, one row each: what documents and tables show of them."""

from __future__ import annotations

from dataclasses import dataclass

from legcal.calibration import Calibration
from legcal.mechanism.parametrization import geometries, parametrization_of, vector_of
from legcal.refinement.known_parameters import known_parameters


@dataclass(frozen=True)
class ParameterRow:
    """One parameter.

    Attributes
    ----------
    name : str
        Its name.
    value, nominal : float
        As calibrated, and in the model or camera file [unit]; axes are turns of the nominal ones.
    sigma : float or None
        Standard deviation [unit]; None where it was not estimated.
    unit : {"m", "rad", "px", ""}
        Nothing for coefficients of distortion.
    status : {"estimated", "fixed", "weak"}
        A weak one takes part in a direction that nothing determines.
    """

    name: str
    value: float
    nominal: float
    sigma: float | None
    unit: str
    status: str


def parameter_rows(calibration: Calibration) -> list[ParameterRow]:
    """Return all kinematic parameters, the radii that were observed, and intrinsics looked for."""
    solution, dataset = calibration.solution, calibration.dataset
    mechanism = dataset.mechanism
    found = parametrization_of(mechanism, twists=True)
    values = dict(solution.values)
    numbers = vector_of(found, solution.legs, geometries(mechanism))
    values |= zip(found.names, numbers.tolist(), strict=True)
    sigma_of = dict(zip(solution.names, solution.sigma.tolist(), strict=True))
    with_board = dataset.board is not None
    known = known_parameters(mechanism, dataset.measurements.views, with_board=with_board).by_name
    return [
        ParameterRow(
            name,
            values[name],
            parameter.nominal,
            sigma_of.get(name),
            parameter.unit,
            solution.status.get(name, "fixed"),
        )
        for name, parameter in known.items()
        if name in values
    ]
