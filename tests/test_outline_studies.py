"""The benchmark bound: designs, their bound, sessions, statistics."""

import bound as bound_study
import numpy as np
import pytest
from outline_bound import Bound, bound_of
from outline_sessions import Noise, design_of
from outline_study import Found

from legcal.simulation.paper import Record

FAILED: Record = {"failure": {"kind": "DidNotConverge", "message": "It still fell."}}


# Statistics of estimators that are drawn


def _correlated() -> Bound:
    """Return a bound of parameters that depend on each other and have various sizes."""
    n, rng = 30, np.random.default_rng(1)
    root = rng.normal(size=(n, n)) * np.geomspace(1.0, 0.05, n)
    scale = np.geomspace(1e-6, 1e-3, n)
    covariance = root @ root.T * np.outer(scale, scale)
    return Bound(tuple(f"x{i}" for i in range(n)), ("m",) * n, covariance)


def _of_bound(*, bias: float = 0.0, failures: int = 0) -> Found:
    """Return the statistics of a Gaussian estimator at the bound."""
    bound, rng = _correlated(), np.random.default_rng(0)
    root, inverse = np.linalg.cholesky(bound.covariance), np.linalg.inv(bound.covariance)
    n, records = len(bound.names), [FAILED] * failures
    for _ in range(2000):
        error = root @ rng.normal(size=n)
        error[3] += bias * bound.sigma[3]
        nse = float(error @ inverse @ error) / n
        of_sigma = (error / bound.sigma).tolist()
        records.append({"error": error.tolist(), "of_sigma": of_sigma, "nse": nse})
    return bound_study.judged("synthetic", bound, records)


def test_a_bias_of_half_a_sigma_is_told_by_its_parameter_and_a_failed_run_is_counted() -> None:
    biased, failed = _of_bound(bias=0.5), _of_bound(failures=1)
    assert [row["name"] for row in biased["parameters"] if row["outside_band"]] == ["x3"]
    assert failed["failures"] == {"DidNotConverge": 1}
    assert failed["runs"] == 2000
    assert _of_bound()["met"]
    assert not biased["met"]
    assert not failed["met"]


# Designs, their bound and sessions


@pytest.mark.system
def test_motors_that_turn_know_their_size_as_well_as_the_mean_of_the_radii() -> None:
    design, relative = design_of("delta", 3, 6, Noise().sigma_px), 0.02
    bound = bound_of(design, Noise().sigma_q, relative)
    sigma = dict(zip(bound.names, np.sqrt(np.diagonal(bound.covariance)), strict=True))
    wanted = relative / np.sqrt(len(design.parts))
    for leg, name in zip(design.legs.nominal, design.legs.names, strict=True):
        assert sigma[f"{name}.length"] / leg.q0 == pytest.approx(wanted, rel=1e-3)
