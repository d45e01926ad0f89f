"""Damaged files of every kind that is read: refused in a sentence, or used; never anything else."""

from pathlib import Path

from fuzzing.running import count_cases, drawn_cases
from machines import copied_model

from legcal import LegcalError, load_mechanism


def test_mutated_files_are_used_or_refused_in_time_and_memory() -> None:
    """A sample of what ``benchmarks/fuzz.py`` draws by the ten thousand."""
    cases = drawn_cases(2000, seed=0, deep_share=0.0)[::160]
    count = count_cases(cases)
    assert count.n_cases == len(cases)
    assert not count.faults, [(ended.case.name, ended.fault) for ended in count.faults]
    assert min(count.codes["0"], count.codes["2"]) > 0


def test_text_from_files_is_shown_on_one_short_line_without_control_characters() -> None:
    bad = "\x1b]0;x\x07 \x9b31m \u202e \u2066 \u200f \u2028 \x85 \ufeff \r\n\t \x00 \ud800"
    (shown,) = LegcalError(f"{bad} {'x' * 3_000_000} {'many words ' * 10_000} ¼±°ä€🤖").problems
    assert shown.isprintable()
    assert len(shown) < 5000
    assert "\\x1b" in shown
    assert shown.endswith("¼±°ä€🤖")
    many = LegcalError([f"problem {'a' * k}: it is {'b ' * 1000}" for k in range(100)])
    assert len(str(many)) < 20_000
    assert str(many).endswith("... and 93 more.")
    assert len(many.problems) == 100
    plain = "leg 'leg1-a': found 0.42 mm, needed ±1 µm; correct it."
    assert str(LegcalError(plain)) == plain


def test_a_hyphen_inside_a_name_is_part_of_it(tmp_path: Path) -> None:
    name = "leg1-prismatic=a@b+c"
    path = copied_model(tmp_path, "hexapod", lambda text: text.replace("leg1_prismatic", name))
    path.write_text(path.read_text().replace("leg1_prismatic", name))
    assert name in load_mechanism(path).urdf.joints
