"""What is damaged: a valid file of each kind, and the command that reads it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from made_inputs import MAKERS, made_input
from photograph_files import exif, jpeg, tiff


@dataclass(frozen=True)
class Subject:
    """A file of a made input, and a command that reads it.

    ``command`` holds the words after ``legcal``; ``{in}`` is the folder with the damaged file,
    ``{out}`` a place where nothing is.
    """

    input: str
    file: str
    command: str
    deep: bool = False  # the command works for long where the file is still valid
    share: float = 1.0  # how often it is drawn, in comparison with others

    @property
    def name(self) -> str:
        """Its input and file, in one word."""
        return f"{self.input}:{self.file}"

    @property
    def kind(self) -> str:
        """How the file is damaged: its suffix."""
        suffix = Path(self.file).suffix.removeprefix(".")
        return {"yml": "yaml", "tif": "tiff", "jpeg": "jpg", "jsonl": "json"}.get(suffix, suffix)


SUBJECTS = (
    Subject("model", "models/hexapod.yaml", "inspect {in}/models/hexapod.yaml"),
    Subject("model", "urdf/hexapod.urdf", "inspect {in}/models/hexapod.yaml"),
    Subject("gepetto", "machine/robot.yaml", "inspect {in}/machine"),
    Subject("gepetto", "machine/robot.urdf", "inspect {in}/machine", share=0.5),
    Subject("loop_joint", "machine.urdf", "inspect {in}/machine.urdf", share=0.5),
    Subject("mjcf", "machine.xml", "inspect {in}/machine.xml"),
    Subject("tables", "tripod.csv", "new {in}/tripod.csv --unit mm -o {out}"),
    Subject("tables", "3-rpr.yaml", "new {in}/3-rpr.yaml -o {out}", share=0.5),
    Subject("small", "dataset.yaml", "detect {in} -o {out}"),
    Subject("small", "measurements.csv", "detect {in} -o {out}"),
    Subject("small", "camera_info.yaml", "detect {in} -o {out}"),
    Subject("small", "images/c1_1.png", "detect {in} -o {out}"),
    Subject("pictures", "images/c1_1.tiff", "detect {in} -o {out}"),
    Subject("pictures", "images/c2_1.jpg", "detect {in} -o {out}", share=0.3),
    Subject("tool-poses", "hexapod.csv", "locate hexapod {in}/hexapod.csv -o {out}", deep=True),
    Subject("3-rpr-outlines", "dataset.yaml", "calibrate {in} -o {out}", deep=True),
    Subject("3-rpr-outlines", "measurements.csv", "calibrate {in} -o {out}", deep=True),
    Subject("3-rpr-outlines", "observations.csv", "calibrate {in} -o {out}", deep=True),
    Subject("3-rpr-outlines", "camera_info.yaml", "calibrate {in} -o {out}", deep=True),
    Subject("result", "result/result.json", "calibrate {in}/set --check {in}/result", deep=True),
    Subject("result", "result/calibrated.yaml",
            "evaluate {in}/result/calibrated.yaml 3-rpr", deep=True),
    Subject("settings", "poses.csv",
            "simulate 3-rpr --level outlines --poses {in}/poses.csv -o {out}", deep=True),
    Subject("settings", "camera.yaml", "simulate 3-rpr --level outlines --poses 4 --camera "
            "{in}/camera.yaml -o {out}", deep=True),
    Subject("settings", "board.png", "camera {in}/board.png --board chessboard:5x4:20mm -o {out}"),
)  # fmt: skip


def _small(folder: Path) -> None:
    """Keep one picture of each view of a small dataset: where all is valid, each is searched."""
    shutil.copytree(made_input("plain"), folder, dirs_exist_ok=True)
    table = folder / "measurements.csv"
    table.write_text("".join(x for x in table.read_text().splitlines(True) if "_2.png" not in x))
    for name in ("c1_2", "c2_2"):
        (folder / f"images/{name}.png").unlink()


def _pictures(folder: Path) -> None:
    """Save the two pictures of a small dataset in other formats."""
    shutil.copytree(made_input("small"), folder, dirs_exist_ok=True)
    text = (folder / "measurements.csv").read_text()
    said = exif(make="Acme", model="One", focal=4.25, zoom=1.0, width=64, height=48, lens="Back")
    for name, suffix in (("c1_1", "tiff"), ("c2_1", "jpg")):
        picture = cv2.imread(str(folder / f"images/{name}.png"), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        content = tiff(picture) if suffix == "tiff" else jpeg(picture, 80, said)
        (folder / f"images/{name}.{suffix}").write_bytes(content)
        text = text.replace(f"{name}.png", f"{name}.{suffix}")
    (folder / "measurements.csv").write_text(text)


def _settings(folder: Path) -> None:
    """Write what simulate reads beside a model, and the picture of a board."""
    shutil.copy(made_input("plain") / "camera_info.yaml", folder / "camera.yaml")
    header = "leg1_prismatic,leg2_prismatic,leg3_prismatic"
    (folder / "poses.csv").write_text(f"{header}\n0.05,0.06,0.07\n0.08,0.06,0.05\n0.07,0.09,0.06\n")
    squares = np.kron(np.indices((7, 8)).sum(axis=0) % 2, np.ones((24, 24)))
    cv2.imwrite(str(folder / "board.png"), (40 + 170 * squares).astype(np.uint8))


MAKERS |= {"small": _small, "pictures": _pictures, "settings": _settings}
