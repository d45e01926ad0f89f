"""The commands whose results are recorded, by name."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from characterisation.facts import facts, folder_facts, table_facts
from characterisation.inputs import MACHINES, copy_of, simulated
from characterisation.running import run, words_of


@dataclass(frozen=True)
class Step:
    """One command line. ``{in}`` is a copy of the input, ``{out}`` a new place.

    Parameters
    ----------
    command : str
        The words after ``legcal``.
    folder : str
        A place whose files are recorded afterwards; none without it.
    many : bool
        Use all processors.
    """

    command: str
    folder: str = ""
    many: bool = False


@dataclass(frozen=True)
class Case:
    """Command lines that follow each other in one folder, and what is recorded of them."""

    name: str
    steps: tuple[Step, ...]
    input: str = ""
    files: tuple[tuple[str, str], ...] = ()  # written first: name, text
    slow: bool = False
    system: bool = False  # run by -m system; README.md says why of these and of slow ones

    @property
    def is_rough(self) -> bool:
        """Whether its numbers come from outlines that were searched in photographs."""
        searched = "photographs" in self.input or self.input == "repeats"
        return searched and not self.name.startswith("identify")

    def observe(self, folder: Path) -> dict[str, Any]:
        """Run it in an empty folder, and return all facts."""
        places: dict[str, Path | str] = {"out": folder / "out", "here": folder}
        if self.input:
            places["in"] = copy_of(self.input, folder / "in")
        for name, text in self.files:
            (folder / name).write_text(text)
        return {"steps": [self._observe(step, places) for step in self.steps]}

    def _observe(self, step: Step, places: dict[str, Path | str]) -> dict[str, Any]:
        words = words_of(step.command, places)
        outcome = run(words, inside=Path(places["here"]), many=step.many)
        found: dict[str, Any] = {"exit": outcome.code}
        printed = None
        if "--json" in words:
            printed = outcome.document
            found["document"] = facts(printed)
        else:
            found["printed"] = bool(outcome.out.strip())
        if step.folder:
            place = Path(step.folder.format(**places))
            found["files"] = folder_facts(place, printed)
        return found


@dataclass(frozen=True)
class Chain(Case):
    """The whole path of one machine: simulated, calibrated, compared with its truth."""

    def observe(self, folder: Path) -> dict[str, Any]:
        """Run it, and tell of the simulated dataset too: what is wrong there shows there."""
        machine, _, level = self.name.rpartition("-")
        made, document = simulated(machine, level)
        tables = sorted(made.glob("*.csv"))
        before = {
            "document": facts(document),
            "tables": {path.name: table_facts(path) for path in tables},
            "files": sorted(
                p.relative_to(made).as_posix()
                for p in made.rglob("*.*")
                if ".schemas" not in p.parts
            ),
        }
        return {"simulated": before} | super().observe(folder)


@dataclass(frozen=True)
class Places(Case):
    """Where cameras are put around a machine."""

    def observe(self, folder: Path) -> dict[str, Any]:
        """Simulate hardly anything, and return the true places."""
        machine = self.name.removeprefix("places-")
        words = f"simulate {machine} -o {folder / 'out'} --level outlines --seed 3 --poses 8"
        assert run(words.split()).code == 0
        views = json.loads((folder / "out/truth/truth.json").read_text())["views"]
        return {"views": facts(views)}


QUICK_CHAINS = {"3-rpr-outlines", "hexapod-outlines", "3-upu-axes", "tricept-axes"}
SYSTEM_CHAINS = {"hexapod-strut-outlines", "3-rpr-axes", "3-rps-axes"}
QUICK = "--level outlines --poses 1 --views 1 --seed 3 --json"
SMALL = (
    "image_width: 200\nimage_height: 150\ncamera_name: tiny\n"
    "camera_matrix: {rows: 3, cols: 3, data: [300, 0, 100, 0, 300, 75, 0, 0, 1]}\n"
    "distortion_model: plumb_bob\n"
    "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
)
PLACE = "{T_base_camera: {xyz: [1.2, 0.0, 0.3], quat_xyzw: [-0.5, -0.5, 0.5, 0.5]}}"


def _chains() -> Iterable[Case]:
    for level in ("outlines", "axes", "photographs"):
        for machine in MACHINES:
            truth = f"{{in}}/truth/models/{machine}.yaml"
            steps = (
                Step("calibrate {in} -o {out} --json", folder="{out}"),
                Step(f"evaluate {{out}}/calibrated.yaml {truth} --dataset {{in}} --json"),
                Step("inspect {out}/calibrated.yaml --json"),
            )
            name = f"{machine}-{level}"
            system = name in SYSTEM_CHAINS
            slow = not system and name not in QUICK_CHAINS
            yield Chain(name, steps, input=name, slow=slow, system=system)


def _models() -> Iterable[Case]:
    for machine in MACHINES:
        yield Case(
            f"model-{machine}",
            (
                Step(f"inspect {machine} --json"),
                Step(f"new {{in}}/{machine}.yaml --output {{out}} --json", folder="{out}"),
            ),
            input="tables",
        )
        yield Case(
            f"rebuilt-{machine}",
            (
                Step(f"new {{in}}/{machine}.yaml -o {{out}} --json"),
                Step(f"evaluate {{out}}/models/{machine}.yaml {machine} --json"),
            ),
            input="tables",
            slow=machine != "3-rps",
        )
        alike = machine in {"6-sps", "hexapod-rod"}
        yield Case(f"identify-{machine}", (Step(f"identify {machine} --json"),), slow=alike)
    yield Case(
        "inspect-text-and-write",
        (
            Step("inspect hexapod"),
            Step("inspect {in}/models/hexapod.yaml --write {out} --json", folder="{out}"),
            Step("inspect {out}/models/hexapod.yaml --json"),
        ),
        input="model",
    )
    yield Case(
        "new-csv-and-force",
        (
            Step("new {in}/tripod.csv --unit mm -o {out} --json", folder="{out}"),
            Step("new {in}/tripod.csv --unit mm -o {out} --force"),
            Step("new {in}/tripod.csv --unit mm -o {out} --name other", folder="{out}"),
        ),
        input="tables",
    )

    steps = tuple(
        Step(f"inspect {{in}}/{name} --json")
        for name in ("gepetto", "bare.yaml", "loops.urdf", "planar.xml")
    )
    written = Step("inspect {in}/planar.xml --write {out} --json", folder="{out}")
    yield Case("inspect-formats", (*steps, written), input="formats")


def _identify() -> Iterable[Case]:
    views = {
        "paper": ("leg1,leg2,leg3,leg4", "leg3,leg4,leg5,leg6", "leg1,leg2,leg5,leg6"),
        "weak": ("leg1,leg2,leg3,leg4,leg5", "leg1,leg2,leg3,leg4,leg5", "leg5,leg6"),
        "narrow": ("leg1,leg2,leg3", "leg4,leg5,leg6", "leg1,leg2,leg3"),
    }
    for name, chosen in views.items():
        words = " ".join(f"--view {view}" for view in chosen)
        yield Case(f"identify-views-{name}", (Step(f"identify hexapod {words} --json"),))
    words = "--view leg1,leg2 --view leg3,leg4,leg5,leg6 --images 6"
    yield Case(
        "identify-options",
        (
            Step(f"identify hexapod {words} --json"),
            Step(f"identify hexapod {words} --board --json"),
            Step(f"identify hexapod {words} --board --hand-held --json"),
            Step(f"identify hexapod {words}"),
        ),
    )
    yield Case("identify-dataset", (Step("identify {in} --json"),), input="hexapod-outlines")
    step = Step("identify {in} --json")
    yield Case("identify-photographs", (step,), input="3-rpr-photographs", slow=True)


def _calibrate() -> Iterable[Case]:
    def case(
        name: str,
        words: str,
        given: str = "3-rpr-outlines",
        slow: bool = False,
        system: bool = False,
    ) -> Case:
        command = f"calibrate {{in}} -o {{out}} {words} --json"
        return Case(
            f"calibrate-{name}", (Step(command, folder="{out}"),), given, slow=slow, system=system
        )

    yield case("literal", "--criteria literal")
    yield case("literal-hexapod", "--criteria literal", "hexapod-axes", slow=True)
    yield case("points", "--criteria literal --transformation points", system=True)
    yield case("cross-product", "--criteria default --transformation cross_product", system=True)
    prior = "--set leg1.offset=231+-0.5mm --set '*.radius.leg2_rod=8±0.1mm'"
    yield case("by-name", f"{prior} --set leg2.offset --set leg3.offset=0.23075 --set 'c1.f?=free'")
    yield case("contradicted", "--set 'leg2.base.*'", "hexapod-outlines")
    yield case("patterns", "--set '*.base.?=0.3+-1' --set '*.radius.*=free'")
    yield case("twists", "--set '*.twist=free'", "3-upu-axes", slow=True)
    yield case("holdout", "--holdout 0.25")
    yield Case(
        "calibrate-text",
        (
            Step("calibrate {in} --output {out}", folder="{out}"),
            Step("evaluate {out}/calibrated.yaml {in}/truth/models/3-rpr.yaml"),
            Step("evaluate 3-rpr {in}/truth/models/3-rpr.yaml --json"),
            Step("calibrate {in} --check {out}"),
        ),
        input="3-rpr-axes",
    )
    yield Case(
        "photographs-again",
        (
            Step("calibrate {in} -o {out} --json"),
            Step("calibrate {in} -o {here}/cached --json", folder="{here}/cached"),
            Step("calibrate {in} -o {here}/fresh --fresh --json", folder="{in}"),
        ),
        input="3-rpr-photographs",
        slow=True,
    )


def _images() -> Iterable[Case]:
    yield Case(
        "detect",
        (
            Step("detect {in} -o {out} --json --workers 1", folder="{out}"),
            Step("detect {in} --output {here}/two --workers 2", folder="{here}/two", many=True),
        ),
        input="3-rpr-photographs",
        slow=True,
    )
    yield Case(
        "detect-repeats",
        (Step("detect {in}/set -o {out} --json", folder="{out}"),),
        input="repeats",
    )
    camera = "camera {in}/set/images --board {in}/set/dataset.yaml"
    yield Case(
        "camera",
        (
            Step(f"{camera} -o {{here}}/a.yaml --json --workers 1 --model plumb_bob"),
            Step(f"{camera} --output {{out}} --model equidistant --picture {{here}}/field.png"),
        ),
        input="boards",
        system=True,
    )
    yield Case(
        "board",
        (Step("calibrate {in}/set -o {out} --json", folder="{out}"),),
        input="boards",
        slow=True,
    )


def _locate() -> Iterable[Case]:
    model = "locate {in}/hexapod/models/hexapod.yaml {in}/hexapod.csv"
    sigmas = "--position-sigma 0.02mm --angle-sigma 0.01deg --encoder-sigma 2um"
    yield Case(
        "locate",
        (
            Step(f"{model} -o {{here}}/a.yaml --json --urdf {{out}}", folder="{out}"),
            Step(f"{model} -o {{here}}/b.yaml --json {sigmas}"),
            Step(
                f"{model} --output {{here}}/c.yaml --position-sigma 0.0001mm "
                "--urdf {here}/cell --world-link room --tool-link tcp",
                folder="{here}/cell",
            ),
            Step("inspect {here}/cell/models/hexapod.yaml --json"),
        ),
        input="tool-poses",
    )
    yield Case(
        "locate-in-part",
        (
            Step(
                "locate {in}/3-rpr/models/3-rpr.yaml {in}/3-rpr.csv -o {out} --json "
                "--tool-position 0,0,5mm"
            ),
        ),
        input="tool-poses",
    )


def _simulate() -> Iterable[Case]:
    for machine in MACHINES:
        yield Places(f"places-{machine}", (), slow=machine != "3-rpr")


def _others() -> Iterable[Case]:
    yield Case("version", (Step("--version"),))


CASES: tuple[Case, ...] = (
    *_chains(),
    *_models(),
    *_identify(),
    *_calibrate(),
    *_images(),
    *_locate(),
    *_simulate(),
    *_others(),
)
