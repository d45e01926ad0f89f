"""A home outside the travel: a note where it is near, a refusal where no motor goes."""

from pathlib import Path

import pytest
from mechanisms import SHIPPED_URDF, SHIPPED_YAML

from legcal.calibration.identify.identifiability import identifiability
from legcal.errors import ModelError
from legcal.machine import legs_outside, load_mechanism


def _with_home(folder: Path, z: float) -> Path:
    """Write the shipped hexapod (travel 0.144 m) with its home at a height."""
    text = SHIPPED_YAML.read_text()
    start, end = text.index("  home:"), text.index("  legs:")
    home = f"  home: {{xyz: [0, 0, {z}], quat_xyzw: [0, 0, 0, 1]}}\n"
    path = folder / "hexapod.yaml"
    path.write_text(f"{text[:start]}{home}{text[end:]}".replace("../urdf/", ""))
    (folder / "hexapod.urdf").write_bytes(SHIPPED_URDF.read_bytes())
    return path


@pytest.mark.parametrize("z", [5.0, 0.75])
def test_a_home_further_out_than_the_travel_is_refused_with_both_numbers(
    z: float, tmp_path: Path
) -> None:
    found = rf"legcal\.home could not be used: found leg 'leg\d' at {'46' if z > 1 else '4'}\d\d\."
    with pytest.raises(ModelError, match=rf"{found}.*5 more legs.*travel of .* to .* mm") as caught:
        load_mechanism(_with_home(tmp_path, z))
    assert len(caught.value.problems) == 1


def test_a_home_between_is_noted_and_identify_says_that_its_poses_go_there(tmp_path: Path) -> None:
    machine = load_mechanism(_with_home(tmp_path, 0.55))
    assert len(legs_outside(machine)) == 6
    assert sum("outside its travel" in note for note in machine.diagnostics) == 6
    notes = identifiability(machine, [machine.leg_names], 3).notes
    assert any("outside their travel by more than 5 %" in note for note in notes)


def test_a_home_inside_is_not_worth_a_word() -> None:
    machine = load_mechanism("hexapod")
    assert legs_outside(machine) == {}
    assert not any("outside" in note for note in machine.diagnostics)
