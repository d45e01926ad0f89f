"""The benchmark bound: designs, their bound, sessions, statistics."""

import bound as bound_study
import numpy as np
import pytest
from bound import BoundStudy, errors_of
from outline_bound import Bound, bound_of
from outline_sessions import MACHINES, Noise, design_of, draw_session, one_fit
from outline_study import Found
from thinned import thinned

from legcal.machine.parameters import vector_of
from legcal.simulation.paper import Record

NOISE = Noise()
N_POSES = 5


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


@pytest.mark.parametrize("machine", thinned(MACHINES, ["3-rpr"]))
def test_the_fit_of_every_class_states_the_bound(machine: str) -> None:
    design = design_of(machine, 3, N_POSES, NOISE.sigma_px)
    bound = bound_of(design, NOISE.sigma_q, NOISE.radius_sigma)
    session = draw_session(design, NOISE, BoundStudy.errors, np.random.default_rng(0))
    solution = one_fit(session, NOISE.radius_sigma)
    errors = errors_of(design, session, solution)
    error, of_sigma = np.array(errors["error"]), np.array(errors["of_sigma"])
    stated = error / of_sigma  # hardly changed by where axes count from
    kinematic = [not name.split(".")[1].endswith("axis") for name in bound.names]
    ratio = np.abs(stated / bound.sigma)[kinematic]
    # The noise is estimated from few outlines, which leave open what they may share.
    assert np.all((ratio > 0.8) & (ratio < 1.5))
    assert np.sqrt(np.mean((error / bound.sigma) ** 2)) < 2.0
    assert 0.3 < errors["nse"] < 2.0
    true = design.legs.nominal
    start, found, truth = (
        vector_of(design.parametrization, legs, true)
        for legs in (session.legs.nominal, solution.legs, true)
    )
    assert np.linalg.norm(found - truth) < 0.05 * np.linalg.norm(start - truth)


@pytest.mark.system
def test_motors_that_turn_know_their_size_as_well_as_the_mean_of_the_radii() -> None:
    design, relative = design_of("delta", 3, 6, Noise().sigma_px), 0.02
    bound = bound_of(design, Noise().sigma_q, relative)
    sigma = dict(zip(bound.names, np.sqrt(np.diagonal(bound.covariance)), strict=True))
    wanted = relative / np.sqrt(len(design.parts))
    for leg, name in zip(design.legs.nominal, design.legs.names, strict=True):
        assert sigma[f"{name}.length"] / leg.q0 == pytest.approx(wanted, rel=1e-3)
