"""Make the JSON Schemas of the formats: ``python tests/format_schemas.py`` writes them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, RootModel, create_model
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from legcal.calibration.camera_calibration.document import CameraDocument
from legcal.calibration.camera_calibration.projection import CameraComparisonDocument
from legcal.calibration.detection import ExaminationDocument
from legcal.calibration.documents import CheckDocument, DiagnosisBlock, EvaluationDocument, Result
from legcal.calibration.identify.report import Identifiability
from legcal.calibration.location.document import LocationFile
from legcal.data.dataset_file import DatasetEntry
from legcal.data.new_dataset import NewDatasetDocument
from legcal.descriptions.table import TableFile
from legcal.exports.formats import ExportDocument
from legcal.files.folder import write_schemas
from legcal.files.schema import Document, SparseDocument
from legcal.machine.files import MechanismFile
from legcal.machine.inspection import Inspection
from legcal.planning.session import PlanDocument
from legcal.recordings.importing import ImportDocument
from legcal.simulation.dataset import SimulationDocument
from legcal.simulation.paper import PaperDocument
from legcal.vision.board import AprilgridEntry, CharucoEntry, ChessboardEntry
from legcal.vision.camera_file import RosEntry

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "legcal/files/schemas"

Board = Annotated[ChessboardEntry | CharucoEntry | AprilgridEntry, Field(discriminator="kind")]
FILES: Mapping[str, type[BaseModel]] = {  # that people write
    "dataset": create_model(
        "Dataset",
        __base__=DatasetEntry,
        __doc__=DatasetEntry.__doc__,
        board=(Board | Annotated[list[Board], Field(min_length=1)] | None, None),
    ),
    "mechanism": MechanismFile,
    "table": TableFile,
    "camera": RosEntry,
}


class _ModelFiles(Document):
    yaml: str
    urdf: str


class _TemplateFiles(Document):
    yaml: str
    csv: str


class _Created(Inspection):
    paths: _ModelFiles


class _Template(Document):
    paths: _TemplateFiles


class _NewDocument(RootModel[_Created | _Template]):
    """What ``legcal new --json`` prints, and ``legcal new --template --json``."""


class _Problem(SparseDocument):
    code: str
    what: str
    found: str | None = None
    needed: str | None = None
    remedy: str | None = None
    file: str | None = None
    row: int | None = None  # 0: the header
    line: int | None = None
    columns: list[str] | None = None
    name: str | None = None


class _Error(SparseDocument):
    kind: str
    message: str
    problems: list[_Problem] | None = None


class _ErrorDocument(Document):
    """What every command prints with ``--json`` where it fails."""

    error: _Error
    diagnosis: list[DiagnosisBlock] | None = None


DOCUMENTS: Mapping[str, type[BaseModel]] = {  # that legcal writes
    "error": _ErrorDocument,
    "inspect": Inspection,
    "new": _NewDocument,
    "identify": Identifiability,
    "plan": PlanDocument,
    "init": NewDatasetDocument,
    "import": ImportDocument,
    "example": create_model("Example", __base__=Document, path=(str, ...)),
    "export": ExportDocument,
    "simulate": SimulationDocument,
    "study": PaperDocument,
    "locate": create_model("Locate", __base__=LocationFile, written=(list[str], ...)),
    "location": LocationFile,
    "result": Result,
    "check": CheckDocument,
    "evaluate": EvaluationDocument,
    "doctor": ExaminationDocument,
    "camera-calibration": CameraDocument,
    "camera-comparison": CameraComparisonDocument,
}


class _AsRead(GenerateJsonSchema):
    """Schemas of what is read: YAML takes names such as 1 for numbers, reading makes them text."""

    def str_schema(self, schema: core_schema.StringSchema) -> JsonSchemaValue:
        found = super().str_schema(schema)
        return (
            {**found, "type": ["string", "number"]} if self._config.coerce_numbers_to_str else found
        )


NAMES = tuple(sorted({**FILES, **DOCUMENTS}))


def schema_of(name: str) -> dict[str, Any]:
    """Return the schema of a format."""
    model = {**FILES, **DOCUMENTS}[name]
    found = model.model_json_schema(schema_generator=_AsRead)
    found = {"$schema": "https://json-schema.org/draft/2020-12/schema", **found}
    return {**found, "title": f"legcal {name}"}


def schema_text(name: str) -> str:
    """Return the text of the file of a schema."""
    return json.dumps(schema_of(name), indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    """Write all schemas, and those beside the YAML files of this tree that name them."""
    FOLDER.mkdir(exist_ok=True)
    for name in NAMES:
        (FOLDER / f"{name}.json").write_text(schema_text(name), encoding="utf-8")
    for folder in ("examples", "models"):
        for path in sorted((ROOT / folder).rglob("*.yaml")):
            write_schemas(path)


if __name__ == "__main__":
    main()
