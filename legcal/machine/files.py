"""The files of a mechanism: finding and reading them, and writing its YAML."""

import os
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from legcal.errors import BadValue, Code, ModelError, Problem, Problems
from legcal.files.folder import RESULT, with_schema
from legcal.files.motions import MotionEntry
from legcal.files.schema import (
    FileSchema,
    Number,
    PlainName,
    Version,
    closest,
    content_of,
    parse_yaml,
    validate,
)
from legcal.machine.actuator import Actuator
from legcal.machine.chain import Closure, ClosureKind
from legcal.machine.tolerance import BuiltEntry

_PACKAGE = Path(__file__).resolve().parents[1]

FOLDER_YAML = "robot.yaml"  # mechanism YAML in a folder, as named by Gepetto
DATASET_YAML = "dataset.yaml"
RESULT_YAML = "calibrated.yaml"  # mechanism YAML in a result folder


def shipped_folder(name: str) -> Path:
    """Return a folder shipped with legcal, in a wheel or in a checkout."""
    folders = [top / name for top in (_PACKAGE / "shipped", _PACKAGE.parent)]
    return next((folder for folder in folders if folder.is_dir()), folders[0])


def shipped_names() -> list[str]:
    """Return the names of the shipped models."""
    return sorted(path.stem for path in shipped_folder("models").glob("*.yaml"))


def find_model(model: str | Path) -> Path:
    """Return the file of a mechanism, from a path or the name of a shipped model.

    A result folder gives its calibrated model, a folder with a single model in ``models`` that.
    """
    path = Path(model)
    names = shipped_names()
    refused = "the mechanism could not be read"
    if str(model) in names:
        return path if os.path.isfile(path) else shipped_folder("models") / f"{model}.yaml"
    if not os.path.exists(path):
        bad = Problem(
            refused,
            "no such file and no shipped model of that name",
            f"a mechanism YAML, its URDF, or one of {', '.join(names)}",
            "check the path",
            str(path),
            code=Code.MISSING_FILE,
        )
        raise ModelError(bad)
    if not os.path.isdir(path):
        if path.suffix.lower() == ".csv":
            raise dimensions_alone("a CSV file", path)
        return path
    if (path / FOLDER_YAML).is_file():
        return path / FOLDER_YAML
    if RESULT.is_in(path) and (path / RESULT_YAML).is_file():
        return path / RESULT_YAML
    if (path / RESULT_YAML).is_file():
        raise ModelError(
            refused,
            f"{RESULT_YAML} and no whole {RESULT.marker} of a calibration",
            "both",
            f"copy the result folder again, or give {path / RESULT_YAML} if it is the model that "
            "you mean",
            path,
        )
    if (path / DATASET_YAML).is_file():
        raise ModelError(what_a_dataset_is_for(path))
    written = sorted((path / "models").glob("*.yaml"))  # by new, inspect and locate
    if len(written) == 1:
        return written[0]
    needed = "a folder with one model, a result folder, or a YAML, URDF or MJCF file"
    found = f"a folder without {FOLDER_YAML} and with {len(written) or 'no'} models/*.yaml"
    raise ModelError(refused, found, needed, "give the file", path)


def dimensions_alone(kind: str, path: Path) -> ModelError:
    """Return the refusal of a file that holds dimensions of a machine but is no model."""
    return ModelError(
        f"the mechanism could not be read: found {kind}, needed a mechanism YAML, URDF or MJCF "
        f"file; make a model of its dimensions with: legcal new {path} -o DIR",
        file=path,
    )


def what_a_dataset_is_for(path: Path) -> Problem:
    """Return the problem of a dataset given as a model, with the commands for datasets."""
    folder = shlex.quote(str(path.parent if path.name == DATASET_YAML else path))
    return Problem(
        "the mechanism could not be read: found a dataset, needed a model; give the model that it "
        f"names, or judge the dataset with: legcal identify {folder}, and calibrate it with: "
        f"legcal calibrate {folder} -o OUT",
        file=str(path),
    )


def find_urdf(yaml_path: Path, written: str | None) -> Path:
    """Return the URDF of a mechanism YAML: the stated one, or the same stem nearby."""
    if written is not None:
        path = yaml_path.parent / written
        return path.resolve() if ".." in path.parts else path
    near = [yaml_path.with_suffix(".urdf"), _sibling(yaml_path, "urdf").with_suffix(".urdf")]
    for path in near:
        if path.is_file():
            return path
    bad = Problem(
        "the URDF of the mechanism could not be found",
        f"neither {near[0]} nor {near[1]}",
        "one of them",
        "write its path in legcal.urdf",
        str(yaml_path),
        code=Code.MISSING_FILE,
    )
    raise ModelError(bad)


def is_xml(path: Path) -> bool:
    """Return whether a file of a mechanism is XML, by its content."""
    return content_of(path, FILE_KIND, ModelError).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")


def yaml_of_urdf(path: Path) -> Path | None:
    """Return the mechanism YAML near a URDF, or None."""
    near = [path.with_suffix(".yaml"), _sibling(path, "models").with_suffix(".yaml")]
    return next((candidate for candidate in near if candidate.is_file()), None)


def _sibling(path: Path, folder: str) -> Path:
    """Return the path of a file of the same name in a sibling folder."""
    return path.resolve().parent.parent / folder / path.name


FILE_KIND = "mechanism file"
MAX_LOOPS = 100
GAINS = (0.5, 2.0)  # range of gains of motors that carry rods; others hint at a wrong unit
MAX_GAIN_ERROR = 1e-12  # tolerance of a gain of 1


def different_legs(names: list[str]) -> list[str]:
    """Refuse a leg that is named more than once."""
    for name in names:
        if names.count(name) > 1:
            raise BadValue(f"the leg '{name}' more than once", "different legs", "name each once")
    return names


FrameLegs = Annotated[list[str], Field(min_length=2, max_length=3), AfterValidator(different_legs)]


class MotorEntry(FileSchema):
    """Numbers of a motor that carries rods which have no place in a URDF."""

    gain: Annotated[Number, Field(ge=GAINS[0], le=GAINS[1])] = 1.0  # motion over reading
    centre_us: Number | None = None  # pulse at joint value 0 [us], of a hobby servo
    us_per_deg: Number | None = None  # negative if longer pulses turn it backwards


class LegcalBlock(BuiltEntry):
    """The block ``legcal``: what belongs to base, platform and legs.

    Missing entries are proposed, see :mod:`legcal.machine.topology`.
    """

    version: Version
    urdf: str | None = None
    base: str
    platform: str
    platform_joint: str | None = None
    base_frame: FrameLegs | None = None
    home: MotionEntry | None = None
    home_readings: dict[str, float] | None = None  # readings of actuators at home [m or rad]
    motors: dict[str, MotorEntry] | None = None  # motors that carry rods, by joint
    reach: Annotated[float, Field(gt=0.0)] | None = None  # of the platform from the z axis [m]
    floor: float | None = None  # its lowest z [m]
    legs: Annotated[dict[PlainName, str], Field(min_length=1)]


def _small_letters(kind: object) -> object:
    return kind.lower() if isinstance(kind, str) else kind


class MechanismFile(BaseModel):
    """A mechanism YAML; keys of other programs are ignored."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False, extra="ignore", defer_build=True)

    closed_loop: Annotated[
        list[Annotated[list[str], Field(min_length=2, max_length=2)]], Field(min_length=1)
    ]
    type: list[Annotated[ClosureKind, BeforeValidator(_small_letters)]]
    name_mot: list[str]
    joint_name: list[str] = []
    joint_type: list[str] = []
    legcal: LegcalBlock | None = None

    @property
    def closures(self) -> tuple[Closure, ...]:
        """The closures in the order of the file."""
        pairs = zip(self.closed_loop, self.type, strict=True)
        return tuple(Closure(kind, (first, second)) for (first, second), kind in pairs)


def read_mechanism_file(path: Path) -> MechanismFile:
    """Return a mechanism YAML, checked in itself (names are checked against the URDF later)."""
    content = content_of(path, FILE_KIND, ModelError)
    lines = (line.strip() for line in content.splitlines())
    first = next((line for line in lines if line and line[:1] not in b"#;"), b"")
    for kind, pattern in _OTHER_TEXT.items():
        if pattern.match(first):
            raise dimensions_alone(kind, path)
    document = parse_yaml(content, path, FILE_KIND, ModelError)
    if "legcal_table" in document:
        raise dimensions_alone("a table of legs (legcal_table)", path)
    if path.name == DATASET_YAML:
        raise ModelError(what_a_dataset_is_for(path))
    optional = ("joint_name", "joint_type")  # YAML reads an empty list as null
    stated = {k: v for k, v in document.items() if v is not None or k not in optional}
    file = validate(MechanismFile, stated, path, kind=ModelError)
    _check_contradictions(file, path)
    return file


_OTHER_TEXT = {  # kinds of files of other programs, by the first line that is no comment
    "a HAL file of LinuxCNC": re.compile(rb"(loadrt|loadusr|setp|net|addf)\s"),
    "a configuration with [sections]": re.compile(rb"\[[\w .:-]+\]\s*([#;].*)?$"),
    "G-code": re.compile(rb"[GM]\d+(\s|$)"),
}


def _check_contradictions(file: MechanismFile, path: Path) -> None:
    """Refuse contradictions within the file."""
    problems, n_pairs = Problems(path), len(file.closed_loop)
    refused = "the loops could not be closed"
    if len(file.type) != n_pairs:
        counts = f"{n_pairs} pairs in closed_loop and {len(file.type)} entries in type"
        problems.add(refused, counts, "equal numbers", "write one type for each pair")
    if n_pairs > MAX_LOOPS:
        at_most = f"at most {MAX_LOOPS}"
        problems.add(refused, f"{n_pairs} pairs in closed_loop", at_most, "give one mechanism")
    if len(file.joint_name) != len(file.joint_type):
        counts = f"{len(file.joint_name)} names and {len(file.joint_type)} entries in joint_type"
        refused, remedy = "joint_name could not be used", "write one type for each joint"
        problems.add(refused, counts, "equal numbers", remedy)
    for name in sorted({name for name in file.name_mot if file.name_mot.count(name) > 1}):
        refused, remedy = "name_mot could not be used", "remove the repetition"
        problems.add(refused, f"'{name}' more than once", "each motor once", remedy)
    legs = file.legcal.legs if file.legcal else {}
    for name in (file.legcal and file.legcal.base_frame) or ():
        if name not in legs:
            refused, remedy = "legcal.base_frame could not be used", closest(name, legs)
            problems.add(refused, f"'{name}', which is not a leg", remedy=remedy)
    problems.raise_if_any()


def motor_entries(actuators: Sequence[Actuator]) -> dict[str, Any]:
    """Return the YAML entries of actuators that a URDF cannot hold, by joint."""
    entries = dict[str, dict[str, float]]()
    for actuator in actuators:
        entry = {} if abs(actuator.gain - 1.0) <= MAX_GAIN_ERROR else {"gain": actuator.gain}
        if actuator.pulses is not None:
            entry["centre_us"] = actuator.pulses.centre
            entry["us_per_deg"] = actuator.pulses.per_degree
        if entry:
            entries[actuator.joint] = entry
    return entries


_OPTIONAL = ("home_readings", "motors", "spline_teeth", "reach")  # left out where empty


def mechanism_yaml(
    loops: Sequence[tuple[str, str, str]], motors: Sequence[str], legcal: dict[str, Any]
) -> str:
    """Return the YAML of a mechanism from closures (two frames, kind), motors and block."""
    return yaml_text(
        {
            "closed_loop": [[first, second] for first, second, _ in loops],
            "type": [kind for *_, kind in loops],
            "name_mot": motors,
            "joint_name": [],
            "joint_type": [],
            "legcal": {"version": 1} | {k: x for k, x in legcal.items() if x or k not in _OPTIONAL},
        }
    )


def yaml_text(document: dict[str, Any]) -> str:
    """Return a mechanism YAML from its entries."""
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=False, allow_unicode=True)
    return with_schema("mechanism", text)
