"""Sources of scale for a machine without readings of lengths.

Encoders of arms measure angles: such a machine at twice the size, with rods twice as thick and
cameras twice as far, gives the same images and readings. A measured length, a board, or radii fix
the scale; a default prior on radii, or on lines of arms, must not do so silently.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.calibration.identify.information import (
    length_rows,
    prior_of_arms,
    radius_rows,
    session_problem,
)
from legcal.calibration.identify.ranks import Analysis, undetermined
from legcal.calibration.identify.report import ScaleSource
from legcal.calibration.joint_fit.variables import RefinementSettings
from legcal.data.dataset import Dataset
from legcal.estimation.problem import GaussianPrior, Variables, all_free
from legcal.estimation.square_root import information_rows, marginal_rows
from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import SIGMA_LENGTH, LegColumns, radius_name
from legcal.vision.board import Link

_OPEN = 1e-6  # of their mean, in directions that are not determined: lengths are open
_KNOWN = 2.5e-9  # mean leg lengths: of a radius that is known
_VAGUE = RefinementSettings.radius_sigma / 2.0  # of the scale
_LINKS: tuple[Link, ...] = ("base", "platform")


def scale_sources(analysis: Analysis) -> tuple[ScaleSource, ...]:
    """Return possible sources of scale with their accuracy; empty if the scale is known."""
    if not analysis.predicted.actuators or not is_scale_open(analysis):
        return ()
    names = analysis.predicted.parametrization.names
    measured = analysis.predicted.columns(LegColumns.LENGTH)[:1]
    length = SIGMA_LENGTH * analysis.predicted.mean_length
    radius = RefinementSettings.radius_sigma
    row = np.zeros((1, len(names)))
    row[0, measured] = 1.0 / length
    with_length = np.concatenate([_information(analysis), row])
    tried = (
        ("length", f"{names[measured[0]]} measured to {1e3 * length:.2g} mm", with_length),
        *(
            (
                f"{link}_board",
                f"a calibration board on the {link} in every view",
                _information(analysis.with_board(link=link)),
            )
            for link in _LINKS
        ),
        (
            "radii",
            f"radii known to {100 * radius:g} %, all wrong alike",
            _information(analysis, common=radius),
        ),
    )
    return tuple(_source(analysis, *each) for each in tried)


def is_scale_open(analysis: Analysis) -> bool:
    """Whether the scale comes from default priors on radii alone.

    Fixed radii and radii with a stated prior count as known. A stated length or radius that fixes
    the scale no better than half of the default prior of radii does not count: the default prior
    would dominate silently.
    """
    stated = _stated_radii(analysis)
    if _n_open(analysis, stated) > _n_open(analysis, 0.0):
        return True
    if not analysis.choices.priors:
        return False
    known, seen = (_sigma(analysis, _information(analysis, radii)) for radii in (stated, 0.0))
    if known is None or seen is None or known**2 - seen**2 <= _VAGUE**2:
        return False
    nothing = Analysis(analysis.predicted, replace(analysis.choices, priors={}))
    return _n_open(nothing, _stated_radii(nothing)) > _n_open(nothing, 0.0)


def _n_open(analysis: Analysis, sigma_radius: Array | float) -> int:
    """Count the open directions for standard deviations *sigma_radius* of radii [m]."""
    return len(undetermined(analysis.predicted, _information(analysis, sigma_radius)))


def _source(analysis: Analysis, name: str, words: str, information: Array) -> ScaleSource:
    """Accuracy of the scale and the platform with a source; None where lengths stay open."""
    sigma = _sigma(analysis, information)
    motion = None if sigma is None else analysis.motion.sigma(information)
    return ScaleSource(name, words, sigma, motion)


def _sigma(analysis: Analysis, information: Array) -> float | None:
    """Relative standard deviation of the scale; None if it is open."""
    predicted = analysis.predicted
    columns = predicted.columns(LegColumns.LENGTH)
    lengths = np.array([leg.q0 for leg in predicted.legs])[: len(columns)]
    mean = np.zeros(len(predicted.unit))  # of the relative errors of lengths
    mean[columns] = 1.0 / (len(columns) * lengths)
    undetermined_directions = undetermined(predicted, information)
    leaves_more = len(undetermined_directions) > _n_open(analysis, 0.0)
    if leaves_more or np.linalg.norm(undetermined_directions @ mean) > _OPEN * np.linalg.norm(mean):
        return None
    _, singular, basis = np.linalg.svd(information, full_matrices=False)
    seen = singular > 0.0
    return float(np.linalg.norm(basis[seen] @ mean / singular[seen]))


def _information(
    analysis: Analysis, sigma_radius: Array | float = np.inf, *, common: float | None = None
) -> Array:
    """Information rows by parameters, for priors *sigma_radius* [m] or a *common* relative error.

    Lines of arms have stated priors only.
    """
    predicted = analysis.predicted
    n, by_radius = predicted.n_bodies, radius_rows(predicted)
    shape = by_radius.shape[:2]
    radii: tuple[Variables, IntArray, Array]
    if common is not None:
        prior_of_common = GaussianPrior(np.zeros(1, dtype=np.intp), np.zeros(1), np.array([common]))
        relative = by_radius * predicted.body_radius[:, None, None]
        radii = (
            Variables("radius", all_free(1, 1), prior=prior_of_common),
            np.zeros(shape, dtype=np.intp),
            relative,
        )
    else:
        sigma = np.maximum(np.broadcast_to(sigma_radius, n), _KNOWN * predicted.mean_length)
        which = np.flatnonzero(np.isfinite(sigma))
        prior = GaussianPrior(which, np.zeros(len(which)), sigma[which])
        body = np.broadcast_to(np.arange(n), shape)
        radii = (Variables("radius", all_free(n, 1), prior=prior), body, by_radius)
    problem, state = session_problem(
        predicted,
        analysis.images,
        analysis.equations,
        analysis.prior,
        (radii,),
        length_rows(predicted, analysis.choices),
        prior_of_arms(predicted, analysis.choices, stated=True),
    )
    return marginal_rows(information_rows(problem, state), problem.where("parameters"))


def _stated_radii(analysis: Analysis) -> Array:
    """Stated standard deviations of radii, infinite for the others [m]."""
    choices, predicted = analysis.choices, analysis.predicted

    def sigma(j: int, arm: str) -> float:
        leg = predicted.legs[j]
        links = [arm] if arm else leg.radius_along
        names = [radius_name(predicted.leg_names[j], link) for link in links]
        stated = [choices.priors[name].sigma for name in names if name in choices.priors]
        if choices.fixed.intersection(names):
            stated.append(_KNOWN * predicted.mean_length)
        return min(stated, default=np.inf)

    return np.array([sigma(*part) for part in predicted.parts])


def refusal_of_scale(dataset: Dataset, analysis: Analysis) -> str:
    """Describe why the scale of a session is open, and the remedies."""
    machine = dataset.machine
    sources = scale_sources(analysis)
    if dataset.axes is not None:  # radii and boards are of images
        sources = tuple(source for source in sources if source.source == "length")
    fixing = [source.assumed for source in sources if source.sigma is not None]
    options = ", or ".join(fixing or [source.assumed for source in sources])
    reason, fix_gain = "readings of arms are angles", ""
    if machine.readings_carry_length:  # but for gains
        reason, fix_gain = (
            "the gains of all motors that slide are free",
            "fix one of these gains, or ",
        )
    if _n_open(analysis, _stated_radii(analysis)) == _n_open(analysis, 0.0):  # something is stated
        reason += f", and the stated values determine the scale no better than {100 * _VAGUE:g} %"
    stated = f"state a measured length ({machine.length_option})"
    if dataset.axes is None:
        stated += (
            ", or radii that you know better than the model (--set '*.radius.*=VALUE±SIGMAmm')"
        )
    return (
        f"{dataset.folder}: the parameters cannot be identified: {reason}, so the overall scale is "
        f"undetermined; any of these would determine it: {options}; {fix_gain}{stated}."
    )
