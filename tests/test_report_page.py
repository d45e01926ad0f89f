"""The page of a calibration: one file, complete, with the numbers of the result, and harmless."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import run
from hexapod_example import TRUTH, Run, spoiled
from lxml import html
from scipy.spatial.transform import RigidTransform

import legcal
from legcal.calibration.joint_fit.platform import platform_map
from legcal.calibration.result_folder import with_overlays, write_result
from legcal.errors import OutOfResources, UsageError
from legcal.machine.kinematics import platforms_in_base, pose_differences
from legcal.pages.document import page_html
from legcal.perception.overlays import COLOURS
from legcal.report.calibration_page import calibration_page

HOSTILE = "<script>alert(1)</script><b>\x1b[31m\u202e"


@pytest.fixture(scope="module")
def page(example_run: Run) -> Any:
    path = legcal.write_report(example_run.calibration, example_run.output)
    assert path.stat().st_size < 2_000_000  # of 45 images
    return html.fromstring(path.read_text("utf-8"))


def test_a_page_is_one_file_that_loads_nothing(page: Any) -> None:
    assert page.xpath("//link | //iframe | //object | //embed | //@srcset | //script/@src") == []
    loaded = page.xpath("//img/@src | //image/@href")
    assert all(one.startswith("data:") for one in loaded)
    assert "@import" not in page.xpath("string(//style)")
    assert "url(" not in page.xpath("string(//style)")


def test_a_page_has_the_numbers_of_the_result(example_run: Run, page: Any) -> None:
    result = json.loads((example_run.output / "result.json").read_text())
    assert result["verdict"] in page.xpath("string(//section[@id='verdict'])")
    tables = page.xpath("//section[@id='parameters']//table")
    joints = [
        1e3 * x for side in result["links"].values() for one in side["joints"] for x in one["xyz"]
    ]
    in_links = [
        float(row[3].get("data-value")) for table in tables[:2] for row in table.xpath("tbody/tr")
    ]
    assert in_links == pytest.approx(joints, rel=1e-12, abs=1e-12)
    others = [
        row for row in result["parameters"] if row["name"].rpartition(".")[2] not in ("x", "y", "z")
    ]
    scale = {"m": 1e3, "rad": 180.0 / 3.141592653589793, "px": 1.0, "": 1.0}
    for row, one in zip(tables[2].xpath("tbody/tr"), others, strict=True):
        name, *numbers = (cell.get("data-value", cell.text_content()) for cell in row)
        wanted = [one["nominal"], one["value"], one["value"] - one["nominal"], one["sigma"]]
        assert name == one["name"]
        for text, value in zip(numbers, wanted, strict=False):
            found = float(text) if text else None
            expected = None if value is None else scale[one["unit"]] * value
            assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)


def _charts(page: Any) -> tuple[Any, dict[str, list[tuple[float, float, int]]]]:
    """Return labels and links of the charts, and by chart its points on paper with numbers."""
    points = {}
    for figure in page.xpath("//div[contains(@class, 'charts')]//figure"):
        points[figure.findtext("h3")] = [
            (float(x), float(y), int(number))
            for path in figure.xpath(".//*[@data-points]")
            for (x, y), number in zip(
                re.findall(r"M(\S+) ([-\d.]+)", path.get("d")),
                path.get("data-points").split(),
                strict=True,
            )
        ]
    return json.loads(page.xpath("string(//div[contains(@class, 'charts')]/script)")), points


def test_points_of_the_charts_are_the_residuals_of_the_fit(example_run: Run, page: Any) -> None:
    residuals = example_run.calibration.residuals
    offset = dict(zip(residuals.index.tolist(), residuals.offset.tolist(), strict=True))
    _, charts = _charts(page)
    assert list(charts) == ["By view", "By leg", "By image"]
    for points in charts.values():
        seen: dict[int, list[float]] = {}
        for _, y, number in points:
            seen.setdefault(number, []).append(y)
        assert seen.keys() == offset.keys()
        drawn = np.array([seen[number] for number in offset]).ravel()
        true = np.array(list(offset.values())).ravel()
        slope, start = np.polyfit(true, drawn, 1)
        assert slope < 0.0  # up is positive
        assert np.abs(start + slope * true - drawn).max() < 0.06  # they are rounded to 0.1


def test_the_worst_outlines_are_shown_and_points_lead_to_them(example_run: Run, page: Any) -> None:
    residuals = example_run.calibration.residuals
    size = np.linalg.norm(residuals.whitened, axis=1)
    worst = residuals.index[np.argsort(-size)[:30]].tolist()
    shown = [name.removeprefix("outline-") for name in page.xpath("//figure[@class='crop']/@id")]
    assert len(shown) == 40
    assert sorted(shown[:30]) == sorted(map(str, worst))
    pictures = page.xpath("//image/@href")
    assert sum(map(len, pictures)) <= 3_000_000
    content, charts = _charts(page)
    assert content["links"] == {name: f"#outline-{name}" for name in shown}
    for points in charts.values():
        assert set(map(int, shown)) <= {number for _, _, number in points}


def test_the_map_of_the_workspace_agrees_with_the_models(example_run: Run) -> None:
    calibration = example_run.calibration
    found = platform_map(calibration.dataset.machine, calibration.solution)
    assert found is not None
    nominal = calibration.dataset.machine
    calibrated = legcal.load_mechanism(example_run.output / "calibrated.yaml")
    assert found.change.shape == found.sigma.shape == (3, 7, 7)
    reached = np.argwhere(np.isfinite(found.change))
    assert len(reached) > 60
    for i, j, k in reached[::9].tolist():
        at = [found.x[k], found.y[j], found.z[i]]
        T = RigidTransform.from_components(at, nominal.home.rotation)
        moved = legcal.forward_kinematics(calibrated, legcal.inverse_kinematics(nominal, T))
        before, after = (
            platforms_in_base(machine, [pose])
            for machine, pose in ((nominal, T), (calibrated, moved))
        )
        displacement, _ = pose_differences(before, after)
        assert found.change[i, j, k] == pytest.approx(displacement[0], abs=2e-6)
    platform = calibration.result.platform
    assert platform is not None
    assert platform.workspace is not None
    assert np.nanmean(found.sigma) == pytest.approx(platform.workspace.sigma_dX_m, rel=0.1)


def test_hostile_names_are_harmless(example_run: Run, tmp_path: Path) -> None:
    calibration = example_run.calibration
    machine = replace(calibration.dataset.machine, name=HOSTILE)
    legs = tuple(replace(leg, name=f"{HOSTILE}{leg.name}") for leg in machine.legs)
    machine = replace(machine, legs=legs)
    changed = replace(
        calibration,
        dataset=replace(calibration.dataset, machine=machine),
        notes=(*calibration.notes, HOSTILE),
    )
    changed.__dict__["result"] = calibration.result
    text = page_html(calibration_page(changed, tmp_path / HOSTILE.replace("/", "")))
    assert "<script>alert" not in text
    assert "\x1b" not in text
    assert "\u202e" not in text
    found: Any = html.fromstring(text)
    assert "<script>alert(1)</script>" in found.xpath("string(//h1)")
    for script in found.xpath("//script[@type='application/json']"):
        assert "<" not in script.text


@pytest.mark.usefixtures("page")  # which writes the report of the result
def test_a_report_is_not_written_over_another_file(example_run: Run, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(UsageError, match=r"report\.html"):
        legcal.write_report(example_run.calibration, tmp_path)
    assert (tmp_path / "report.html").read_text() == "mine"
    (tmp_path / "report.html").write_bytes((example_run.output / "report.html").read_bytes())
    assert legcal.write_report(example_run.calibration, tmp_path).exists()


def test_calibrate_writes_the_report_unless_it_should_not(
    example_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr("legcal.calibration.pipeline.calibrate", example_run.written_again)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1790000000")
    assert run("calibrate", example_run.folder, "-o", out).code == 0
    page = (out / "report.html").read_bytes()
    assert b"legcal-page" in page[:1000]
    assert b"2026-09-21" in page
    assert run("calibrate", example_run.folder, "-o", out).code == 0
    assert (out / "report.html").read_bytes() == page  # the time is all that differs otherwise
    assert run("calibrate", example_run.folder, "-o", out, "--no-report").code == 0
    assert not (out / "report.html").exists()


@pytest.mark.usefixtures("page")  # of an earlier result: it goes
@pytest.mark.parametrize(
    ("error", "said"),
    [
        (KeyError("leg9"), "found KeyError: 'leg9'; please report this."),
        (OutOfResources("The page could not be written: found no room."), "The page could not"),
    ],
)
def test_a_page_that_fails_loses_nothing_else(
    example_run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    said: str,
) -> None:
    def fails(*_: Any) -> None:
        raise error

    out = Path(shutil.copytree(example_run.output, tmp_path / "out"))
    assert (out / "report.html").exists()
    words = ("calibrate", example_run.folder, "-o", out)
    monkeypatch.setattr("legcal.calibration.pipeline.calibrate", example_run.written_again)
    monkeypatch.setattr("legcal.report.calibration_page.verdict_of", fails)
    outcome = run(*words, "--json")
    assert outcome.code == 0
    document = outcome.document
    assert document.pop("next")[0]["what"].startswith("Load calibrated.urdf")
    assert document == json.loads((out / "result.json").read_text())
    assert f"legcal: The result was written without report.html: {said}" in outcome.err
    assert not (out / "report.html").exists()
    assert (out / "calibrated.urdf").exists()


def test_the_truth_is_for_the_page_alone(
    example_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibration = example_run.calibration
    write_result(calibration, tmp_path)
    path = legcal.write_report(calibration, tmp_path, truth=TRUTH)
    found: Any = html.fromstring(path.read_text("utf-8"))
    said = found.xpath("string(//section[@id='truth']/p)")
    models = (calibration.dataset.machine, "nominal"), (tmp_path / "calibrated.yaml", "calibrated")
    for model, word in models:
        errors = legcal.evaluate(model, TRUTH)
        mean, turn = 1e3 * errors.displacement.mean(), np.degrees(errors.rotation.mean())
        assert f"by {mean:.3f} mm and {turn:.4f} deg by the {word} model" in said

    monkeypatch.setattr(
        "legcal.calibration.pipeline.calibrate", lambda *_, **__: pytest.fail("too late")
    )
    words = ("calibrate", example_run.folder, "-o", tmp_path / "new", "--truth")
    assert run(*words, "hexapod", "--no-report").code == 2
    assert run(*words, "3-rpr").code == 2
    assert run(*words, tmp_path / "none.yaml").code == 2
    assert not (tmp_path / "new").exists()


def test_points_lead_to_overlays_beside_the_page(example_run: Run, tmp_path: Path) -> None:
    calibration = with_overlays(example_run.calibration)
    files = dict(list(calibration.overlays.items())[:2])
    calibration = replace(calibration, overlays=files)
    write_result(calibration, tmp_path)
    listed = json.loads((tmp_path / "result.json").read_text())["overlays"]
    assert [one["file"] for one in listed] == list(files.values())
    for file in files.values():
        picture = cv2.imread(str(tmp_path / file))
        assert picture is not None
        green = np.all(np.abs(picture.astype(int) - COLOURS["edge 1"]) < 60, axis=2)
        assert np.count_nonzero(green) > 1000
    page: Any = html.fromstring(legcal.write_report(calibration, tmp_path).read_text("utf-8"))
    content, _ = _charts(page)
    rows = calibration.solution.outlines.row
    residuals = calibration.residuals.index
    crops = [name.removeprefix("outline-") for name in page.xpath("//figure[@class='crop']/@id")]
    for i in residuals.tolist():
        to = content["links"].get(str(i))
        assert to == (f"#outline-{i}" if str(i) in crops else files.get(int(rows[i])))
    whole = page.xpath("//figure[@class='crop']//a/@href")
    assert set(whole) <= set(files.values())

    (tmp_path / "overlays" / "mine.txt").write_text("mine")
    write_result(example_run.calibration, tmp_path)  # which these do not show
    assert not any((tmp_path / file).exists() for file in files.values())
    assert (tmp_path / "overlays" / "mine.txt").read_text() == "mine"
    with pytest.raises(UsageError, match="found overlays, which legcal did not write"):
        legcal.calibrate(calibration.dataset, output=tmp_path, overlays=True)
    with pytest.raises(UsageError, match="no output folder"):
        legcal.calibrate(calibration.dataset, overlays=True)


def test_overlays_that_cannot_be_drawn_are_left_out_and_told(
    example_run: Run, tmp_path: Path
) -> None:
    calibration = with_overlays(example_run.calibration)
    moved = replace(calibration.dataset, folder=tmp_path / "gone")
    written = write_result(replace(calibration, dataset=moved), tmp_path / "out")
    assert "There are no overlays." in written.notes[-1]
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert "overlays" not in result
    assert result["notes"] == list(written.notes)
    assert not (tmp_path / "out" / "overlays").exists()
    with pytest.raises(UsageError, match="found no photograph"):
        legcal.calibrate(moved, output=tmp_path / "out", overlays=True)


@pytest.mark.system
@pytest.mark.usefixtures("page")  # which writes the report of the result
def test_a_check_writes_a_page_and_never_over_that_of_a_result(
    example_run: Run, tmp_path: Path
) -> None:
    few = spoiled(tmp_path / "few", 1).write()  # photographs, at half their size
    words = ("calibrate", few, "--check", example_run.output, "-o")
    before = (example_run.output / "report.html").read_bytes()
    assert run(*words, example_run.output).code == 2
    assert (example_run.output / "report.html").read_bytes() == before
    checked = run(*words, tmp_path / "check")
    assert checked.code == 0
    assert checked.out.startswith("No change was detected")  # the verdict comes first
    found: Any = html.fromstring((tmp_path / "check" / "report.html").read_text("utf-8"))
    assert "No change was detected" in found.xpath("string(//section[@id='verdict'])")
