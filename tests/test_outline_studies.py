"""The benchmarks bound, convergence and classes: designs, their bound, sessions, statistics."""

import dataclasses
import io
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TypeVar, cast

import bound as bound_study
import classes_study
import convergence as convergence_study
import numpy as np
import outline_study
import pytest
from bound import BoundStudy, errors_of
from classes_study import FIT, ClassesStudy, as_stated, errors_of_fit, standing_where_held
from convergence import ConvergenceStudy
from fit_sessions import machine_session, shown_outlines
from hypothesis import given, settings
from hypothesis import strategies as st
from machine_kinds import normalised_error
from outline_bound import Bound, Determined, at_best, band_of_ratio, bound_of
from outline_sessions import (
    MACHINES,
    SHIPPED,
    Design,
    Noise,
    OutlineSession,
    StartErrors,
    closed_poses,
    design_of,
    draw_session,
    one_fit,
)
from outline_study import (
    Found,
    OutlineStudy,
)
from parameter_steps import written_with
from rich.console import Console
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import Start
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.equations import pose_equations
from legcal.machine.files import shipped_names
from legcal.machine.kinematics import platform_in_base
from legcal.machine.leg import Leg, LegKind
from legcal.machine.loader import load_mechanism
from legcal.machine.parameters import parametrization_of, vector_of
from legcal.simulation.paper import nominal_start
from legcal.simulation.study import Record, child_seed, run_study

NOISE = Noise()
N_POSES = 5
FAR = ConvergenceStudy.errors
FREE_3_UPU = 7  # turns of both axes of a leg at once (six), and its size
S = TypeVar("S", bound=OutlineStudy)
FAILED: Record = {"failure": {"kind": "DidNotConverge", "message": "It still fell."}}
PLATFORM = {"dX": 2e-3, "dE": 0.01}


def _quick(kind: type[S]) -> S:
    """Return a study of few poses of the machine that is quickest to fit."""
    return kind(("3-rpr",), n_poses=N_POSES)


def _design(machine: str) -> Design:
    return design_of(machine, 3, N_POSES, NOISE.sigma_px)


def _bound(machine: str) -> Bound:
    return bound_of(_design(machine), NOISE.sigma_q, NOISE.radius_sigma)


def _session(
    machine: str, errors: StartErrors = BoundStudy.errors, seed: int = 0
) -> OutlineSession:
    return draw_session(_design(machine), NOISE, errors, np.random.default_rng(seed))


def _printed(table: object) -> str:
    told = io.StringIO()
    Console(file=told, width=80).print(table)
    return told.getvalue()


# Statistics of estimators that are drawn


def _correlated(n: int = 30) -> Bound:
    """Return a bound of parameters that depend on each other and have various sizes."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(n, n)) * np.geomspace(1.0, 0.05, n)
    scale = np.geomspace(1e-6, 1e-3, n)
    covariance = root @ root.T * np.outer(scale, scale)
    return Bound(tuple(f"x{i}" for i in range(n)), ("m",) * n, covariance)


def _of_bound(
    n_runs: int,
    *,
    worse: float = 1.0,
    stated: float = 1.0,
    bias: float = 0.0,
    failures: int = 0,
    seed: int = 0,
) -> Found:
    """Return the statistics of a Gaussian estimator, so many times worse than the bound."""
    bound, rng = _correlated(), np.random.default_rng(seed)
    root, inverse = np.linalg.cholesky(bound.covariance), np.linalg.inv(bound.covariance)
    n, records = len(bound.names), [FAILED] * failures
    for _ in range(n_runs):
        error = worse * root @ rng.normal(size=n)
        error[3] += bias * bound.sigma[3]
        records.append(
            {
                "error": error.tolist(),
                "of_sigma": (error / bound.sigma / stated).tolist(),
                "nse": float(error @ inverse @ error) / n / stated**2,
            }
        )
    return bound_study.judged("synthetic", bound, records)


def _of_classes(n_runs: int, *, worse: float = 1.0, stated: float = 1.0) -> Found:
    """Return the same of the study of classes, of 12 directions out of 15."""
    rng, rank, records = np.random.default_rng(0), 12, []
    for _ in range(n_runs):
        z = worse * rng.normal(size=rank)
        fit = {"nse": float(z @ z) / rank / stated**2, "of_bound": float(z @ z) / rank}
        fit |= {"rank": rank, "of_sigma": (z / stated).tolist()}
        records.append({**_record(), FIT: {**PLATFORM, **fit}})
    return classes_study.judged("synthetic", 15, records)


def _record(seed: int = 0) -> Record:
    """Return a record of the study of classes, whose printed steps failed."""
    z = np.random.default_rng(seed).normal(size=12)
    nse = float(z @ z) / 12
    fit = {"rank": 12, "nse": nse, "of_bound": nse, "of_sigma": z.tolist()}
    return {
        "nominal": PLATFORM,
        "literal": {"failure": {"kind": "NotIdentifiable", "message": "No leg turns."}},
        "default": {"dX": 1e-3, "dE": 0.02},
        FIT: {"dX": 1e-5, "dE": 1e-4, **fit},
    }


def _missed(figures: dict[str, dict[str, bool]]) -> set[str]:
    return {name for name, figure in figures.items() if not figure["met"]}


@pytest.mark.parametrize(
    ("worse", "stated", "missed"),
    [
        (0.0, 0.0, set()),
        (1.0, 1.0, {"ratio"}),
        (0.0, -1.0, {"nse", "coverage"}),
        (0.0, 1.0, {"nse", "coverage"}),
    ],
)
def test_an_estimator_at_the_bound_meets_all_limits_and_one_a_few_percent_off_does_not(
    worse: float, stated: float, missed: set[str]
) -> None:
    bound = _of_bound(2000, worse=1.0 + 0.05 * worse, stated=1.0 + 0.05 * stated)
    classes = _of_classes(400, worse=1.0 + 0.15 * worse, stated=1.0 + 0.15 * stated)
    assert (classes["rank"], classes["of"]) == (12, 15)
    for found, figures, atol in (
        (bound, bound["pooled"], 0.01),
        (classes, classes["figures"], 0.03),
    ):
        assert found["met"] == (not missed)
        assert _missed(figures) == missed
        if not missed:
            values = [figures[name]["value"] for name in ("ratio", "nse", "coverage")]
            assert np.allclose(values, [1.0, 1.0, 0.95], atol=atol)


def test_a_bias_of_half_a_sigma_is_told_by_its_parameter_and_a_failed_run_is_counted() -> None:
    biased, failed = _of_bound(2000, bias=0.5), _of_bound(2000, failures=1)
    assert [row["name"] for row in biased["parameters"] if row["outside_band"]] == ["x3"]
    assert failed["failures"] == {"DidNotConverge": 1}
    assert failed["runs"] == 2000
    assert not biased["met"]
    assert not failed["met"]


def test_one_ratio_in_a_thousand_is_outside_the_band() -> None:
    rng = np.random.default_rng(0)
    low, high = band_of_ratio(20)
    ratios = np.sqrt(np.mean(rng.normal(size=(200_000, 20)) ** 2, axis=1))
    outside = np.mean((ratios < low) | (ratios > high))
    assert 0.0007 < outside < 0.0013  # four standard deviations of this count
    assert low < 1.0 < high


def test_few_runs_are_judged_by_chance_and_say_so() -> None:
    studies = [_of_bound(40, seed=seed)["pooled"] for seed in range(50)]
    assert all(studies[0][name]["limits_of_chance"] for name in ("nse", "coverage"))
    assert np.mean([not _missed(figures) for figures in studies]) >= 0.98
    assert not _of_bound(40, worse=1.3, stated=1.3)["met"]
    assert not _of_bound(40, stated=0.7)["met"]
    assert not _of_bound(0, failures=3)["met"]


def test_means_leave_out_sessions_that_failed_and_tell_how_many_and_why() -> None:
    records = [*map(_record, range(3)), {**_record(3), "default": FAILED}]
    found = classes_study.judged("synthetic", 12, records)
    steps = found["estimators"]["default"]
    assert (steps["runs"], steps["failures"]) == (3, {"DidNotConverge": 1})
    assert (steps["dX_mm"], steps["dE_deg"]) == pytest.approx((1.0, np.rad2deg(0.02)))
    assert found["estimators"]["literal"]["dX_mm"] is None
    assert found["met"]  # the steps may fail; the fit may not
    told = _printed(ClassesStudy().table([found]))
    for words in ("failed (4)", "1.00 1.15 (1)", "No leg turns.", "It still fell.", "Machines:"):
        assert words in told
    records.append({**_record(), FIT: FAILED})
    assert not classes_study.judged("synthetic", 12, records)["met"]
    found = classes_study.judged("synthetic", 12, [{**_record(), FIT: FAILED}])
    assert found["estimators"][FIT]["dX_mm"] is None
    assert not found["met"]
    assert "all failed" in _printed(ClassesStudy().table([found]))


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 12))
@settings(max_examples=25, deadline=None)
def test_the_normalised_squared_error_is_one_by_mean_and_the_same_in_any_units(
    seed: int, n: int
) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) * np.geomspace(1e-3, 1e-6, n)
    covariance, scale = root @ root.T, np.geomspace(1e-3, 1e3, n)
    scaled = covariance * np.outer(scale, scale)
    z = rng.normal(size=n)
    nse = Determined(np.eye(n), covariance).nse(root @ z)
    assert nse == pytest.approx(z @ z / n, rel=1e-4)
    assert Determined(np.eye(n), scaled).nse(scale * (root @ z)) == pytest.approx(nse, rel=1e-4)
    assert Determined(np.diag(scale), scaled).nse(root @ z) == pytest.approx(nse, rel=1e-4)


# Designs, their bound and sessions


@pytest.mark.parametrize("machine", thinned(MACHINES, ["3-upu-tilted", "3-rpr"]))
def test_the_fit_of_every_class_states_the_bound(machine: str) -> None:
    design, bound, session = _design(machine), _bound(machine), _session(machine)
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


def test_the_bound_is_as_large_as_the_noise() -> None:
    design = _design("3-rpr")
    worse = dataclasses.replace(design.outlines, covariance=4.0 * design.outlines.covariance)
    once = bound_of(design, 2e-6, 0.02)
    doubled = bound_of(dataclasses.replace(design, outlines=worse), 4e-6, 0.04)
    assert np.allclose(doubled.covariance, 4.0 * once.covariance, rtol=1e-6)
    assert np.all(bound_of(design, 2e-5, 0.02).sigma > once.sigma * (1.0 - 1e-9))


def test_motors_that_turn_know_their_size_as_well_as_the_mean_of_the_radii() -> None:
    design, relative = design_of("delta", 3, 6, Noise().sigma_px), 0.02
    bound = bound_of(design, Noise().sigma_q, relative)
    sigma = dict(zip(bound.names, np.sqrt(np.diagonal(bound.covariance)), strict=True))
    wanted = relative / np.sqrt(len(design.parts))
    for leg, name in zip(design.legs.nominal, design.legs.names, strict=True):
        assert sigma[f"{name}.length"] / leg.q0 == pytest.approx(wanted, rel=1e-3)


def test_a_bound_of_too_little_data_and_legs_that_meet_nowhere_are_refused() -> None:
    with pytest.raises(NotIdentifiable, match="do not determine"):
        bound_of(design_of("3-rpr", 1, 1, NOISE.sigma_px), 2e-6, 0.02)
    design = _design("3-rpr")
    rods = [dataclasses.replace(leg, kind=LegKind.CONSTANT, q0=5.0) for leg in design.legs.nominal]
    with pytest.raises(DidNotConverge, match="could not be closed"):
        closed_poses(rods, design.legs.frame_legs, design.R, design.t)


@pytest.mark.parametrize("machine", MACHINES[1:])
def test_a_true_machine_stands_where_its_legs_allow(machine: str) -> None:
    design = _design(machine)
    found = pose_equations(design.legs.nominal, design.R, design.t, by_local=False)
    assert np.abs(found.of(~found.measured).values).max(initial=0.0) < 1e-12
    assert np.allclose(_lengths(design), _read(design), rtol=0.0, atol=1e-12)
    most = 4 if machine.startswith("6-spu") else 3
    images = np.unique(np.column_stack([design.outlines.row, design.outlines.leg]), axis=0)
    assert max(np.bincount(images[:, 0])) == most


def _lengths(design: Design) -> np.ndarray:
    """Return the lengths of all legs at all poses."""
    legs = design.legs.nominal
    ends = np.array([leg.B for leg in legs]) @ np.swapaxes(design.R, 1, 2) + design.t[:, None]
    return np.asarray(np.linalg.norm(ends - np.array([leg.A for leg in legs]), axis=-1))


def _read(design: Design) -> np.ndarray:
    """Return the lengths that readings tell."""
    q0 = np.array([leg.q0 for leg in design.legs.nominal])
    return np.asarray(design.legs.sign * design.q + q0)


def test_noise_of_sessions_has_the_covariance_that_outlines_carry() -> None:
    design = _design("3-rpr")
    exact, offsets, readings = design.outlines, [], []
    for seed in range(40):
        session = _session("3-rpr", seed=seed)
        xy = design.camera.undistort(session.outlines.ends)
        offsets.append(design.camera.line_offset(exact.h[:, None], xy))
        readings.append(session.measurements.q - design.q[design.pose])
    root = np.linalg.cholesky(exact.covariance)
    white = np.linalg.solve(root, np.array(offsets)[..., None])[..., 0].reshape(-1, 2)
    assert np.allclose(white.T @ white / len(white), np.eye(2), atol=0.05)
    assert np.std(readings) == pytest.approx(NOISE.sigma_q, rel=0.05)
    assert np.array_equal(design.outlines.covariance, session.outlines.covariance)


def _turn(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


@pytest.mark.parametrize(("errors", "least"), [(FAR, 1.0), (BoundStudy.errors, 0.0)])
def test_what_a_fit_starts_from_is_as_wrong_as_is_said(errors: StartErrors, least: float) -> None:
    design = _design("3-upu-tilted")
    session = _session("3-upu-tilted", errors)
    lengths, turns = [], []
    for nominal, true in zip(session.legs.nominal, design.legs.nominal, strict=True):
        lengths.append(np.abs([*(nominal.A - true.A), *(nominal.B - true.B), nominal.q0 - true.q0]))
        for name in ("base_axis", "platform_axis"):
            turns.append(_turn(getattr(nominal, name), getattr(true, name)))
    shifts, cameras = [], []
    for view, T in zip(session.measurements.views, design.T_Rb_camera, strict=True):
        assert view.T_base_camera is not None
        shifts.append(np.linalg.norm(view.T_base_camera.translation - T.translation))
        cameras.append((view.T_base_camera * T.inv()).rotation.magnitude())
    for found, size, most in (
        (np.array(lengths)[np.array(lengths) > 0.0], errors.length, 1.0),
        (turns, errors.angle, 1.5),
        (shifts, errors.camera_shift, 1.0),
        (cameras, errors.camera_turn, 1.0),
    ):
        assert least * size * (1.0 - 1e-9) <= np.min(found)
        assert np.max(found) <= most * size * (1.0 + 1e-9)


@pytest.mark.parametrize("machine", ["6-spu-coplanar", "3-upu-tilted"])
def test_the_start_is_the_nominal_model_at_the_readings(machine: str) -> None:
    design, session = _design(machine), _session(machine)
    nominal = session.legs.nominal
    start = nominal_start(session.legs, session.measurements, RigidTransform.identity())
    assert start.legs == nominal
    q = session.measurements.q_of_poses
    lengths = session.legs.sign * q + np.array([leg.q0 for leg in nominal])
    A, B = (np.array([getattr(leg, name) for leg in nominal]) for name in "AB")
    found = np.array([np.linalg.norm(T.apply(B) - A, axis=1) for T in start.T_Rb_Re])
    missed = np.abs(found - lengths).max(axis=1)
    assert np.mean(missed < 1e-9) > 0.6  # of the poses; others are beyond the nominal model
    away = [np.linalg.norm(T.translation - t) for T, t in zip(start.T_Rb_Re, design.t, strict=True)]
    assert 1e-4 < np.median(away) < 0.02  # neither the truth nor another assembly mode


# A machine of which some directions stay open


@pytest.fixture(scope="module")
def open_machine() -> tuple[Design, OutlineSession, Solution]:
    """Return a session of a 3-UPU that only translates, and its fit."""
    exact, machine = machine_session("3-upu"), load_mechanism("3-upu")
    R, t = components(exact.truth.T_Rb_Re)
    design = Design(
        legs=dataclasses.replace(exact.legs, nominal=exact.truth.legs),
        home=platform_in_base(machine, machine.home),
        R=np.asarray(R),
        t=np.asarray(t),
        q=exact.measurements.q,
        camera=exact.measurements.views[0].camera,
        T_Rb_camera=tuple(T.inv() for T in exact.truth.T_camera_Rb),
        seen=(None,) * len(exact.measurements.views),
        view=exact.measurements.view,
        pose=exact.measurements.pose,
        outlines=exact.outlines,
    )
    session = draw_session(design, NOISE, BoundStudy.errors, np.random.default_rng(4))
    return design, session, one_fit(session, NOISE.radius_sigma)


def test_the_machine_that_stands_where_the_fit_holds_shows_the_same_as_the_true_one(
    open_machine: tuple[Design, OutlineSession, Solution],
) -> None:
    design, session, _ = open_machine
    there = standing_where_held(*open_machine)
    true = design.legs.nominal
    xi, truth = (vector_of(design.parametrization, d.legs.nominal, true) for d in (there, design))
    assert np.abs(xi - truth).max() > 1e-3  # far off, in what nothing shows
    cameras = tuple(T.inv() for T in there.T_Rb_camera)
    stands = Start(there.legs.nominal, cameras, there.poses, "there")
    shown = shown_outlines(there.legs.radii, session.measurements, stands)
    ends = design.camera.undistort(design.outlines.ends)
    assert np.abs(design.camera.line_offset(shown.h[:, None], ends)).max() < 1e-7  # [px]
    assert np.abs(_lengths(there) - _read(there)).max() < 1e-10


def test_errors_along_what_is_held_do_not_count(
    open_machine: tuple[Design, OutlineSession, Solution],
) -> None:
    design, session, solution = open_machine
    stated = as_stated(design, solution)
    n = len(design.parametrization)
    assert (stated.rank, len(solution.kinematic.held_basis)) == (n - FREE_3_UPU, FREE_3_UPU)
    _, held = solution.kinematic.of_values(design.parametrization.names)
    error = np.random.default_rng(0).normal(size=n) * 1e-4
    nse = stated.nse(error)
    assert stated.nse(error + 0.01 * held.sum(axis=0)) == pytest.approx(nse, rel=1e-6)
    assert stated.nse(error + 1e-4 * stated.parts.sum(axis=0)) > 1.5 * nse
    errors = errors_of_fit(design, session, solution, NOISE)
    assert errors["rank"] == n - FREE_3_UPU
    assert 0.2 < errors["nse"] < 2.5
    assert 0.2 < errors["of_bound"] < 2.5
    assert len(errors["of_sigma"]) == 3  # offsets


def test_the_bound_of_what_is_determined_is_the_bound_where_nothing_is_open() -> None:
    design, whole = _design("3-rpr"), _bound("3-rpr")
    best, n = at_best(design, NOISE.sigma_q, NOISE.radius_sigma), len(design.parametrization)
    np.testing.assert_allclose(
        np.linalg.inv(best.parts) @ best.covariance @ np.linalg.inv(best.parts.T),
        whole.covariance[:n, :n],
        rtol=1e-6,
        atol=1e-18,
    )
    fewer = at_best(design, NOISE.sigma_q, NOISE.radius_sigma, n_held=2)
    assert fewer.rank == n - 2
    # What is known best is known no worse where something else is held.
    inside = np.linalg.inv(fewer.parts @ whole.covariance[:n, :n] @ fewer.parts.T)
    assert np.all(
        np.linalg.eigvalsh(np.linalg.inv(fewer.covariance) - inside) > -1e-3 * inside[0, 0]
    )


# Runs


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the studies of bound and classes once, with a few runs."""
    folder = tmp_path_factory.mktemp("study")
    run_study(_quick(BoundStudy), 3, output=folder / "bound")
    run_study(_quick(ClassesStudy), 2, output=folder / "classes")
    return folder


def test_the_study_of_the_bound_has_a_row_for_every_parameter(output: Path) -> None:
    document = json.loads((output / "bound" / "study.json").read_bytes())
    (found,) = document["machines"]
    assert (found["machine"], found["runs"], found["failed"]) == ("3-rpr", 3, 0)
    assert [row["name"] for row in found["parameters"]] == list(_design("3-rpr").names)
    assert found["pooled"].keys() == {"ratio", "nse", "coverage"}
    assert all(figure["limits_of_chance"] for figure in found["pooled"].values())
    page = (output / "bound" / "bound.md").read_text()
    assert all(f"| {name} |" in page for name in _design("3-rpr").names)
    told = _printed(BoundStudy().table([found]))
    assert "…" not in told
    assert all(words in told for words in ("each/bound", "3 runs are too few", "at the bound"))


def test_the_study_of_classes_compares_nominal_model_steps_and_fit(output: Path) -> None:
    document = json.loads((output / "classes" / "study.json").read_bytes())
    (found,) = document["machines"]
    assert (found["machine"], found["rank"], found["of"]) == ("3-rpr", 9, 9)
    by = found["estimators"]
    assert all(by[name]["runs"] == 2 for name in ("nominal", "literal", "default", "fit"))
    assert by["nominal"]["dX_mm"] > 20.0 * by["fit"]["dX_mm"]
    assert by["literal"]["dX_mm"] != by["default"]["dX_mm"]
    assert found["figures"].keys() == {"ratio", "nse", "coverage"}
    page = (output / "classes" / "classes.md").read_text()
    assert page.count("| 3-rpr |") == 3
    told = _printed(ClassesStudy().table([found]))
    assert "…" not in told
    assert "determined" in told
    assert all("2 runs are too few" in text for text in (page, told))


def test_the_session_of_a_machine_does_not_depend_on_the_others(output: Path) -> None:
    line = json.loads((output / "bound" / "runs.jsonl").read_text().splitlines()[2])
    both = BoundStudy(("3-upu-tilted", "3-rpr"), n_poses=N_POSES)
    record = both.one_run(child_seed(0, 1))
    assert record["3-rpr"] == line["record"]["3-rpr"]


def test_a_step_or_a_fit_that_fails_is_counted_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def steps_fail(session: OutlineSession, criteria: str) -> tuple[Leg, ...]:
        raise NotIdentifiable(f"Nothing is determined by the {criteria} steps.")

    def fit_fails(session: OutlineSession, radius_sigma: float) -> Solution:
        raise DidNotConverge("It did not.")

    for module, study in (
        (bound_study, _quick(BoundStudy)),
        (convergence_study, _quick(ConvergenceStudy)),
    ):
        monkeypatch.setattr(module, "one_fit", fit_fails)
        result = run_study(study, 2)
        (found,) = result.document()["machines"]
        assert not found["met"]
        assert 2 in (found.get("refused"), found.get("failed"))
        assert "DidNotConverge" in _printed(study.table(result.document()["machines"]))
    monkeypatch.setattr(classes_study, "staged_legs", steps_fail)
    monkeypatch.setattr(classes_study, "one_fit", fit_fails)
    classes = _quick(ClassesStudy)
    result = run_study(classes, 2)
    (found,) = result.document()["machines"]
    assert found["estimators"][FIT]["failures"] == {"DidNotConverge": 2}
    assert found["estimators"]["nominal"]["runs"] == 2
    told = " ".join(_printed(classes.table(result.document()["machines"])).split())
    assert "failed in 2 of 2 sessions with NotIdentifiable, the first time: Nothing" in told


def test_a_parameter_that_was_not_estimated_is_a_failure() -> None:
    design, session = _design("3-rpr"), _session("3-rpr")
    solution = one_fit(session, NOISE.radius_sigma)
    status = {**solution.estimates.status, "leg1.offset": "weak"}
    found = dataclasses.replace(solution.estimates, status=status)
    held = dataclasses.replace(solution, estimates=found)
    with pytest.raises(NotIdentifiable, match=r"leg1\.offset"):
        errors_of(design, session, held)


def test_convergence_counts_the_truth_as_right_and_another_answer_as_wrong(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    study = _quick(ConvergenceStudy)
    result = run_study(study, 2, output=tmp_path / "out")
    (found,) = result.document()["machines"]
    assert (found["right"], found["wrong"], found["refused"]) == (2, 0, 0)
    assert found["met"]
    assert 0.0 < found["worst_sigma"] <= 5.0
    assert found["before"]["dX_mm"] > 50.0 * found["after"]["dX_mm"]
    assert found["after"]["dX_mm"] < 5.0 * found["predicted"]["dX_mm"]
    told = _printed(study.table(result.document()["machines"]))
    assert "1 sigma" in told
    assert "…" not in told

    def shifted(session: OutlineSession, radius_sigma: float) -> Solution:
        solution = one_fit(session, radius_sigma)
        legs = tuple(dataclasses.replace(leg, q0=leg.q0 + 1e-3) for leg in solution.legs)
        values = {
            name: value + 1e-3 * name.endswith("offset")
            for name, value in solution.estimates.values.items()
        }
        estimates = dataclasses.replace(solution.estimates, values=values)
        return dataclasses.replace(solution, legs=legs, estimates=estimates)

    monkeypatch.setattr(convergence_study, "one_fit", shifted)
    (found,) = run_study(study, 1).document()["machines"]
    assert (found["right"], found["wrong"], found["met"]) == (0, 1, False)


# Commands


def test_every_shipped_model_is_a_machine_of_the_study_of_classes() -> None:
    assert sorted(SHIPPED) == shipped_names()


@pytest.mark.parametrize(
    ("study", "words", "message"),
    [
        (BoundStudy, ["--machine", "4-rpr"], "found the machines 4-rpr, needed some of 6-spu"),
        (BoundStudy, ["--machine", "3-rpr"] * 2, "each once"),
        (ConvergenceStudy, ["--machine", "hexapod"], "found the machines hexapod"),
    ],
)
def test_wrong_use_of_a_benchmark_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    study: type[OutlineStudy],
    words: list[str],
    message: str,
) -> None:
    monkeypatch.setattr(sys, "argv", ["study", *words])
    assert outline_study.run(study, "A study.") == 2
    assert message in capsys.readouterr().err


def test_normalised_errors_of_axes_count_from_the_nominal_ones(tmp_path: Path) -> None:
    nominal = load_mechanism("3-rps")
    found, rng = parametrization_of(nominal), np.random.default_rng(2)
    step = np.where([unit == "rad" for unit in found.units], 0.01, 2e-3)
    away = step * rng.uniform(-1.0, 1.0, len(found))
    sigma = 1e-3 * step
    sigma[0] = 0.0  # a parameter that is held
    error = sigma * rng.normal(size=len(found))
    written = [
        written_with(nominal, found, by, tmp_path / name).yaml_path
        for name, by in {"truth": away, "calibrated": away + error}.items()
    ]
    of_values = SimpleNamespace(parametrization=found, value_covariance=np.diag(sigma**2))
    solution = SimpleNamespace(kinematic=of_values)
    stated = normalised_error(nominal, written[1], written[0], cast(Solution, solution))
    assert stated == pytest.approx(np.mean((error[1:] / sigma[1:]) ** 2), rel=1e-6)
