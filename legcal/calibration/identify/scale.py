"""Sources of scale for a machine without readings of lengths.

Encoders of arms measure angles: such a machine at twice the size, with rods twice as thick and
cameras twice as far, gives the same images and readings. A measured length, a board, or radii fix
the scale; a default prior on radii, or on lines of arms, must not do so silently.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from legcal.calibration.identify.ranks import Analysis, undetermined
from legcal.calibration.identify.report import ScaleSource
from legcal.calibration.joint_fit.predicted import WHITE
from legcal.calibration.joint_fit.variables import RefinementSettings
from legcal.data.dataset import Dataset
from legcal.geometry.types import Array
from legcal.machine.leg import SIGMA_LENGTH, LegColumns
from legcal.vision.board import Link

_OPEN = 1e-6  # of their mean, in directions that are not determined: lengths are open
_KNOWN = 2.5e-9  # mean leg lengths: of a radius that is known
_VAGUE = RefinementSettings.radius_sigma / 2.0  # of the scale
_LINKS: tuple[Link, ...] = ("base", "platform")


def scale_sources(analysis: Analysis) -> tuple[ScaleSource, ...]:
    """Return possible sources of scale with their accuracy; empty if the scale is known."""
    if not analysis.session.actuators or not is_scale_open(analysis):
        return ()
    names = analysis.session.parametrization.names
    measured = analysis.session.columns(LegColumns.LENGTH)[:1]
    length = SIGMA_LENGTH * analysis.session.mean_length
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
    analysis = replace(analysis, noise=WHITE)  # what is known of lengths, and not of edges
    stated = _stated_radii(analysis)
    if _n_open(analysis, stated) > n_open_with_radii(analysis):
        return True
    if not analysis.choices.priors:
        return False
    known, seen = (
        _sigma(analysis, _information(analysis, radii)) for radii in (stated, _all_known(analysis))
    )
    if known is None or seen is None or known**2 - seen**2 <= _VAGUE**2:
        return False
    nothing = replace(analysis, choices=replace(analysis.choices, priors={}))
    return _n_open(nothing, _stated_radii(nothing)) > _n_open(nothing, _all_known(nothing))


def _n_open(analysis: Analysis, sigma_radii: Mapping[str, float]) -> int:
    """Count the open directions for standard deviations of radii [m]."""
    return len(undetermined(analysis.session, _information(analysis, sigma_radii)))


def n_open_with_radii(analysis: Analysis) -> int:
    """Count the directions that stay open where radii are known exactly."""
    return _n_open(analysis, _all_known(analysis))


def _all_known(analysis: Analysis) -> dict[str, float]:
    """Return standard deviations of radii that are known exactly [m]."""
    return dict.fromkeys(analysis.session.radii, _KNOWN * analysis.session.mean_length)


def _source(analysis: Analysis, name: str, words: str, information: Array) -> ScaleSource:
    """Accuracy of the scale and the platform with a source; None where lengths stay open."""
    sigma = _sigma(analysis, information)
    motion = None if sigma is None else analysis.motion.sigma(information)
    return ScaleSource(name, words, sigma, motion)


def _sigma(analysis: Analysis, information: Array) -> float | None:
    """Relative standard deviation of the scale; None if it is open."""
    session = analysis.session
    columns = session.columns(LegColumns.LENGTH)
    lengths = np.array([leg.q0 for leg in session.legs])[: len(columns)]
    mean = np.zeros(len(session.unit))  # of the relative errors of lengths
    mean[columns] = 1.0 / (len(columns) * lengths)
    undetermined_directions = undetermined(session, information)
    leaves_more = len(undetermined_directions) > n_open_with_radii(analysis)
    if leaves_more or np.linalg.norm(undetermined_directions @ mean) > _OPEN * np.linalg.norm(mean):
        return None
    _, singular, basis = np.linalg.svd(information, full_matrices=False)
    seen = singular > 0.0
    return float(np.linalg.norm(basis[seen] @ mean / singular[seen]))


def _information(
    analysis: Analysis,
    sigma_radii: Mapping[str, float] | None = None,
    *,
    common: float | None = None,
) -> Array:
    """Information rows by parameters, for standard deviations [m] of radii, or a *common* error.

    That is relative, and the same for all. Lines of arms have stated priors only.
    """
    found, radii = analysis.without_radii, analysis.session.radii
    rows = np.concatenate([found.all_gains(), found.known])
    column = {name.removeprefix("radii "): i for i, name in enumerate(found.names)}
    if common is not None:
        seen = [name for name in radii if name in column]
        by_common = rows[:, [column[name] for name in seen]] @ [radii[name] for name in seen]
        rows = np.column_stack([np.delete(rows, [column[name] for name in seen], 1), by_common])
        prior = np.eye(1, rows.shape[1], rows.shape[1] - 1) / common
        return analysis.of_parameters(np.concatenate([rows, prior]), found.basis)
    sigma_radii = sigma_radii or {}
    known = [name for name in sigma_radii if name in column]
    prior = np.zeros((len(known), rows.shape[1]))
    for row, name in zip(prior, known, strict=True):
        row[column[name]] = 1.0 / sigma_radii[name]
    return analysis.of_parameters(np.concatenate([rows, prior]), found.basis)


def _stated_radii(analysis: Analysis) -> dict[str, float]:
    """Return stated standard deviations of radii [m]."""
    choices, exact = analysis.choices, _all_known(analysis)
    stated = {name: sigma for name, sigma in exact.items() if name in choices.fixed}
    return stated | {name: choices.priors[name].sigma for name in exact if name in choices.priors}


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
    if _n_open(analysis, _stated_radii(analysis)) == _n_open(
        analysis, _all_known(analysis)
    ):  # something is stated
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
