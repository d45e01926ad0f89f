"""Noise of outlines that nobody has measured yet: by default, or of an earlier result."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from legcal.calibration.joint_fit.outline_errors import KINDS, PLACES
from legcal.data.dataset import OBSERVATIONS_NAME
from legcal.data.outlines import OUTLINE_COLUMNS, Outlines
from legcal.errors import DatasetError, UsageError
from legcal.files.reading import read_json
from legcal.files.table import read_table


@dataclass(frozen=True)
class PredictedNoise:
    """Errors of outlines, whatever the contrast.

    By default shared errors are about the largest of a simulated machine
    (``benchmarks/shared_errors.py``): plans that count on less rely on it.

    Attributes
    ----------
    sigma_px : float
        Standard deviation of an edge in one pixel of length; that of an outline at both of its
        ends falls with the root of its length [px].
    correlation : float
        Of the errors at both ends: -0.5 where errors of pixels are independent.
    common_px : tuple of float
        Standard deviations of the common-mode edge biases, in the order of their kinds [px].
    places_px : tuple of float
        Standard deviations of bias and tilt of an edge at a place [px].
    gamma_px : float
        How far an outline moves with the logarithm of the gamma, which counts as not known [px].
    source : str
        Where it is from, in words.
    """

    sigma_px: float = 0.35
    correlation: float = 0.0
    common_px: tuple[float, ...] = (0.045, 0.003, 0.033, 0.009, 0.014, 0.005)
    places_px: tuple[float, ...] = (0.024, 0.023)
    gamma_px: float = 0.1
    source: str = "what photographs of simulated machines show"

    def of(self, outlines: Outlines) -> Outlines:
        """Return outlines with the covariance and the dependence on gamma that are predicted."""
        n = len(outlines.row)
        length = np.linalg.norm(outlines.ends[:, 1] - outlines.ends[:, 0], axis=-1)
        of_ends = 4.0 * np.array([[1.0, self.correlation], [self.correlation, 1.0]])
        with_noise = replace(
            outlines, covariance=(self.sigma_px**2 / length)[:, None, None] * of_ends
        )
        if self.gamma_px == 0.0:
            return with_noise
        return replace(with_noise, gamma=np.full(n, 2.2), by_gamma=np.full(n, self.gamma_px))


DEFAULT_NOISE = PredictedNoise()
# White noise of edge points, as simulated outlines have it
WHITE = PredictedNoise(0.1, -0.5, (0.0,) * 6, (0.0, 0.0), 0.0, "independent errors of edge points")


def read_noise(path: Path) -> PredictedNoise:
    """Return the estimated noise of an earlier result, by its folder or ``result.json``."""
    file = path / "result.json" if path.is_dir() else path
    try:
        document = read_json(file)
        if "legcal_result" in document:
            return _noise_of_result(document, file)
    except FileNotFoundError as error:
        problem = "no such file" if file == path else f"a folder without {file.name}"
        raise _unusable(path, problem) from error
    except OSError as error:
        raise _unusable(path, f"'{error.strerror or error}'") from error
    except KeyError as error:
        raise _unusable(path, f"a document without {error}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise _unusable(path, "no JSON document") from error
    except (ValueError, TypeError, AttributeError, DatasetError) as error:
        raise _unusable(path, f"'{error}'") from error
    raise _unusable(path, "another document")


def _unusable(path: Path, problem: str) -> UsageError:
    return UsageError(
        f"{path}: the noise could not be used: found {problem}, needed the folder of an earlier "
        "result or its result.json; correct --noise, or leave it out."
    )


def _noise_of_result(document: dict[str, Any], file: Path) -> PredictedNoise:
    """Noise of a result: claimed standard deviations times the estimated scale."""
    noise, common = document["residuals"]["noise"], document["residuals"]["shared_px"]
    scale = float(noise["scale"])
    sigma, correlation = DEFAULT_NOISE.sigma_px, DEFAULT_NOISE.correlation
    table = file.parent / OBSERVATIONS_NAME
    if table.is_file():
        rows = read_table(table, "table", "outline", OUTLINE_COLUMNS)
        used = np.array([verdict == "used" for verdict in rows.text("verdict")])
        s00, s01, s11 = (rows.number(name)[used] for name in ("s00", "s01", "s11"))
        ends = np.stack([rows.number(n)[used] for n in ("u0", "v0", "u1", "v1")], axis=-1)
        length = np.linalg.norm(ends[:, 2:] - ends[:, :2], axis=1)
        if len(length):
            variance = 0.5 * (s00 + s11)
            sigma = scale * float(np.median(np.sqrt(variance * length / 4.0)))
            correlation = float(np.median(s01 / variance))
    shared = tuple(float(common.get(kind, 0.0)) for kind in KINDS)
    # With few images, errors at places appear as bias and tilt of single outlines.
    single_edges = float(noise["bias_px"]), float(noise["tilt_px"])
    at_places = (float(common.get(kind, 0.0)) for kind in PLACES)
    places = tuple(max(both) for both in zip(single_edges, at_places, strict=True))
    gamma = 0.0 if not any(shared) else DEFAULT_NOISE.gamma_px
    return PredictedNoise(sigma, max(min(correlation, 0.9), -0.9), shared, places, gamma, str(file))
