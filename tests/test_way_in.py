"""The first hour: tables of joints as people write them, and from files to a calibration."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import run
from hexapod_example import ROOT
from lxml import etree

from legcal import load_mechanism
from legcal.machine.model import Machine, readings_at
from legcal.machine.picture import draw_machine

BASE = [(289.8, 77.6), (-77.6, 289.8), (-212.1, 212.1), (-212.1, -212.1), (-77.6, -289.8),
        (289.8, -77.6)]  # fmt: skip
PLATFORM = [(106.1, 106.1), (38.8, 144.9), (-144.9, 38.8), (-144.9, -38.8), (38.8, -144.9),
            (106.1, -106.1)]  # fmt: skip
ENDS = ("--min-length", "380", "--max-length", "500")
OPTIONS = ("--type", "UPS", *ENDS, "--leg-radius", "10", "--height", "400")


def wide(header: str, at: float = 0.0, separator: str = ",") -> str:
    """Return a row for each leg under a header of six coordinates, the platform at a height."""
    rows = [
        separator.join(f"{x:g}" for x in (*A, 0.0, *B, at))
        for A, B in zip(BASE, PLATFORM, strict=True)
    ]
    return "\n".join([header, *rows]) + "\n"


def one_row(base: str, platform: str) -> str:
    points = {f"{base}{j + 1}": A for j, A in enumerate(BASE)}
    points |= {f"{platform}{j + 1}": B for j, B in enumerate(PLATFORM)}
    header = ",".join(f"{name}{axis}" for name in points for axis in "xyz")
    return header + "\n" + ",".join(f"{x:g},{y:g},0" for x, y in points.values()) + "\n"


def twelve_points(base: str, platform: str) -> str:
    rows = [f"{platform}{j + 1},{x:g},{y:g},0" for j, (x, y) in enumerate(PLATFORM)]
    rows += [f"{base}{j + 1},{x:g},{y:g},0" for j, (x, y) in enumerate(BASE)]
    return "\n".join(["Point,X [mm],Y [mm],Z [mm]", *rows]) + "\n"


def new(
    monkeypatch: pytest.MonkeyPatch, folder: Path, text: str, *words: str, name: str = "own.csv"
) -> int:
    (folder / name).write_text(text)
    return run(monkeypatch, "new", folder / name, "-o", folder / "made", *words)


def made(folder: Path) -> Machine:
    return load_mechanism(folder / "made/models/own.yaml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (wide("bx,by,bz,px,py,pz"), ("--unit", "mm")),
        (wide("Base_X [mm];Base_Y [mm];Base_Z [mm];Plat_X [mm];Plat_Y [mm];Plat_Z [mm]",
              separator=";"), ()),
        (wide("xa,ya,za,xb,yb,zb"), ("--unit", "mm")),
        (wide("base_x_mm,base_y_mm,base_z_mm,top_x_mm,top_y_mm,top_z_mm"), ()),
        (one_row("B", "P"), ("--unit", "mm")),
        (one_row("A", "B"), ("--unit", "mm")),
        (twelve_points("B", "P"), ()),
        (twelve_points("A", "B"), ()),
        (twelve_points("Base joint ", "Platform joint "), ()),
        (twelve_points("B", "P").replace("Point", "Punkt").replace(",", ";"), ()),
        (twelve_points("B", "P").partition("\n")[2], ("--unit", "mm")),  # without headings
        (twelve_points("B", "P").partition("\n")[2].replace(",", "  "), ("--unit", "mm")),
        (twelve_points("base,", "platform,").replace("Point", "Side,Leg"), ()),
    ],
)  # fmt: skip
def test_headings_as_people_write_them_give_one_machine(
    text: str, words: Sequence[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert new(monkeypatch, tmp_path, text, *words, *OPTIONS) == 0
    machine = made(tmp_path)
    np.testing.assert_allclose(machine.A_base[:, :2], 1e-3 * np.array(BASE), atol=1e-12)
    np.testing.assert_allclose(machine.B_platform[:, :2], 1e-3 * np.array(PLATFORM), atol=1e-12)
    np.testing.assert_allclose(machine.q0, 0.38, atol=1e-12)
    assert {leg.travel for leg in machine.legs} == {(0.0, 0.12)}
    np.testing.assert_allclose(machine.home.as_matrix()[:3, 3], [0, 0, 0.4], atol=1e-12)
    assert machine.home.rotation.magnitude() < 1e-12


def test_platform_joints_in_the_base_are_asked_about_and_taken_as_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = wide("bx,by,bz,px,py,pz", at=395.5)
    words = ("--unit", "mm", "--type", "UPS", *ENDS)
    for more in ((), ("--height", "400")):
        assert new(monkeypatch, tmp_path, text, *words, *more) == 2
        said = capsys.readouterr().err
        assert said.count("legcal: ") == said.count("\n") == 1
        assert "look like coordinates of the base" in said
        assert "platform_in: base" in said

    def stating(side: str) -> str:
        head, *rows = text.splitlines()
        return "\n".join([f"{head},platform_in", *(f"{row},{side}" for row in rows)])

    assert new(monkeypatch, tmp_path, stating("base"), *words) == 0
    machine = made(tmp_path)
    np.testing.assert_allclose(machine.home.translation, [0, 0, 0.3955], atol=1e-12)
    np.testing.assert_allclose(machine.B_platform[0], [0.1061, 0.1061, 0], atol=1e-12)
    assert "coordinates of the base at home" in " ".join(capsys.readouterr().out.split())
    assert new(monkeypatch, tmp_path, stating("platform"), *words, "--force") == 0
    np.testing.assert_allclose(made(tmp_path).B_platform[0], [0.1061, 0.1061, 0.3955], atol=1e-12)


def test_a_platform_that_is_turned_in_its_link_is_level_and_turned_back_at_its_height(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = wide("bx,by,bz,px,py,pz").splitlines()
    turned = [lines[0]]
    for line in lines[1:]:
        *base, x, y, z = line.split(",")
        turned.append(",".join([*base, y, str(-float(x)), z]))  # by -90 deg
    assert new(monkeypatch, tmp_path, "\n".join(turned), "--unit", "mm", *OPTIONS) == 0
    machine = made(tmp_path)
    assert machine.home.rotation.as_euler("xyz", degrees=True)[2] == pytest.approx(90.0)
    q = readings_at(machine, machine.home)
    assert np.ptp(q) < 1e-3


REFUSED: list[tuple[str, Sequence[str], Sequence[str]]] = [
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", "--type", "UPS"),
     ("'leg1', 'leg2', 'leg3', 'leg4', 'leg5', 'leg6'", "min_length")),
    (wide("bx,by,bz,px,py,pz"), OPTIONS, ("--unit mm",)),
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", *OPTIONS[2:]), ("type", "--type UPS")),
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", *OPTIONS, "--base-radius", "9"),
     ("--base-radius", "--family only")),
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", *OPTIONS[:-2], "--height", "700"),
     ("'leg1', 'leg2'", "close at home", "380 to 500 mm")),
    (wide("bx,by,bz,px,py,pz [Zoll]"), OPTIONS, ("Zoll", "mm, um, nm, cm, m, in, ft")),
    (wide("bx [cubit],by,bz,px,py,pz"), OPTIONS, ("cubit", "mm, um, nm, cm, m, in, ft")),
    (wide("bx,by,bz,px,py,pz [mm]"), ("--unit", "m", *OPTIONS), ("--unit m",)),
    (wide("bx,by,bz,qx,qy,qz"), ("--unit", "mm", *OPTIONS), ("'qx'", "'platform_x'")),
    (twelve_points("B", "P").replace("P3", "P2"), OPTIONS, ("'P2' twice",)),
    (twelve_points("B", "P").replace("P3", "sun"), OPTIONS, ("'sun'", "B1 and P1")),
    (twelve_points("B", "P").replace("P3,-144.9,38.8,0\n", ""), OPTIONS, ("platform_x",)),
    ("Point,X [mm],Y [mm],Z [mm]\n", OPTIONS, ("no row",)),
    (twelve_points("", ""), OPTIONS, ("'1'", "B1 and P1")),
    (wide("bx,by,bz,px,py,pz").partition("\n")[2], OPTIONS, ("numbers in the first line",)),
    (wide("u,v,w,r,s,t"), OPTIONS, ("columns 'u', 'v', 'w', 'r', 's', 't'", "columns 'base_x'")),
    (one_row("B", "P") * 2, ("--unit", "mm", *OPTIONS), ("3 rows", "one complete row")),
    (wide("bx,by,bz,px,py,pz"), ("--unit", "mm", "--max-length", "500", "--type", "UPS"),
     ("max_length alone",)),
]  # fmt: skip


@pytest.mark.parametrize(("text", "words", "named"), REFUSED)
def test_what_tables_lack_is_said_once(
    text: str,
    words: Sequence[str],
    named: Sequence[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert new(monkeypatch, tmp_path, text, *words) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in named), said
    assert "leg2'" not in said or "'leg1'" in said.split("leg2'")[0]
    assert not (tmp_path / "made").exists()


def test_inspect_tells_travel_home_and_lengths_and_draws_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    svg = tmp_path / "machine.svg"
    assert new(monkeypatch, tmp_path, wide("bx,by,bz,px,py,pz"), "--unit", "mm", *OPTIONS) == 0
    urdf, model = tmp_path / "made/urdf/own.urdf", tmp_path / "made/models/own.yaml"
    urdf.write_text(urdf.read_text().replace('radius="0.01"', 'radius="0.0123456"'))
    capsys.readouterr()
    assert run(monkeypatch, "inspect", model, "--picture", svg) == 0
    said = " ".join(capsys.readouterr().out.split())
    machine = made(tmp_path)
    q = 1e3 * readings_at(machine, machine.home)[1]
    assert f"leg2 0.00 to 120.00 380.00 to 500.00 {q:.2f} {q + 380.0:.2f}" in said
    assert "platform at (0.00, 0.00, 400.00) mm in the base" in said
    assert "12.35" in said
    root = etree.fromstring(svg.read_bytes())
    texts = [found.text for found in root.iter("{http://www.w3.org/2000/svg}text")]
    for name in [f"{letter}{j}" for letter in "AB" for j in range(1, 7)]:
        assert texts.count(name) == 2
    assert {"own at home", "R_b x", "R_e x", "100 mm"} <= set(texts)
    rings = [x for x in root.iter("{http://www.w3.org/2000/svg}circle") if x.get("fill") == "none"]
    assert len(rings) == 2 * 2 * 3  # views, ends, legs of the frame
    hostile = draw_machine(replace(machine, name="<script>\x1b[2J&")).markup()
    assert "&lt;script&gt;" in hostile
    assert "\x1b" not in hostile
    assert run(monkeypatch, "inspect", model, "--picture", svg) == 0
    svg.write_text("mine")
    for place, word in ((svg, "another file"), (tmp_path / "machine.png", ".svg")):
        capsys.readouterr()
        assert run(monkeypatch, "inspect", model, "--picture", place) == 2
        assert word in capsys.readouterr().err
    assert svg.read_text() == "mine"


@pytest.mark.parametrize("in_page", [True, False])
@pytest.mark.parametrize("model", ["hexapod", "delta"])
def test_the_legend_of_a_drawing_is_not_cut(model: str, in_page: bool) -> None:
    machine = load_mechanism(model)
    root = etree.fromstring(draw_machine(machine, in_page=in_page).markup())
    width, height = (float(root.get(side, "nan")) for side in ("width", "height"))
    texts = list(root.iter("{http://www.w3.org/2000/svg}text"))
    first = next(k for k, text in enumerate(texts) if str(text.text).startswith("Rings: "))
    legend = [str(text.text) for text in texts[first:]]
    letter = 6.2  # width, at least [px]
    assert max(len(line) for line in legend) * letter < width - 12.0
    assert max(float(text.get("y", "nan")) for text in texts[first:]) < height - 3.0
    said = " ".join(legend).replace("\N{NO-BREAK SPACE}", " ")
    assert f"(base{machine.at_zero}) and R_e (platform)." in said
    assert all(f"{j} {name}" in said for j, name in enumerate(machine.leg_names, 1))


def test_hostile_names_do_nothing_in_a_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Escape sequences, changes of direction and markup in names of files and links."""
    odd = "\x1b]0;me\x07[red]\u202e"
    urdf = (ROOT / "urdf/3-rpr.urdf").read_text()
    folder = tmp_path / odd
    folder.mkdir()
    (folder / f"{odd}.urdf").write_text(urdf.replace('"platform"', '"plat[red]form"'))
    entry = yaml.safe_load((ROOT / "models/3-rpr.yaml").read_text())
    entry["legcal"] |= {"urdf": f"{odd}.urdf", "platform": "plat[red]form"}
    model = folder / f"{odd}.yaml"
    model.write_text(yaml.safe_dump(entry))
    for words in (
        ("inspect", model, "--picture", folder / f"{odd}.svg", "--write", folder / "copy"),
        ("evaluate", model, model),
        ("inspect", folder / "none"),
        ("new", "--template", "-o", folder, "--name", "mine"),
        ("new", "--family", "delta", "-o", folder),
    ):  # fmt: skip
        code = run(monkeypatch, *words)
        said = capsys.readouterr()
        for text in (said.out, said.err):
            assert not {"\x1b", "\x07", "\u202e"} & set(text), words
        assert code == (2 if "none" in str(words[1]) else 0), said.err
    drawn = (folder / f"{odd}.svg").read_text()
    assert not {"\x1b", "\u202e"} & set(drawn)
