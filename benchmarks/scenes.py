"""Recognition in random rendered scenes: identities, cameras and outlines against the truth.

    OMP_NUM_THREADS=1 python benchmarks/scenes.py 1000 [--workers 2] [--results FILE]
    OMP_NUM_THREADS=1 python benchmarks/scenes.py --only SEED -o FOLDER

A scene is a random shipped machine with errors against its nominal model, seen by a random camera
in random light among clutter and behind occluders, in 1 to 8 images at random readings (see
``random_scenes.py``). No rough camera pose and no legs are given. Results are lines of JSON, one a
scene; scenes that the file has already are not made again. ``--only`` writes the images of a
scene with all true outlines (thin), the pairs (grey), and the outlines that were used (thick,
one colour a leg).

Columns of the table: views placed right, refused as ambiguous or for want of legs (of both: where
ideal edges of what is visible leave a doubt as well), placed wrong; legs visible over half their
length in one piece, and the share of them with a used outline: of all, of those in views that were
not refused for an inherent doubt, and of those in views placed right; used outlines, and how many
of them are not on their leg's edge.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from random_scenes import Given, Scene, Truth, draw
from rendered_cylinders import grey_levels
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.outlines import Outlines
from legcal.geometry.types import Array, Image
from legcal.perception.camera_search import place_camera, refined, scores
from legcal.perception.candidate_pairs import (
    CandidatePairs,
    find_candidate_pairs,
    segments_of_reduced,
)
from legcal.perception.outline import measure_outlines
from legcal.perception.pair_matching import CameraPoses, Picture, Pictures, leg_segments
from legcal.perception.placement import Placement, Search, group_views, sensor_extent
from legcal.perception.recognition import TWO_POSES, place_views
from legcal.perception.tuning import JOINT_ERROR
from legcal.perception.view_fit import refine_views
from legcal.vision.cylinder import outlines_of_axis
from legcal.workers import worker_pool

WRONG_PX = 3.0  # an outline this far from the true one is another edge
SAME_TURN, SAME_PLACE = np.deg2rad(10.0), 0.15  # of one camera: angle, part of the distance
IDEAL = (0.02, 0.015, 0.01, 0.0075, 0.0075)  # tolerances of ideal edges, of the leg length
AS_WELL = 0.9  # of the support of the true pose by ideal edges, that leaves a doubt
COLOURS = ((60, 60, 255), (60, 220, 60), (255, 120, 40), (0, 200, 255), (255, 60, 220),
           (220, 220, 0), (120, 160, 255))  # fmt: skip


@dataclass(frozen=True, eq=False)
class Found:
    """What the method made of a scene."""

    placement: Placement
    outlines: Outlines
    seconds: tuple[float, float]  # of the processor: recognition, outlines


def find(given: Given) -> Found:
    """Recognise legs, place the camera and measure outlines, as the pipeline does."""
    n_legs, m = len(given.leg_names), given.measurements
    wanted = np.ones((1, n_legs), dtype=np.bool_)
    search = Search(
        lambda row: grey_levels(given.images[row]), m, given.A_base, given.B_base,
        given.cylinders, wanted, given.leg_names, given.size,
    )  # fmt: skip
    begin = time.process_time()
    rows = np.arange(len(given.images))
    found = place_views(search, rows, [None])
    middle = time.process_time()
    outlines, _ = measure_outlines(search, found, rows.tolist())
    groups = group_views(m, rows, [None], None)
    placement, outlines, _ = refine_views(search, groups, found, outlines)
    seconds = middle - begin, time.process_time() - middle
    return Found(placement, outlines, seconds)


def judge(scene: Scene, found: Found) -> dict[str, Any]:
    """Return what is right and wrong, as a line of the results."""
    given, truth, outlines = scene.given, scene.truth, found.outlines
    T = found.placement.T_base_camera[0]
    error = offsets(given, truth, outlines)
    used = np.flatnonzero(outlines.used)
    wrong = [i for i in used.tolist() if not error[i] <= WRONG_PX]
    seen = truth.visible
    hit = np.zeros_like(seen)
    hit[outlines.row[used], outlines.leg[used]] = True
    refusals = [one.why.words for one in found.placement.unplaced.values()]
    if T is not None:
        verdict = "right" if _same(T, truth.T_base_camera) else "wrong"
    else:
        verdict = "ambiguous" if TWO_POSES in refusals else "not found"
    return {
        "seed": scene.seed, "machine": scene.machine, **scene.settings, "verdict": verdict,
        "doubt": verdict != "right" and has_doubt(scene),
        "visible": seen.sum(axis=1).tolist(), "found": int((seen & hit).sum()),
        "used": len(used), "wrong": len(wrong),
        "wrong_outlines": [
            [int(outlines.row[i]), given.leg_names[outlines.leg[i]], outlines.part[i],
             int(outlines.edge[i]), round(float(error[i]), 1)] for i in wrong
        ],
        "missed": [[int(row), given.leg_names[leg], _reason(outlines, row, leg)]
                   for row, leg in np.argwhere(seen & ~hit).tolist()],
        "seconds": [round(s, 3) for s in found.seconds],
    }  # fmt: skip


def offsets(given: Given, truth: Truth, outlines: Outlines) -> Array:
    """Return how far outlines (n,) are from the true ones at the worse end of the piece [px]."""
    camera, T = given.camera, truth.T_base_camera.inv()
    error = np.full(len(outlines), np.nan)
    for i in np.flatnonzero(np.isfinite(outlines.h).all(axis=1)).tolist():
        row, leg = int(outlines.row[i]), int(outlines.leg[i])
        A, B = T.apply(truth.A_base[row, leg]), T.apply(truth.B_base[row, leg])
        u = (B - A) / np.linalg.norm(B - A)
        main = [c for c in truth.cylinders[leg] if c.link == outlines.part[i]]
        radius = max(main, key=lambda c: c.end - c.start).radius
        h = outlines_of_axis(u, A, radius)[outlines.edge[i] - 1]
        ends = camera.undistort(outlines.ends[i])
        error[i] = np.abs(camera.line_offset(h[None], ends)).max()
    return error


def _reason(outlines: Outlines, row: int, leg: int) -> str:
    """Return why a leg was not found in an image."""
    of_leg = np.flatnonzero((outlines.row == row) & (outlines.leg == leg))
    return (
        "; ".join(dict.fromkeys(str(outlines.reason[i]) for i in of_leg.tolist())) or "not searched"
    )


def _same(one: RigidTransform, two: RigidTransform) -> bool:
    """Say whether two camera poses are the same, as well as a nominal model tells."""
    off = one.inv() * two
    distance = float(np.linalg.norm(two.translation))
    apart = float(np.linalg.norm(off.translation))
    return apart <= SAME_PLACE * distance and float(off.rotation.magnitude()) <= SAME_TURN


def has_doubt(scene: Scene) -> bool:
    """Say whether ideal edges of all that can be seen suit another camera pose as well."""
    truth, given = scene.truth, scene.given
    n_legs = len(given.leg_names)
    pictures = ideal_pictures(scene)
    T = truth.T_base_camera.inv()
    true = CameraPoses.rigid(T.rotation.as_matrix()[None], T.translation[None], n_legs)
    others = place_camera(pictures, n_legs).poses
    every = Pictures.of(pictures)
    poses = refined(every, CameraPoses.joined([true, others]), IDEAL, JOINT_ERROR)
    support = scores(every, poses, IDEAL[-1])
    apart = [not _same(_pose(poses, i), truth.T_base_camera) for i in range(len(poses))]
    return bool(np.max(support[apart], initial=0.0) >= AS_WELL * support[0])


def _pose(poses: CameraPoses, i: int) -> RigidTransform:
    """Return T_base_camera of a pose."""
    R = Rotation.from_matrix(poses.R[i])
    return RigidTransform.from_components(poses.t[i], R).inv()


def ideal_pictures(scene: Scene) -> list[Picture]:
    """Return pictures whose pairs are exactly the visible stretches of the true legs."""
    truth, given, camera = scene.truth, scene.given, scene.given.camera
    pixel, legs = 1.0 / float(camera.K[0, 0]), np.arange(len(given.leg_names))
    pictures = []
    for row, shown in enumerate(truth.shown):
        edges = camera.undistort(shown.ends[~shown.is_arm])  # (n, 2 outlines, 2 ends, 2)
        xy, width = edges.mean(axis=1), np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1)
        step = xy[:, 1] - xy[:, 0]
        length = np.linalg.norm(step, axis=1)
        pairs = CandidatePairs(
            xy.mean(axis=1),
            step / length[:, None],
            0.5 * length,
            width,
            length,
            pixel,
        )
        targets = leg_segments(given.A_base[row], given.B_base[row], given.cylinders, legs)
        corners = sensor_extent(camera)
        pictures.append(Picture(pairs, targets, corners, given.size))
    return pictures


def run(seed: int) -> dict[str, Any]:
    """Return the line of a scene."""
    scene = draw(seed)
    return judge(scene, find(scene.given))


def table(lines: Sequence[dict[str, Any]]) -> str:
    """Return the table of results."""
    groups: list[tuple[str, str, Any]] = [("all", "", None)]
    for key in ("machine", "images", "errors", "size", "occluders"):
        groups += [(key, key, value) for value in sorted({line[key] for line in lines}, key=str)]
    head = f"{'':26}{'scenes':>7}{'right':>7}{'ambig.':>7}{'none':>6}{'(real)':>7}{'wrong':>6}"
    head += f"{'legs':>8}{'found':>8}{'no doubt':>9}{'placed':>8}"
    head += f"{'outlines':>9}{'wrong':>6}{'ms/image':>15}"
    rows = [head]
    for title, key, value in groups:
        some = [line for line in lines if not key or line[key] == value]
        verdicts = [line["verdict"] for line in some]
        legs = sum(sum(line["visible"]) for line in some)
        refused = [line for line in some if line["verdict"] in ("ambiguous", "not found")]
        real = sum(line["doubt"] for line in refused)
        sure = [line for line in some if line not in refused or not line["doubt"]]
        placed = [line for line in some if line["verdict"] == "right"]
        images = sum(line["images"] for line in some)
        times = [1e3 * sum(line["seconds"][i] for line in some) / images for i in (0, 1)]
        rows.append(
            f"{title + ' ' + str(value) if key else title:26}{len(some):7d}"
            f"{verdicts.count('right'):7d}{verdicts.count('ambiguous'):7d}"
            f"{verdicts.count('not found'):6d}{real:7d}{verdicts.count('wrong'):6d}{legs:8d}"
            f"{_share_found(some):7.1f}%{_share_found(sure):8.1f}%{_share_found(placed):7.1f}%"
            f"{sum(line['used'] for line in some):9d}{sum(line['wrong'] for line in some):6d}"
            f"{times[0]:8.0f} +{times[1]:4.0f}"
        )
    for verdict in ("wrong", "not found", "ambiguous"):
        seeds = [
            f"{line['seed']}{'*' * line['doubt']}" for line in lines if line["verdict"] == verdict
        ]
        rows.append(f"{verdict} (* with an inherent doubt): {' '.join(seeds) or 'none'}")
    off = [str(line["seed"]) for line in lines if line["wrong"] and line["verdict"] == "right"]
    rows.append(f"outlines wrong in views placed right: {' '.join(off) or 'none'}")
    return "\n".join(rows)


def _share_found(lines: Sequence[dict[str, Any]]) -> float:
    """Return how many of the visible legs were found [%]."""
    legs = sum(sum(line["visible"]) for line in lines)
    return float(100.0 * sum(line["found"] for line in lines) / max(legs, 1))


def look(seed: int, folder: Path) -> dict[str, Any]:
    """Write the images of a scene with what is there and what was found; return its line."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = draw(seed)
    found = find(scene.given)
    given, truth = scene.given, scene.truth
    for row, image in enumerate(given.images):
        picture = _eight_bits(image)
        pairs = find_candidate_pairs(segments_of_reduced(grey_levels(image), given.camera, 1))
        for middle, along, half in zip(pairs.middle, pairs.along, pairs.half_length, strict=True):
            ends = np.stack([middle - half * along, middle + half * along])
            _line(picture, given.camera.distort(ends), (150, 150, 150), 1)
        for leg, name in enumerate(given.leg_names):
            colour = COLOURS[leg % len(COLOURS)]
            if truth.visible[row, leg]:
                _true_outlines(picture, scene, row, leg, colour)
            at = truth.T_base_camera.inv().apply(truth.A_base[row, leg])
            x, y = np.rint(given.camera.project(at)).astype(int).tolist()
            cv2.putText(picture, name, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1)
        for i in np.flatnonzero((found.outlines.row == row) & found.outlines.used).tolist():
            leg = int(found.outlines.leg[i])
            _line(picture, found.outlines.ends[i], COLOURS[leg % len(COLOURS)], 2)
        cv2.imwrite(str(folder / f"{seed}-{row + 1}.png"), picture)
    return judge(scene, found)


def _eight_bits(image: Image) -> NDArray[np.uint8]:
    """Return an image as blue, green, red of 8 bits."""
    grey = np.asarray(image // 257 if image.dtype == np.uint16 else image, dtype=np.uint8)
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR) if grey.ndim == 2 else grey.copy())


def _true_outlines(
    picture: NDArray[np.uint8], scene: Scene, row: int, leg: int, colour: tuple[int, int, int]
) -> None:
    """Draw both outlines of the visible stretches of a leg."""
    shown = scene.truth.shown[row]
    for ends in shown.ends[(shown.leg == leg) & ~shown.is_arm].reshape(-1, 2, 2):
        _line(picture, ends, colour, 1)


def _line(
    picture: NDArray[np.uint8], ends: Array, colour: tuple[int, int, int], thickness: int
) -> None:
    """Draw a straight line between two pixels (2, 2)."""
    one, two = (tuple(np.clip(np.rint(end), -9999, 9999).astype(int).tolist()) for end in ends)
    cv2.line(picture, one, two, colour, thickness, cv2.LINE_AA)


def main() -> None:
    """Print a table of all scenes that there are."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("number", nargs="?", type=int, default=1000, help="scenes; 1000")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one; 0")
    parser.add_argument("--workers", type=int, default=1, help="processes; 1")
    parser.add_argument("--results", type=Path, default=Path("scenes.jsonl"), metavar="FILE",
                        help="lines of JSON; scenes.jsonl")  # fmt: skip
    parser.add_argument("--only", type=int, metavar="SEED", help="one scene, with its images")
    parser.add_argument("-o", type=Path, metavar="FOLDER", default=Path(), help="for --only")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.only is not None:
        print(json.dumps(look(options.only, options.o), indent=1))
        return
    lines = {}
    if options.results.exists():
        known = [json.loads(text) for text in options.results.read_text().splitlines()]
        lines = {line["seed"]: line for line in known}
    seeds = range(options.first, options.first + options.number)
    missing = [seed for seed in seeds if seed not in lines]
    failure = "The scenes could not be searched"
    with (
        options.results.open("a") as results,
        worker_pool(options.workers, failure, in_order=False) as work,
    ):
        for line in work(run, missing):
            lines[line["seed"]] = line
            results.write(json.dumps(line) + "\n")
            results.flush()
    print(table([lines[seed] for seed in sorted(lines) if seed in seeds]))


if __name__ == "__main__":
    main()
