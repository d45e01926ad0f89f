"""Files that were made to do harm: to take memory or time, to hang, or to write to a terminal."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping

from characterisation.inputs import ROOT, made_input

from fuzzing.running import Case
from fuzzing.subjects import SUBJECTS, Subject

_NAMED = {subject.name: subject for subject in SUBJECTS}
DETECT = "detect {in} -o {out}"
CALIBRATE = "calibrate {in} -o {out}"


def harmful_files() -> Iterator[tuple[str, Case, str]]:
    """Yield a name, the file, and a word of the refusal; some are as large as is read."""
    for name, text, word in _yaml(1_900_000, 900_000):
        for file in ("small:dataset.yaml", "small:camera_info.yaml")[: 1 + (len(text) < 10_000)]:
            yield f"{name} as {file}", Case(_NAMED[file], made=text), word
    for name, file, made, word in (
        *_names(),
        *_tables(40_000),
        *_outlines(),
        *_results(),
        *_models(900, 199),
        *_images(10_000),
    ):
        yield f"{name} as {file}", Case(_NAMED[file], made=made), word


def special_files() -> Iterator[tuple[str, Case]]:
    """Yield pipes, devices and folders in the place of everything that is read."""
    study = "study paper --runs 1 --workers 1 --seed 1 -o {in}/study"
    result = "calibrate {in}/set --check {in}/result"
    places = (
        *((subject.input, subject.file, subject.command) for subject in SUBJECTS),
        ("small", "observations.csv", DETECT),
        ("small", ".legcal-cache.json", "detect {in} -o {in}/found"),
        ("small", "axes.csv", CALIBRATE),
        ("small", "corners.csv", CALIBRATE),
        ("small", "found/detection.json", "detect {in} -o {in}/found"),
        ("small", "found/result.json", "calibrate {in} -o {in}/found"),
        ("small", "found/camera.yaml", "camera {in}/images/c1_1.png --board chessboard:5x4:20mm "
         "-o {in}/found/camera.yaml"),
        ("small", "study/runs.jsonl", study),
        ("result", "set/observations.csv", result),
    )  # fmt: skip
    for source, file, command in places:
        for special in ("pipe", "folder", "/dev/zero"):
            case = Case(Subject(source, file, command), special=special)
            yield f"{special} as {case.subject.name}", case


def _yaml(n_digits: int, n_numbers: int) -> Iterator[tuple[str, bytes, str]]:
    merged = ["a0: &a0 {x: 1, y: 2}"]
    lists = ["a0: &a0 [1, 2]"]
    for k in range(1, 12):
        merged.append(f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}")
        lists.append(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]")
    yield "merge keys", "\n".join(merged).encode(), "merge keys"
    yield "aliases", "\n".join(lists).encode(), "values"
    yield "deep nesting", b"a: " + b"[" * 100_000, "levels"
    yield "deep mappings", b"a: " + b"{a: " * 30_000, "levels"
    yield "many numbers", b"a: [" + b"1," * n_numbers + b"]", "values"
    yield "more numbers", b"a: [" + b"1," * 1_900_000 + b"]", "at most 2000000"
    yield "two million numbers", b"a: [" + b"1," * 2_000_000 + b"]", "at most 2000000"
    yield "more keys", b"".join(b"k%d: 1\n" % k for k in range(350_000)), "bytes"
    yield "unknown keys", b"".join(b"k%d: 1\n" % k for k in range(10_000)), "k"
    yield "a long number", b"a: " + b"1" * n_digits, "a"
    for digits in (b"1" * 400, b"-" + b"1" * 400, b"0x" + b"f" * 10_000, b"0b" + b"1" * 20_000):
        yield f"{digits[:4]!r} and so on", b"a: {b: [0, " + digits + b"]}", "a.b.1 could not"
    yield "a long word", b"a" * 1_900_000, "text"
    yield "a long key", b"k" * 900 + b": 1", "k"
    yield "escapes", b'"\\e[31m\\u202e": 1\n"\\x9b": &a [*a]', ""
    yield "an unknown tag", b"a: !\xe2\x80\xae\xc2\x9b x", ""


def _names() -> Iterator[tuple[str, str, bytes, str]]:
    text = (made_input("small") / "dataset.yaml").read_bytes()
    table = (made_input("small") / "measurements.csv").read_bytes()
    gepetto = (made_input("formats") / "gepetto/robot.yaml").read_bytes()
    planar = (made_input("formats") / "planar.xml").read_bytes()
    for name in (b"=1+1", b"+c1", b"-c1", b'"@c1"', b'"\\e[31mc1"', b'"c1\\u202e"'):
        yield (
            f"view {name!r}",
            "small:dataset.yaml",
            text.replace(b"  c1:", b"  %s:" % name),
            "name",
        )
        made = table.replace(b"images/c1_1.png", name.strip(b'"'))
        if b"\\" not in name:
            yield f"image {name!r}", "small:measurements.csv", made, "= + - @"
    made = planar.replace(b'"q0"', b'"=q0"')
    yield "a formula in MJCF", "formats:planar.xml", made, "= + - @"
    made = gepetto.replace(b"leg1_end", b"leg1_ent")
    yield "an unknown frame", "formats:gepetto/robot.yaml", made, "leg1_ent"


def _tables(n_bad: int) -> Iterator[tuple[str, str, bytes, str]]:
    table = "small:measurements.csv"
    lines = (made_input("small") / "measurements.csv").read_bytes().splitlines()
    for digits in (b"1" * 130_000 + b"x", b"1" * 130_000, b"." + b"1" * 130_000 + b"e"):
        row = lines[1].rsplit(b",", 1)[0] + b"," + digits
        yield "long digits", table, b"\n".join([lines[0], *[row] * 25]), "number"
    yield "long cells", table, lines[0] + b"\n" + b"1" * 140_000, "limit"
    yield "short rows", table, lines[0] + b"\nc" * 950_000, "rows"
    yield "some short rows", table, lines[0] + b"\nc" * 49_000, "row"
    yield "columns", table, b",".join(b"c%d" % k for k in range(350_000)), "columns"
    yield "unknown columns", table, b",".join([*(b"c%d" % k for k in range(299)), b"x\n1"]), "c1"
    yield "one column many times", table, b",".join([b"view"] * 300) + b"\n1", "times"
    yield "bad cells", table, lines[0] + b"\n" + b"\n".join([b"x" + lines[1]] * n_bad), "view"
    long_name = lines[1].replace(b"images/c1_1.png", b"=HYPERLINK(%s)" % (b"x" * 90_000))
    yield "a formula", table, b"\n".join([lines[0], *[long_name] * 40]), "= + - @"
    escape = lines[1].replace(b"images/c1_1.png", b"\x1b[31mred.png")
    yield "an escape sequence", table, b"\n".join([lines[0], escape]), "\\x1b"
    yield "a header of escapes", table, b"\x1b]0;x\x07," + lines[0] + b"\n1\n", "\\x1b"


def _outlines() -> Iterator[tuple[str, str, bytes, str]]:
    outlines = "3-rpr-outlines:observations.csv"
    changes: tuple[dict[str, float], ...] = (
        {"s11": 2.0**64},
        {"s00": 1e8, "s01": 0.0, "s11": 1e8},
        {"s00": 1e-20, "s01": 0.0, "s11": 1e-20},
    )
    for change in changes:
        yield f"{change}", outlines, outlines_with({48: change}), "row 48 (line 49), columns s00"
    table = outlines_with({}).decode().splitlines()
    cells = dict(zip(table[0].split(","), table[48].split(","), strict=True))
    near = {f"{axis}1": float(cells[f"{axis}0"]) + 1e-7 for axis in "uv"}
    yield "ends side by side", outlines, outlines_with({48: near}), "row 48 (line 49), columns u0"


def outlines_with(changes: Mapping[int, Mapping[str, float]]) -> bytes:
    """Return a table of outlines in which numbers of some rows are others."""
    lines = (made_input("3-rpr-outlines") / "observations.csv").read_text().splitlines()
    names = lines[0].split(",")
    for row, numbers in changes.items():
        cells = dict(zip(names, lines[row].split(","), strict=True))
        cells |= {name: repr(float(number)) for name, number in numbers.items()}
        lines[row] = ",".join(cells.values())
    return "\n".join([*lines, ""]).encode()


def _results() -> Iterator[tuple[str, str, bytes, str]]:
    document = json.loads((made_input("result") / "result/result.json").read_text())
    document["residuals"]["dof"] = 10**400
    made = json.dumps(document).encode()
    yield "degrees of freedom", "result:result/result.json", made, "residuals.dof could not"


def _models(n_fixed: int, n_revolutes: int) -> Iterator[tuple[str, str, bytes, str]]:
    for n, word in ((9000, "needed"), (900, "move")):
        yield f"{n} revolutes", "formats:loops.urdf", _chain(n, "revolute"), word
    yield f"{n_fixed} fixed joints", "formats:loops.urdf", _chain(n_fixed, "fixed"), ""
    yield f"{n_revolutes} revolutes", "formats:loops.urdf", _chain(n_revolutes, "revolute"), ""
    planar = (made_input("formats") / "planar.xml").read_bytes()
    made = planar.replace(b'"b1" axis="0 0 1"', b'"b1" axis="0.1 0 1"')
    yield "an axis in the plane of slider and leg", "formats:planar.xml", made, "b1"
    many = _chain(20, "revolute").replace(b"</robot>", b"<loop_joint/>" * 40_000 + b"</robot>")
    yield "many loops", "formats:loops.urdf", many, "loops"
    yield "elements", "formats:loops.urdf", b"<robot>" + b"<a/>" * 900_000 + b"</robot>", "elements"
    urdf = (ROOT / "urdf/hexapod.urdf").read_bytes()
    model = "model:urdf/hexapod.urdf"
    yield "a name of 3 MB", model, urdf.replace(b'"base"', b'"%s"' % (b"b" * 3_000_000), 1), "b"
    for name, word in ((b"&#9;", "joint"), ("\u202e".encode(), "\\u202e"), (b"\xc2\x9b", "\\x9b")):
        made = urdf.replace(b"leg1_prismatic", b"leg1_" + name + b"prismatic")
        yield f"{name!r} in a joint", model, made, word
    yield "a formula", model, urdf.replace(b"leg1_prismatic", b"=leg1_prismatic"), "= + - @"
    yield "no axis", model, urdf.replace(b'<axis xyz="0.0 0.0 1.0"/>', b"<axis/>", 1), "<axis>"
    yield "a broken line", model, urdf.replace(b"<link", b"<li\nnk\n<", 1), "line"


def _chain(n: int, kind: str) -> bytes:
    """Return a URDF of joints in a row, closed to a loop."""
    limit = b'<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
    parts = [b'<robot name="r"><link name="l0"/>']
    for k in range(n):
        parts.append(
            b'<link name="l%d"/><joint name="j%d" type="%s"><parent link="l%d"/>'
            b'<child link="l%d"/><origin xyz="0.1 0 0"/>%s</joint>'
            % (k + 1, k, kind.encode(), k, k + 1, limit)
        )
    parts.append(
        b'<loop_joint name="c" type="spherical"><link1 link="l0"/><link2 link="l%d"/></loop_joint>'
        b"</robot>" % n
    )
    return b"".join(parts)


def _images(n_px: int) -> Iterator[tuple[str, str, bytes, str]]:
    for size in (30_000, 2**31 - 1):
        yield f"{size} px", "settings:board.png", _png(size), "at most 30000 px"
        yield f"{size} px", "small:images/c1_1.png", _png(size), "px"
    made = _png(n_px, rows=bytes(n_px * (n_px + 1)))
    yield f"{n_px} px", "settings:board.png", made, "nothing like"
    named = _png(64, b"\x1b[3m")
    yield "a chunk of escapes", "small:images/c1_1.png", named[:-20] + b"\0" + named[-19:], ""
    heads = (
        b"%YAML:1.0\n---\na: ",
        b'{"opencv-matrix": ',
        b"<?xml version='1.0'?><opencv_storage>",
    )
    for head, opening in zip(heads, (b"- ", b"[", b"<a>"), strict=True):
        yield (
            f"{opening!r} in a storage",
            "small:camera_info.yaml",
            head + opening * 60_000,
            "lists",
        )
    for camera in (2**31 - 1, 10**30, 10**400, 20_000):
        text = (made_input("small") / "camera_info.yaml").read_bytes()
        text = text.replace(b"width: 64", b"width: %d" % camera)
        text = text.replace(b"height: 48", b"height: %d" % camera)
        yield f"{camera} px", "small:camera_info.yaml", text, "image"


def _png(size: int, kind: bytes = b"tEXt", rows: bytes = bytes(1000)) -> bytes:
    header = struct.pack(">IIBBBBB", size, size, 8, 0, 0, 0, 0)
    chunks = (
        (b"IHDR", header),
        (b"IDAT", zlib.compress(rows)),
        (kind, b"x"),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
