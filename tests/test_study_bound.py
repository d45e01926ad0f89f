"""The studies of outlines: designs, their bound, sessions, statistics, and both commands."""

import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from test_cli import run
from thinned import thinned

from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.state import FittedLegs
from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.machine import LegKind, vector_of
from legcal.simulation.studies import bound as bound_study
from legcal.simulation.studies import convergence as convergence_study
from legcal.simulation.studies.bound import BoundJudge, BoundStatistics, BoundTally
from legcal.simulation.studies.convergence import ConvergenceJudge
from legcal.simulation.studies.outlines import (
    MACHINES,
    Bound,
    Noise,
    OutlineDesign,
    OutlineExperiment,
    OutlineSession,
    OutlineStudy,
    RunErrors,
    StartErrors,
    band_of_ratio,
    bound_of,
    design_of,
    draw_session,
    errors_of,
    errors_record,
    nominal_start,
    one_fit,
)
from legcal.simulation.studies.paper import closed_poses, unmeasured
from legcal.simulation.studies.runner import child_seed, run_study

NOISE = Noise()
N_POSES = 5
FAR = convergence_study.ERRORS
QUICK = ("3-rpr",)


def _design(machine: str) -> OutlineDesign:
    return design_of(machine, 3, N_POSES, NOISE.sigma_px)


def _bound(machine: str) -> Bound:
    return bound_of(_design(machine), NOISE.sigma_q, NOISE.radius_sigma)


def _session(
    machine: str, errors: StartErrors = bound_study.ERRORS, seed: int = 0
) -> OutlineSession:
    return draw_session(_design(machine), NOISE, errors, np.random.default_rng(seed))


def _small(errors: StartErrors, machines: tuple[str, ...] = QUICK) -> OutlineExperiment:
    return OutlineExperiment(errors, machines, n_poses=N_POSES)


def _correlated(n: int = 30) -> Bound:
    """Return a bound of parameters that depend on each other and have various sizes."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(n, n)) * np.geomspace(1.0, 0.05, n)
    scale = np.geomspace(1e-6, 1e-3, n)
    covariance = root @ root.T * np.outer(scale, scale)
    return Bound(tuple(f"x{i}" for i in range(n)), ("m",) * n, covariance)


def _statistics(
    n_runs: int,
    *,
    worse: float = 1.0,
    stated: float = 1.0,
    bias: float = 0.0,
    failures: int = 0,
    seed: int = 0,
) -> BoundStatistics:
    """Return the statistics of a Gaussian estimator, so many times worse than the bound."""
    bound, rng = _correlated(), np.random.default_rng(seed)
    root, inverse = np.linalg.cholesky(bound.covariance), np.linalg.inv(bound.covariance)
    tally, n = BoundTally("synthetic", bound), len(bound.names)
    for _ in range(n_runs):
        error = worse * root @ rng.normal(size=n)
        error[3] += bias * bound.sigma[3]
        nse = float(error @ inverse @ error) / n / stated**2
        tally.add(errors_record(RunErrors(error, error / bound.sigma / stated, nse)))
    for _ in range(failures):
        tally.add({"failure": {"kind": "DidNotConverge", "message": "It did not."}})
    return tally.found()


def test_an_estimator_at_the_bound_meets_all_limits() -> None:
    found = _statistics(2000)
    assert found.is_met
    assert not any(figure.by_chance for figure in found.pooled)
    values = [figure.value for figure in found.pooled]
    assert np.allclose(values, [1.0, 1.0, 0.95], atol=0.01)


@pytest.mark.parametrize(
    ("wrong", "missed"),
    [
        ({"worse": 1.05, "stated": 1.05}, {"ratio"}),
        ({"stated": 0.95}, {"nse", "coverage"}),
        ({"stated": 1.05}, {"nse", "coverage"}),
    ],
)
def test_an_estimator_five_percent_off_is_told(wrong: dict[str, float], missed: set[str]) -> None:
    found = _statistics(2000, **wrong)  # type: ignore[arg-type]
    assert not found.is_met
    assert {figure.name for figure in found.pooled if not figure.is_met} == missed


def test_a_bias_of_half_a_sigma_in_one_parameter_is_told_by_its_name() -> None:
    found = _statistics(2000, bias=0.5)
    assert [found.bound.names[i] for i in np.flatnonzero(found.outside)] == ["x3"]
    assert not found.is_met


def test_a_run_that_fails_is_counted_and_forgives_nothing() -> None:
    found = _statistics(2000, failures=1)
    assert found.failures == {"DidNotConverge": 1}
    assert found.n == 2000
    assert not found.is_met


def test_one_ratio_in_a_thousand_is_outside_the_band() -> None:
    rng = np.random.default_rng(0)
    low, high = band_of_ratio(20)
    ratios = np.sqrt(np.mean(rng.normal(size=(200_000, 20)) ** 2, axis=1))
    outside = np.mean((ratios < low) | (ratios > high))
    assert 0.0007 < outside < 0.0013  # four standard deviations of this count
    assert low < 1.0 < high


def test_few_runs_are_judged_by_chance_and_say_so() -> None:
    studies = [_statistics(40, seed=seed) for seed in range(100)]
    assert all(figure.by_chance for figure in studies[0].pooled[1:])
    assert np.mean([all(f.is_met for f in found.pooled) for found in studies]) >= 0.98
    assert not _statistics(40, worse=1.3, stated=1.3).is_met
    assert not _statistics(40, stated=0.7).is_met
    assert not _statistics(0, failures=3).is_met


@pytest.mark.parametrize("machine", thinned(MACHINES, ["3-upu-tilted", "3-rpr"]))
def test_the_fit_of_every_class_states_the_bound(machine: str) -> None:
    design, bound, session = _design(machine), _bound(machine), _session(machine)
    solution = one_fit(session, NOISE.radius_sigma)
    errors = errors_of(design, session, solution)
    stated = errors.error / errors.of_sigma  # hardly changed by where axes count from
    kinematic = [not name.split(".")[1].endswith("axis") for name in bound.names]
    ratio = np.abs(stated / bound.sigma)[kinematic]
    assert np.all(np.abs(ratio - 1.0) < 0.2)  # the noise is estimated from few outlines
    assert np.sqrt(np.mean((errors.error / bound.sigma) ** 2)) < 2.0
    assert 0.3 < errors.nse < 2.0
    start = vector_of(design.parametrization, session.nominal, design.legs)
    found = vector_of(design.parametrization, solution.legs, design.legs)
    truth = vector_of(design.parametrization, design.legs, design.legs)
    assert np.linalg.norm(found - truth) < 0.05 * np.linalg.norm(start - truth)


def test_the_bound_is_as_large_as_the_noise() -> None:
    design = _design("3-rpr")
    worse = dataclasses.replace(design.outlines, covariance=4.0 * design.outlines.covariance)
    twice = dataclasses.replace(design, outlines=worse)
    once = bound_of(design, 2e-6, 0.02)
    doubled = bound_of(twice, 4e-6, 0.04)
    assert np.allclose(doubled.covariance, 4.0 * once.covariance, rtol=1e-6)
    worse_readings = bound_of(design, 2e-5, 0.02)
    assert np.all(worse_readings.sigma > once.sigma * (1.0 - 1e-9))


def test_a_bound_of_too_little_data_is_refused() -> None:
    with pytest.raises(NotIdentifiable, match="do not determine"):
        bound_of(design_of("3-rpr", 1, 1, NOISE.sigma_px), 2e-6, 0.02)


@pytest.mark.parametrize("machine", MACHINES)
def test_a_true_machine_stands_where_its_legs_allow(machine: str) -> None:
    design = _design(machine)
    assert np.abs(unmeasured(design.legs, design.R, design.t)[0]).max(initial=0.0) < 1e-12
    ends = np.array([leg.B for leg in design.legs]) @ np.swapaxes(design.R, 1, 2)
    legs = ends + design.t[:, None] - np.array([leg.A for leg in design.legs])
    assert np.allclose(
        np.linalg.norm(legs, axis=-1),
        design.sign * design.q + np.array([leg.q0 for leg in design.legs]),
        rtol=0.0,
        atol=1e-12,
    )
    most = 4 if machine.startswith("6-spu") else 3
    images = np.unique(np.column_stack([design.outlines.row, design.outlines.leg]), axis=0)
    assert max(np.bincount(images[:, 0])) == most


def test_legs_that_meet_nowhere_are_refused() -> None:
    design = _design("3-rpr")
    rods = [dataclasses.replace(leg, kind=LegKind.CONSTANT, q0=5.0) for leg in design.legs]
    with pytest.raises(DidNotConverge, match="could not be closed"):
        closed_poses(rods, design.frame_legs, design.R, design.t)


def test_noise_of_sessions_has_the_covariance_that_outlines_carry() -> None:
    design = _design("3-rpr")
    exact, offsets, readings = design.outlines, [], []
    for seed in range(60):
        session = _session("3-rpr", seed=seed)
        xy = design.camera.undistort(session.outlines.ends)
        offsets.append(design.camera.line_offset(exact.h[:, None], xy))
        readings.append(session.measurements.q - design.q[design.pose])
    root = np.linalg.cholesky(exact.covariance)
    white = np.linalg.solve(root, np.array(offsets)[..., None])[..., 0].reshape(-1, 2)
    assert np.allclose(white.T @ white / len(white), np.eye(2), atol=0.05)
    assert np.std(readings) == pytest.approx(NOISE.sigma_q, rel=0.05)
    assert np.array_equal(design.outlines.covariance, session.outlines.covariance)


def test_what_a_fit_starts_from_is_as_wrong_as_is_said() -> None:
    design = _design("3-upu-tilted")
    for errors, least in ((FAR, 1.0), (bound_study.ERRORS, 0.0)):
        session = _session("3-upu-tilted", errors)
        for nominal, true in zip(session.nominal, design.legs, strict=True):
            lengths = np.abs([*(nominal.A - true.A), *(nominal.B - true.B), nominal.q0 - true.q0])
            moved = lengths[lengths > 0.0]
            assert np.all(moved <= errors.length * (1.0 + 1e-9))
            assert np.all(moved >= least * errors.length * (1.0 - 1e-9))
            for a, b in (
                (nominal.base_axis, true.base_axis),
                (nominal.platform_axis, true.platform_axis),
            ):
                assert a is not None
                assert b is not None
                turn = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
                assert least * errors.angle * (1.0 - 1e-9) <= turn <= 1.5 * errors.angle
        for view, T in zip(session.measurements.views, design.T_Rb_camera, strict=True):
            assert view.T_base_camera is not None
            change = view.T_base_camera * T.inv()
            shift = np.linalg.norm(view.T_base_camera.translation - T.translation)
            turned = change.rotation.magnitude()
            for found, most in ((shift, errors.camera_shift), (turned, errors.camera_turn)):
                assert least * most * (1.0 - 1e-9) <= found <= most * (1.0 + 1e-9)


@pytest.mark.parametrize("machine", ["6-spu-noncoplanar", "3-upu-tilted"])
def test_the_start_is_the_nominal_model_at_the_readings(machine: str) -> None:
    design, session = _design(machine), _session(machine)
    legs = FittedLegs(
        session.leg_names, session.nominal, session.sign, session.frame_legs, session.radii
    )
    start = nominal_start(session, legs)
    assert start.legs == session.nominal
    q = session.measurements.q[session.measurements.first_rows]
    lengths = session.sign * q + np.array([leg.q0 for leg in session.nominal])
    A, B = (np.array([getattr(leg, name) for leg in session.nominal]) for name in "AB")
    found = np.array([np.linalg.norm(T.apply(B) - A, axis=1) for T in start.T_Rb_Re])
    missed = np.abs(found - lengths).max(axis=1)
    assert np.mean(missed < 1e-9) > 0.6  # of the poses; others are beyond the nominal model
    away = [np.linalg.norm(T.translation - t) for T, t in zip(start.T_Rb_Re, design.t, strict=True)]
    assert 1e-4 < np.median(away) < 0.02  # neither the truth nor another assembly mode


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the study of the bound once, with a few runs."""
    folder = tmp_path_factory.mktemp("study") / "bound"
    run_study(OutlineStudy(BoundJudge(), _small(bound_study.ERRORS)), 3, output=folder)
    return folder


def _printed(table: object) -> str:
    told = io.StringIO()
    Console(file=told, width=80).print(table)
    return told.getvalue()


def test_the_study_of_the_bound_has_a_row_for_every_parameter(output: Path) -> None:
    document = json.loads((output / "study.json").read_bytes())
    (found,) = document["machines"]
    assert (found["machine"], found["runs"], found["failed"]) == ("3-rpr", 3, 0)
    assert [row["name"] for row in found["parameters"]] == list(_design("3-rpr").names)
    assert found["pooled"].keys() == {"ratio", "nse", "coverage"}
    assert all(figure["limits_of_chance"] for figure in found["pooled"].values())
    page = (output / "bound.md").read_text()
    assert all(f"| {name} |" in page for name in _design("3-rpr").names)


def test_a_study_of_the_bound_goes_on_where_it_was(output: Path) -> None:
    lines = (output / "runs.jsonl").read_text().splitlines(keepends=True)
    (output / "runs.jsonl").write_text("".join(lines[:2]))
    before = (output / "study.json").read_bytes()
    study = OutlineStudy(BoundJudge(), _small(bound_study.ERRORS))
    result = run_study(study, 3, output=output)
    assert (output / "runs.jsonl").read_text().splitlines(keepends=True) == lines
    assert (output / "study.json").read_bytes() == before
    told = _printed(result.summary.table())
    assert "…" not in told
    for words in ("each/bound", "3 runs are too few", "at the bound"):
        assert words in told
    with pytest.raises(UsageError, match="other settings"):
        run_study(OutlineStudy(BoundJudge(), _small(FAR)), 3, output=output)


def test_the_session_of_a_machine_does_not_depend_on_the_others(output: Path) -> None:
    line = json.loads((output / "runs.jsonl").read_text().splitlines()[2])
    both = OutlineStudy(BoundJudge(), _small(bound_study.ERRORS, ("3-upu-tilted", "3-rpr")))
    record = both.one_run(child_seed(0, 1))
    assert record["3-rpr"] == line["record"]["3-rpr"]
    assert both.is_record(record)
    study = OutlineStudy(BoundJudge(), _small(bound_study.ERRORS))
    assert study.is_record(line["record"])
    errors = line["record"]["3-rpr"]
    wrongs: tuple[object, ...] = (
        {},
        [],
        {"failure": "x"},
        {**errors, "nse": None},
        {**errors, "error": errors["error"][1:]},
        {**errors, "of_sigma": ["x"] * len(errors["error"])},
    )
    for wrong in wrongs:
        assert not study.is_record({"3-rpr": wrong})
    assert not study.is_record(record)


def test_a_fit_that_fails_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(session: OutlineSession, radius_sigma: float) -> Solution:
        raise DidNotConverge("It did not.")

    for module, study in (
        (bound_study, OutlineStudy(BoundJudge(), _small(bound_study.ERRORS))),
        (convergence_study, OutlineStudy(ConvergenceJudge(), _small(FAR))),
    ):
        monkeypatch.setattr(module, "one_fit", fails)
        result = run_study(study, 2)
        (found,) = result.document()["machines"]
        assert not found["met"]
        assert 2 in (found.get("refused"), found.get("failed"))
        assert "DidNotConverge" in _printed(result.summary.table())


def test_a_parameter_that_was_not_estimated_is_a_failure() -> None:
    design, session = _design("3-rpr"), _session("3-rpr")
    solution = one_fit(session, NOISE.radius_sigma)
    held = dataclasses.replace(solution, status={**solution.status, "leg1.offset": "weak"})
    with pytest.raises(NotIdentifiable, match=r"leg1\.offset"):
        errors_of(design, session, held)


def test_convergence_counts_the_truth_as_right_and_another_answer_as_wrong(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    study = OutlineStudy(ConvergenceJudge(), _small(FAR))
    result = run_study(study, 2, output=tmp_path / "out")
    (found,) = result.document()["machines"]
    assert (found["right"], found["wrong"], found["refused"]) == (2, 0, 0)
    assert found["met"]
    assert 0.0 < found["worst_sigma"] <= 5.0
    assert found["before"]["dX_mm"] > 50.0 * found["after"]["dX_mm"]
    assert found["after"]["dX_mm"] < 5.0 * found["predicted"]["dX_mm"]
    told = _printed(result.summary.table())
    assert "1 sigma" in told
    assert "…" not in told
    line = json.loads((tmp_path / "out" / "runs.jsonl").read_text().splitlines()[1])
    assert study.is_record(line["record"])
    for wrong in ({}, {**line["record"]["3-rpr"], "after": [0.0]}, {"worst": 1.0}):
        assert not study.is_record({"3-rpr": wrong})

    def shifted(session: OutlineSession, radius_sigma: float) -> Solution:
        solution = one_fit(session, radius_sigma)
        legs = tuple(dataclasses.replace(leg, q0=leg.q0 + 1e-3) for leg in solution.legs)
        values = {
            name: value + 1e-3 * name.endswith("offset") for name, value in solution.values.items()
        }
        return dataclasses.replace(solution, legs=legs, values=values)

    monkeypatch.setattr(convergence_study, "one_fit", shifted)
    (found,) = run_study(study, 1).document()["machines"]
    assert (found["right"], found["wrong"], found["met"]) == (0, 1, False)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("bound", "--machine", "4-rpr"), "found the machines 4-rpr, needed some of"),
        (("bound", "--machine", "3-rpr", "--machine", "3-rpr"), "each once"),
        (("convergence", "--machine", "hexapod"), "found the machines hexapod"),
        (("convergence", "--runs", "0"), "runs = 0"),
    ],
)
def test_wrong_use_of_the_commands_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    message: str,
) -> None:
    assert run(monkeypatch, "study", *words) == 2
    assert message in capsys.readouterr().err
