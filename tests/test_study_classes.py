"""The study of the classes: errors on what is determined, statistics, tables, and the command."""

import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from machine_session import machine_session, shown_outlines
from rich.console import Console
from test_cli import run

from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.state import Start
from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry import components, motions_of
from legcal.machine import LegGeometry, load_mechanism, platform_in_base, vector_of
from legcal.machine.files import shipped_names
from legcal.simulation.studies import classes
from legcal.simulation.studies.bound import ERRORS
from legcal.simulation.studies.classes import CLASSES as EXPERIMENT
from legcal.simulation.studies.classes import (
    FIT,
    ClassesJudge,
    ClassStatistics,
    ClassTally,
    FitErrors,
    errors_of_fit,
    fit_record,
)
from legcal.simulation.studies.outlines import (
    SHIPPED,
    Determined,
    OutlineDesign,
    OutlineExperiment,
    OutlineSession,
    OutlineStudy,
    as_stated,
    at_best,
    bound_of,
    draw_session,
    one_fit,
    standing_where_held,
)
from legcal.simulation.studies.runner import Record, run_study

FREE_3_UPU = 7  # turns of both axes of a leg at once (six), and its size
NOISE = EXPERIMENT.noise
QUICK = dataclasses.replace(EXPERIMENT, machines=("3-rpr",), n_poses=5)
PLATFORM = {"dX": 2e-3, "dE": 0.01}


def _covariance(seed: int, n: int) -> np.ndarray:
    """Return a covariance of errors of various sizes that depend on each other."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) * np.geomspace(1e-3, 1e-6, n)
    return np.asarray(root @ root.T)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 12))
@settings(max_examples=25, deadline=None)
def test_the_normalised_squared_error_is_the_same_in_any_units(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    covariance, error = _covariance(seed, n), rng.normal(size=n) * 1e-4
    nse = Determined(np.eye(n), covariance).nse(error)
    scale = np.geomspace(1e-3, 1e3, n)
    scaled = Determined(np.eye(n), covariance * np.outer(scale, scale)).nse(scale * error)
    assert scaled == pytest.approx(nse, rel=1e-4)
    assert Determined(np.diag(scale), covariance * np.outer(scale, scale)).nse(
        error
    ) == pytest.approx(nse, rel=1e-4)


def test_gaussian_errors_have_a_normalised_squared_error_of_one() -> None:
    covariance, rng = _covariance(0, 9), np.random.default_rng(0)
    determined = Determined(np.eye(9), covariance)
    root = np.linalg.cholesky(covariance)
    found = [determined.nse(root @ rng.normal(size=9)) for _ in range(4000)]
    assert np.mean(found) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 9 / 4000))


def _design(name: str) -> OutlineDesign:
    """Return a design of a few poses whose legs show all of their length; no rays are needed."""
    exact = machine_session(name)
    mechanism, (R, t) = load_mechanism(name), components(exact.truth.T_Rb_Re)
    return OutlineDesign(
        leg_names=exact.legs.names,
        legs=exact.truth.legs,
        sign=exact.legs.sign,
        frame_legs=exact.legs.frame_legs,
        radii=dict(exact.legs.radii),
        home=platform_in_base(mechanism, mechanism.home),
        R=R,
        t=t,
        q=exact.measurements.q,
        camera=exact.measurements.views[0].camera,
        T_Rb_camera=tuple(T.inv() for T in exact.truth.T_camera_Rb),
        seen=(None,) * len(exact.measurements.views),
        view=exact.measurements.view,
        pose=exact.measurements.pose,
        outlines=exact.outlines,
    )


@pytest.fixture(scope="module")
def open_machine() -> tuple[OutlineDesign, OutlineSession, Solution]:
    """Return a session of a 3-UPU that only translates, and its fit."""
    design = _design("3-upu")
    session = draw_session(design, NOISE, ERRORS, np.random.default_rng(4))
    return design, session, one_fit(session, NOISE.radius_sigma)


def test_the_machine_that_stands_where_the_fit_holds_shows_the_same_as_the_true_one(
    open_machine: tuple[OutlineDesign, OutlineSession, Solution],
) -> None:
    design, session, _ = open_machine
    there = standing_where_held(*open_machine)
    xi, truth = (vector_of(design.parametrization, d.legs, design.legs) for d in (there, design))
    assert np.abs(xi - truth).max() > 1e-3  # far off, in what nothing shows
    cameras = tuple(T.inv() for T in there.T_Rb_camera)
    stands = Start(there.legs, cameras, motions_of(there.R, there.t), "there")
    shown = shown_outlines(there.radii, session.measurements, stands)
    ends = design.camera.undistort(design.outlines.ends)
    assert np.abs(design.camera.line_offset(shown.h[:, None], ends)).max() < 1e-7  # [px]
    length = np.linalg.norm(
        np.einsum("kij,lj->kli", there.R, [leg.B for leg in there.legs])
        + there.t[:, None]
        - [leg.A for leg in there.legs],
        axis=-1,
    )
    read = design.sign * design.q + np.array([leg.q0 for leg in there.legs])
    assert np.abs(length - read).max() < 1e-10


def test_errors_along_what_is_held_do_not_count(
    open_machine: tuple[OutlineDesign, OutlineSession, Solution],
) -> None:
    design, session, solution = open_machine
    stated = as_stated(design, solution)
    n = len(design.parametrization)
    assert (stated.rank, len(solution.held_basis)) == (n - FREE_3_UPU, FREE_3_UPU)
    known = solution.parametrization.names
    held = solution.held_basis[:, [known.index(name) for name in design.parametrization.names]]
    error = np.random.default_rng(0).normal(size=n) * 1e-4
    nse = stated.nse(error)
    assert stated.nse(error + 0.01 * held.sum(axis=0)) == pytest.approx(nse, rel=1e-6)
    assert stated.nse(error + 1e-4 * stated.parts.sum(axis=0)) > 1.5 * nse
    errors = errors_of_fit(design, session, solution, NOISE)
    assert errors.rank == n - FREE_3_UPU
    assert 0.2 < errors.nse < 2.5
    assert 0.2 < errors.of_bound < 2.5
    assert len(errors.of_sigma) == 3  # offsets


def test_the_bound_of_what_is_determined_is_the_bound_where_nothing_is_open() -> None:
    design, noise = _design("3-rpr"), NOISE
    whole = bound_of(design, noise.sigma_q, noise.radius_sigma)
    best, n = at_best(design, noise.sigma_q, noise.radius_sigma), len(design.parametrization)
    np.testing.assert_allclose(
        np.linalg.inv(best.parts) @ best.covariance @ np.linalg.inv(best.parts.T),
        whole.covariance[:n, :n],
        rtol=1e-6,
        atol=1e-18,
    )
    fewer = at_best(design, noise.sigma_q, noise.radius_sigma, n_held=2)
    assert fewer.rank == n - 2
    # What is known best is known no worse where something else is held.
    inside = np.linalg.inv(fewer.parts @ whole.covariance[:n, :n] @ fewer.parts.T)
    assert np.all(
        np.linalg.eigvalsh(np.linalg.inv(fewer.covariance) - inside) > -1e-3 * inside[0, 0]
    )


def _record(seed: int = 0) -> Record:
    z = np.random.default_rng(seed).normal(size=12)
    errors = FitErrors(12, float(z @ z) / 12, float(z @ z) / 12, z)
    steps: Record = {"failure": {"kind": "NotIdentifiable", "message": "No leg turns."}}
    return {
        "nominal": PLATFORM,
        "literal": steps,
        "default": {"dX": 1e-3, "dE": 0.02},
        FIT: {"dX": 1e-5, "dE": 1e-4, **fit_record(errors)},
    }


def _statistics(n_runs: int, *, worse: float = 1.0, stated: float = 1.0) -> ClassStatistics:
    """Return the statistics of a Gaussian estimator, so many times worse than the bound."""
    tally, rng, rank = ClassTally("synthetic", 15), np.random.default_rng(0), 12
    for _ in range(n_runs):
        z = worse * rng.normal(size=rank)
        errors = FitErrors(rank, float(z @ z) / rank / stated**2, float(z @ z) / rank, z / stated)
        tally.add({**_record(), FIT: {**PLATFORM, **fit_record(errors)}})
    return tally.found()


def test_an_estimator_at_the_bound_meets_all_limits_and_is_judged_on_what_is_determined() -> None:
    found = _statistics(400)
    assert found.is_met
    assert (found.rank, found.of) == (12, 15)
    assert [figure.name for figure in found.figures] == ["ratio", "nse", "coverage"]
    assert np.allclose([figure.value for figure in found.figures], [1.0, 1.0, 0.95], atol=0.03)


@pytest.mark.parametrize(
    ("wrong", "missed"),
    [
        ({"worse": 1.15, "stated": 1.15}, {"ratio"}),
        ({"stated": 1.15}, {"nse", "coverage"}),
        ({"stated": 0.85}, {"nse", "coverage"}),
    ],
)
def test_sigmas_that_are_fifteen_percent_off_are_told(
    wrong: dict[str, float], missed: set[str]
) -> None:
    found = _statistics(400, **wrong)
    assert not found.is_met
    assert {figure.name for figure in found.figures if not figure.is_met} == missed


def test_means_leave_out_sessions_that_failed_and_tell_how_many_and_why() -> None:
    tally = ClassTally("synthetic", 12)
    for seed in range(3):
        tally.add(_record(seed))
    failed = {"failure": {"kind": "DidNotConverge", "message": "It still fell."}}
    tally.add({**_record(3), "default": failed})
    found = tally.found()
    steps = found.estimators["default"]
    assert (steps.n, steps.failures) == (3, {"DidNotConverge": 1})
    assert steps.platform == (1e-3, 0.02)
    assert found.estimators["literal"].platform is None
    assert found.is_met  # the steps may fail; the fit may not
    told = _printed(ClassesJudge().table([found], ["So it was."]))
    for words in ("failed (4)", "1.00 1.15 (1)", "No leg turns.", "It still fell.", "So it was."):
        assert words in told
    tally.add({**_record(), FIT: failed})
    assert not tally.found().is_met


def test_a_machine_of_which_every_fit_fails_is_told() -> None:
    tally = ClassTally("synthetic", 12)
    failed = {"failure": {"kind": "DidNotConverge", "message": "It still fell."}}
    tally.add({**_record(), FIT: failed})
    found = tally.found()
    assert not found.is_met
    assert found.document()["estimators"][FIT]["dX_mm"] is None
    assert "all failed" in _printed(ClassesJudge().table([found], []))


def _printed(table: object) -> str:
    told = io.StringIO()
    Console(file=told, width=80).print(table)
    return told.getvalue()


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the study once, with two runs of one machine."""
    folder = tmp_path_factory.mktemp("study") / "classes"
    run_study(OutlineStudy(ClassesJudge(), QUICK), 2, output=folder)
    return folder


def test_the_study_compares_nominal_model_steps_and_fit(output: Path) -> None:
    document = json.loads((output / "study.json").read_bytes())
    (found,) = document["machines"]
    assert (found["machine"], found["rank"], found["of"]) == ("3-rpr", 9, 9)
    by = found["estimators"]
    assert all(by[name]["runs"] == 2 for name in ("nominal", "literal", "default", "fit"))
    assert by["nominal"]["dX_mm"] > 20.0 * by["fit"]["dX_mm"]
    assert by["literal"]["dX_mm"] != by["default"]["dX_mm"]
    assert found["figures"].keys() == {"ratio", "nse", "coverage"}
    page = (output / "classes.md").read_text()
    assert page.count("| 3-rpr |") == 2
    assert "2 runs are too few" in page


def test_the_study_goes_on_where_it_was(output: Path) -> None:
    lines = (output / "runs.jsonl").read_text().splitlines(keepends=True)
    before = (output / "study.json").read_bytes()
    (output / "runs.jsonl").write_text("".join(lines[:2]))
    study = OutlineStudy(ClassesJudge(), QUICK)
    result = run_study(study, 2, output=output)
    assert (output / "runs.jsonl").read_text().splitlines(keepends=True) == lines
    assert (output / "study.json").read_bytes() == before
    assert "…" not in _printed(result.summary.table())
    record = json.loads(lines[1])["record"]
    assert study.is_record(record)
    found = record["3-rpr"]
    wrongs: tuple[object, ...] = (
        {},
        [],
        {**found, FIT: {**found[FIT], "of_sigma": []}},
        {**found, FIT: {**found[FIT], "nse": None}},
        {**found, "default": {"dX": 1.0}},
        {**found, "literal": {"failure": "x"}},
        {key: value for key, value in found.items() if key != "nominal"},
    )
    for wrong in wrongs:
        assert not study.is_record({"3-rpr": wrong})


def test_a_step_or_a_fit_that_fails_is_counted_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def steps_fail(session: OutlineSession, criteria: str) -> tuple[LegGeometry, ...]:
        raise NotIdentifiable(f"Nothing is determined by the {criteria} steps.")

    def fit_fails(session: OutlineSession, radius_sigma: float) -> Solution:
        raise DidNotConverge("It did not.")

    monkeypatch.setattr(classes, "staged_legs", steps_fail)
    monkeypatch.setattr(classes, "one_fit", fit_fails)
    result = run_study(OutlineStudy(ClassesJudge(), QUICK), 2)
    (found,) = result.document()["machines"]
    assert found["estimators"][FIT]["failures"] == {"DidNotConverge": 2}
    assert found["estimators"]["nominal"]["runs"] == 2
    told = " ".join(_printed(result.summary.table()).split())
    assert "failed in 2 of 2 sessions with NotIdentifiable, the first time: Nothing" in told


def test_every_shipped_model_is_a_machine_of_the_study() -> None:
    assert sorted(SHIPPED) == shipped_names()
    with pytest.raises(UsageError, match="6-spu-coplanar, needed some of hexapod, "):
        OutlineExperiment(EXPERIMENT.errors, ("6-spu-coplanar",), known=SHIPPED)


def test_a_machine_that_is_not_shipped_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "study", "classes", "--machine", "4-rpr") == 2
    assert "found the machines 4-rpr, needed some of hexapod" in capsys.readouterr().err
