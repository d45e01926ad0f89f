"""A machine with a leg that nobody drives or reads: a telescope beside the six motors."""

import io
from pathlib import Path

import numpy as np
import yaml
from mechanisms import SHIPPED_URDF, SHIPPED_YAML
from rich.console import Console

from legcal import evaluate, load_mechanism
from legcal.report import accuracy_table


def _with_a_telescope(folder: Path) -> Path:
    """Write the shipped hexapod with a seventh, passive leg made like the second one."""
    urdf = SHIPPED_URDF.read_text()
    leg = "\n".join(line for line in urdf.splitlines() if 'name="leg2_' in line)
    leg = leg.replace("leg2_", "leg7_")
    for joint, place in (("leg7_b1", "0.01 0.02 0.0"), ("leg7_seat_frame", "0.0 -0.05 0.0")):
        at = leg.index('<origin xyz="', leg.index(f'<joint name="{joint}"')) + len('<origin xyz="')
        leg = leg[:at] + place + leg[leg.index('"', at) :]
    entry = yaml.safe_load(SHIPPED_YAML.read_text())
    entry["closed_loop"].append(["leg7_end", "leg7_seat"])
    entry["type"].append("3d")
    entry["legcal"]["legs"]["leg7"] = "leg7_prismatic"
    entry["legcal"]["urdf"] = "hexapod.urdf"
    (folder / "hexapod.urdf").write_text(urdf.replace("</robot>", f"{leg}\n</robot>"))
    (folder / "hexapod.yaml").write_text(yaml.safe_dump(entry))
    return folder / "hexapod.yaml"


def test_an_evaluation_leaves_out_the_offset_that_a_passive_leg_does_not_have(
    tmp_path: Path,
) -> None:
    machine = load_mechanism(_with_a_telescope(tmp_path))
    assert (machine.n_legs, machine.mobility, len(machine.motors)) == (7, 6, 6)
    evaluation = evaluate(machine, machine)
    assert "leg7.platform.z" in evaluation.names
    assert "leg7.offset" not in evaluation.names
    assert np.all(evaluation.values == evaluation.references)
    assert all(np.isfinite(row["difference"]) for row in evaluation.document()["parameters"])


def test_without_enough_motors_parameters_alone_are_compared(tmp_path: Path) -> None:
    path = _with_a_telescope(tmp_path)
    entry = yaml.safe_load(path.read_text())
    entry["name_mot"] = [name for name in entry["name_mot"] if name != "leg6_prismatic"]
    path.write_text(yaml.safe_dump(entry))
    evaluation = evaluate(path, path)
    document = evaluation.document()
    assert document["dX_m"] is document["dE_rad"] is document["dX_max_m"] is None
    assert document["poses"] == 0
    assert len(document["parameters"]) > 30
    printed = io.StringIO()
    Console(file=printed, width=80).print(accuracy_table(evaluation))
    assert "Parameters only: readings do not give one pose" in printed.getvalue()
