"""Input that no other test's file is about: values beyond reason, names, paths, full disks."""

import errno
import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from dataset_folder import HEXAPOD, Folder, folder

from legcal import cli
from legcal.data.dataset import load_dataset
from legcal.errors import DatasetError, ModelError, OutOfResources, UsageError
from legcal.files.folder import check_destination, result_folder
from legcal.files.schema import closest, parse_yaml
from legcal.machine import load_mechanism

__all__ = ["folder"]

LONG = "a" * 400


@pytest.mark.parametrize("sigma", [1e300, 1e-300, True, "two", 90])
def test_an_encoder_sigma_that_no_encoder_has_is_refused(folder: Folder, sigma: Any) -> None:
    folder.entry["encoder_sigma"] = sigma
    with pytest.raises(DatasetError, match="encoder_sigma could not be") as refused:
        load_dataset(folder.write())
    assert len(refused.value.problems) == 1


@pytest.mark.parametrize("name", ["", " c1", "c\n1", "\x1b[31m"])
def test_a_view_whose_name_a_table_cannot_hold_is_refused(folder: Folder, name: str) -> None:
    folder.entry["views"][name] = folder.entry["views"]["c2"]
    with pytest.raises(DatasetError, match="needed printable characters"):
        load_dataset(folder.write())


@pytest.mark.parametrize("key", ["mechanism", "measurements"])
def test_a_path_that_is_too_long_is_no_such_file(
    folder: Folder,
    key: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("legcal.data.dataset.load_mechanism", load_mechanism)
    folder.entry[key] = LONG
    with pytest.raises((DatasetError, ModelError), match="found no such file"):
        load_dataset(folder.write())


def test_folders_whose_names_are_too_long_are_refused() -> None:
    with pytest.raises(DatasetError, match="found no"):
        load_dataset(LONG)
    with pytest.raises(UsageError, match="File name too long"):
        check_destination(Path(LONG))


@pytest.mark.parametrize("value", ["!!bool abc", "!!timestamp abc", '!!int ""', "2001-99-99"])
def test_a_value_that_is_not_of_its_tag_is_found_by_its_line(value: str) -> None:
    with pytest.raises(DatasetError, match=r"line 2, column 4: .* which is no \w+, needed YAML"):
        parse_yaml(f"a: 1\nb: {value}\n".encode(), Path("x.yaml"), "file")


@pytest.mark.parametrize(("old", "new"), [("- 0.38274", "- 1.0e+308"), ("leg2: leg2", '"": leg2')])
def test_a_home_beyond_reason_and_a_leg_without_a_name_are_refused(
    tmp_path: Path, old: str, new: str
) -> None:
    text = HEXAPOD.read_text()
    assert old in text
    path = tmp_path / "hexapod.yaml"
    path.write_text(text.replace(old, new))
    with pytest.raises(ModelError, match=r"needed a number less than|needed letters, digits"):
        load_mechanism(path)


@pytest.mark.parametrize("name", ["leg1,", "../xleg1", "leg 1", "a" * 101, "-leg"])
def test_a_leg_whose_name_is_no_plain_one_is_refused_as_in_tables(
    tmp_path: Path, name: str
) -> None:
    path = tmp_path / "hexapod.yaml"
    path.write_text(HEXAPOD.read_text().replace("leg2: leg2", f'"{name}": leg2'))
    with pytest.raises(ModelError, match=r"legs.*, the first a letter or digit.*; rename it"):
        load_mechanism(path)


def test_a_result_on_a_full_disk_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    def write() -> None:
        with result_folder(tmp_path / "out") as new:
            (new / "result.json").write_text("{}")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutOfResources, match=r"No space.*nothing was written"):
        write()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "stdout"), [([], "/dev/full"), (["--json"], "/dev/full"), (["--json"], None)]
)
def test_output_that_cannot_be_printed_is_said_on_stderr(
    words: list[str], stdout: str | None
) -> None:
    if stdout is not None and not Path(stdout).exists():
        pytest.skip("there is no device that is always full")
    redirection = f"> {stdout}" if stdout else ">&-"
    command = f'"{sys.executable}" -m legcal inspect hexapod {" ".join(words)} {redirection}'
    done = subprocess.run(
        ["/bin/sh", "-c", command], stderr=subprocess.PIPE, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("legcal: The output could not be printed: found ")
    assert done.stderr.count("\n") == 1


def test_a_failure_is_json_where_stdout_takes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "argv", ["legcal", "inspect", LONG, "--json"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    assert json.loads(out.getvalue())["error"]["kind"] == "ModelError"


def test_a_hint_at_known_names_is_short() -> None:
    names = [f"name{k}" for k in range(30)]
    assert closest("name7", names) == "did you mean 'name7'?"
    assert closest("zzz", names) == f"known are: {', '.join(names[:10])} and 20 more"
    assert closest("zzz", names[:10]) == f"known are: {', '.join(names[:10])}"
    assert closest("zzz", []) == "known are: none"


def test_numbers_to_the_base_sixty_are_texts() -> None:
    found = parse_yaml(b"a: 6:25\nb: [1:30.5, 7]\nc: '1:2'\n", Path("x.yaml"), "file")
    assert found == {"a": "6:25", "b": ["1:30.5", 7], "c": "1:2"}
