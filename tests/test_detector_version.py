"""What the detector measures in six fixed photographs: kept outlines depend on its version.

Run this file to record the values again, once DETECTOR_VERSION is raised.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from legcal.calibration.fitting import rough_scene
from legcal.calibration.joint_fit.choices import Choices
from legcal.calibration.run import start_run
from legcal.data import Outlines, load_dataset
from legcal.perception import Placement, measure_photographs, observe
from legcal.perception.photographs import DETECTOR_VERSION
from legcal.progress import no_progress
from legcal.workers import in_turn

FOLDER = Path(__file__).parent / "data" / "six-photographs"
VALUES = FOLDER / "values.json"
PX, PART = 1e-3, 1e-3  # that other versions of libraries may change: [px], of covariances


def measured() -> dict[str, Any]:
    """Return the outlines as observed at first, and as measured again near there."""
    dataset = load_dataset(FOLDER)
    run = start_run(dataset, in_turn, no_progress, Choices(), use_cache=False)
    nominal, _ = rough_scene(run)
    observed = observe(run.photographs, nominal, no_progress)
    again = replace(observed.photographs, keep=run.photographs.keep)
    found = observed.placement
    near = Placement.of_fit(found.A_base, found.B_base, found.T_base_camera, observed.blur)
    tables = {"first": observed.outlines, "again": measure_photographs(again, near, no_progress)}
    return {name: _listed(outlines) for name, outlines in tables.items()}


def _listed(outlines: Outlines) -> list[Any]:
    """Return what is compared of each outline: its key, what is wrong, ends [px], covariance."""
    return [
        [*key, reason.split(",")[0], *np.nan_to_num(ends, nan=-1.0).ravel().round(5).tolist(),
         *np.nan_to_num(C[[0, 0, 1], [0, 1, 1]], nan=-1.0).round(8).tolist()]
        for key, reason, ends, C in zip(
            outlines.row_keys(), outlines.reason, outlines.ends, outlines.covariance, strict=True
        )
    ]  # fmt: skip


def test_values_change_only_with_the_version() -> None:
    stored = json.loads(VALUES.read_text(encoding="utf-8"))
    assert stored["version"] == DETECTOR_VERSION, "record the values again: run this file"
    found = measured()
    for name in ("first", "again"):
        assert len(found[name]) == len(stored[name])
        for new, old in zip(found[name], stored[name], strict=True):
            assert new[:5] == old[:5], f"{name}: raise DETECTOR_VERSION"
            assert np.allclose(new[5:9], old[5:9], rtol=0, atol=PX), f"{name}: raise it, {new[:5]}"
            assert np.allclose(new[9:], old[9:], rtol=PART, atol=1e-6), f"{name}: raise it"


if __name__ == "__main__":
    lines = [
        f'"{name}": [\n' + ",\n".join(json.dumps(row) for row in rows) + "\n]"
        for name, rows in measured().items()
    ]
    text = ",\n".join([f'"version": {DETECTOR_VERSION}', *lines])
    VALUES.write_text("{\n" + text + "\n}\n", encoding="utf-8")
