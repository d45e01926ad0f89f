"""Errors that outlines of photographs share: those there are, beside those that a fit states.

    python benchmarks/machine_kinds.py delta --runs 0 --datasets 4 --level photographs --keep KEEP
    python benchmarks/shared_errors.py KEEP/*-photographs-?

Datasets are simulated photographs with a result beside each (``NAME-result``). The errors of its
used outlines against the truth are split as the fit splits residuals, by restricted maximum
likelihood, with errors at places among the others: no fit takes any of them up. Printed are the
standard deviations of each kind [px], and those that the result states, then the root mean squares
of all datasets. Outlines of other edges, more than ``_OTHER`` off, are left out.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

import numpy as np

from legcal.calibration.joint_fit.factors import observed_outlines
from legcal.calibration.joint_fit.outline_errors import (
    KINDS,
    PLACES,
    possible_biases,
    shifts_at_places,
)
from legcal.calibration.joint_fit.variables import fitted_legs
from legcal.data.dataset import OBSERVATIONS_NAME, load_dataset, read_observed
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.estimation.variances import Effects, estimate_variances
from legcal.geometry.covariances import whitener
from legcal.geometry.types import Array

_OTHER = 1.0  # [px]
_ROUNDS = 4  # in which the scale of claimed errors follows
_LEAST = 1e-6  # [px], of standard deviations


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("datasets", nargs="+", type=Path)
    asked = parser.parse_args()
    print("standard deviations [px], true and stated, of", *(f"\n- {k}" for k in (*KINDS, *PLACES)))
    found = []
    for folder in asked.datasets:
        result = folder.with_name(f"{folder.name}-result")
        stated = json.loads((result / "result.json").read_text())["residuals"]["shared_px"]
        of = true_errors(folder, result), [stated.get(kind, 0.0) for kind in (*KINDS, *PLACES)]
        found.append(of)
        print(folder.name, *(_words(np.array(sizes)) for sizes in of), sep="\n    ", flush=True)
    rms = np.sqrt(np.mean(np.square(found), axis=0))
    print("all, root mean square", *map(_words, rms), sep="\n    ")


def _words(sizes: Array) -> str:
    return " ".join(f"{size:.3f}" for size in sizes)


def true_errors(folder: Path, result: Path) -> Array:
    """Return the standard deviations of all kinds of errors that outlines share [px]."""
    data = load_dataset(folder, check_images=False)
    measurements, legs = data.measurements, fitted_legs(data.machine)
    measured, _ = read_observed(result, data.machine, measurements)
    with TemporaryDirectory() as name:
        copyfile(folder / "truth" / "outlines.csv", Path(name) / OBSERVATIONS_NAME)
        true, _ = read_observed(Path(name), data.machine, measurements)
    if measured is None or true is None:
        raise SystemExit(f"{folder}: found no outlines, needed those of a result and the truth.")
    place = {key: i for i, key in enumerate(_keys(true))}
    known = measured.used & np.array([key in place for key in _keys(measured)])
    measured = measured.choose(known)
    h = true.h[[place[key] for key in _keys(measured)]]
    off = np.abs(_offsets(measured, h, measurements)).max(axis=1)
    measured, h = measured.choose(off < _OTHER), h[off < _OTHER]
    o = observed_outlines(measured, measurements, legs)
    every = np.ones(len(o), dtype=np.bool_)
    possible, at_places = possible_biases(o, legs.names), shifts_at_places(o, every)
    shifts = np.zeros((len(o), 2, len(possible)))
    for index, shift in zip(possible.index.T, np.swapaxes(possible.shift, 0, 1), strict=True):
        shifts[np.arange(len(o)), :, index] += shift
    kept = possible.kind < len(KINDS)  # the gamma is given
    n_places = at_places.shape[2] // len(PLACES)
    of_places = np.repeat(len(KINDS) + np.arange(len(PLACES)), n_places)
    kind = np.concatenate([possible.kind[kept], of_places])
    T = whitener(o.covariance)
    V = (T @ np.concatenate([shifts[:, :, kept], at_places], axis=2)).reshape(-1, len(kind))
    r = np.einsum("nij,nj->ni", T, _offsets(measured.choose(o.index), h[o.index], measurements))
    r, scale = r.ravel(), 1.0
    for _ in range(_ROUNDS):
        z, K = V.T @ r / scale**2, V.T @ V / scale**2
        variances, _ = estimate_variances(Effects(z, K, kind), 0.0)
        inverse = np.linalg.inv(K + np.diag(1.0 / np.maximum(variances, _LEAST**2)[kind]))
        free = len(r) - float(np.sum(inverse * K))
        scale = float(np.sqrt(np.sum((r - V @ (inverse @ z)) ** 2) / free))
    return np.sqrt(variances)


def _keys(outlines: Outlines) -> list[tuple[int, int, str, int]]:
    columns = (outlines.row.tolist(), outlines.leg.tolist(), outlines.part, outlines.edge.tolist())
    return list(zip(*columns, strict=True))


def _offsets(measured: Outlines, h: Array, measurements: Measurements) -> Array:
    """Return the distances (n, 2) of both ends of measured outlines from true ones [px]."""
    found = np.zeros((len(h), 2))
    for v, view in enumerate(measurements.views):
        own = measurements.view[measured.row] == v
        xy = view.camera.undistort(measured.ends[own])
        found[own] = view.camera.line_offset(h[own, None], xy)
    return found


if __name__ == "__main__":
    main()
