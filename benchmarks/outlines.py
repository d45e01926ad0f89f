"""Outlines measured in rendered pictures of single cylinders, against their exact places.

    OMP_NUM_THREADS=1 python benchmarks/outlines.py [--scenes 240] [--seed 0]

Every scene is a cylinder in any direction, lit by one lamp from somewhere and by light from
everywhere, before a plain or sloped background; material, light, background, lens, sensor and
width are drawn anew. Beside legcal's own measurement stand three ways to find an edge without a
model of it: the greatest gradient across the outline (a parabola through three pixels) and Canny's
points, both with a straight line by least squares, and OpenCV's line segment detector. All of
them are told where the outline is to half a pixel. A scene is photographed a few times: "bias" is
the mean of the errors of one outline in its middle, positive towards the inside, "scatter" their
standard deviation, and "pull" the root mean square of errors over the standard deviations claimed,
at both ends.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from edge_methods import MEASURED
from rendered_cylinders import (
    BACKGROUNDS,
    BLURS,
    ELECTRONS,
    LIGHTS,
    WIDTHS,
    Looks,
    Photographed,
    draw_looks,
    grey_levels,
    photograph,
)

from legcal.geometry.types import Array
from legcal.vision.cylinder import EPSILON

START = 0.4  # how far the start is off at each end [px]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors of one outline by one method, towards the inside.

    Attributes
    ----------
    looks : Looks
        Of the scene.
    edge : int
        0 or 1.
    contrast : float
        With sign [grey levels].
    errors : (n, 2) array
        At both ends of every photograph in which it was found [px].
    sigma : (n, 2) array
        Claimed standard deviations [px].
    """

    looks: Looks
    edge: int
    contrast: float
    errors: Array
    sigma: Array


def outcomes(scene: Photographed, method: str, rng: np.random.Generator) -> list[Outcome]:
    """Measure all photographs of a scene."""
    found: list[list[tuple[Array, Array]]] = [[], []]
    for image in scene.images:
        start = scene.v + START * rng.standard_normal((2, 2))
        ends = MEASURED[method](scene, grey_levels(image), start)
        for edge, (line, epsilon) in enumerate(zip(ends, EPSILON, strict=True)):
            if line is not None:
                found[edge].append((epsilon * line[0], line[1]))
    return [
        Outcome(
            scene.looks,
            edge,
            float(scene.contrast[edge]),
            np.array([error for error, _ in lines]).reshape(-1, 2),
            np.array([sigma for _, sigma in lines]).reshape(-1, 2),
        )
        for edge, lines in enumerate(found)
    ]


def row(title: str, chosen: dict[str, list[Outcome]]) -> str:
    """Return a line of the table: legcal in full, of the others what an outline is off."""
    cells = [f"{title:26s}{len(chosen['legcal']):5d}"]
    for method, outlines in chosen.items():
        seen = [o for o in outlines if len(o.errors)]
        if not seen:
            continue
        bias = np.array([o.errors.mean() for o in seen])
        if method == "legcal":
            middles = [o.errors.mean(axis=1) for o in seen if len(o.errors) > 1]
            scatter = np.sqrt(np.mean([middle.var(ddof=1) for middle in middles]))
            pull = np.concatenate([(o.errors / o.sigma).ravel() for o in seen])
            cells.append(
                f"{len(outlines) - len(seen):5d}{bias.mean():+8.3f}{np.sqrt(np.mean(bias**2)):7.3f}"
                f"{np.quantile(np.abs(bias), 0.95):7.3f}{np.abs(bias).max():7.2f}{scatter:9.3f}"
                f"{np.sqrt(np.mean(pull**2)):6.2f}{1.4826 * np.median(np.abs(pull)):6.2f}  "
            )
        else:
            cells.append(f"{bias.mean():+9.2f}{np.sqrt(np.mean(bias**2)):6.2f}")
    return "".join(cells)


CLEAR = 20.0  # contrast above which outlines ought to be good [grey levels]


def rows() -> list[tuple[str, Callable[[Outcome], bool]]]:
    """Return the titles of the table's lines and what they choose."""

    def clear(o: Outcome) -> bool:
        return abs(o.contrast) > CLEAR

    def told(o: Outcome) -> bool:
        return clear(o) and o.looks.gamma > 0.0

    lines: list[tuple[str, Callable[[Outcome], bool]]] = [
        ("contrast above 20, told", told),
        ("contrast 10 to 20", lambda o: 10.0 < abs(o.contrast) <= CLEAR and o.looks.gamma > 0.0),
        ("contrast 4 to 10", lambda o: 4.0 < abs(o.contrast) <= 10.0 and o.looks.gamma > 0.0),
    ]
    for name, choice in (
        ("linear", 1.0),
        ("gamma 2.2, told", 2.2),
        ("gamma 2.2, not told", -2.2),
    ):
        lines.append((name, lambda o, c=choice: clear(o) and o.looks.gamma == c))  # type: ignore[misc]
    lines += [
        ("brighter than behind", lambda o: told(o) and o.contrast > 0.0),
        ("darker than behind", lambda o: told(o) and o.contrast < 0.0),
    ]
    for field, values in (
        ("width", WIDTHS),
        ("blur", BLURS),
        ("electrons", ELECTRONS),
        ("bits", (8, 16)),
        ("light", LIGHTS),
        ("background", BACKGROUNDS),
    ):
        for value in values:
            title = f"{field} {value:g}" if not isinstance(value, str) else f"{field}: {value}"
            lines.append(
                (title, lambda o, f=field, v=value: told(o) and getattr(o.looks, f) == v)  # type: ignore[misc]
            )
    return lines


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", type=int, default=240, help="cylinders; 240")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found: dict[str, list[Outcome]] = {method: [] for method in MEASURED}
    for seed in range(options.scenes):
        rng = np.random.default_rng([options.seed, seed])
        scene = photograph(draw_looks(rng), rng)
        for method in MEASURED:
            found[method].extend(outcomes(scene, method, np.random.default_rng(seed)))
    print(f"{'':31s}legcal{'':46s}{'gradient':>12s}{'Canny':>15s}{'LSD':>15s}")
    print(
        f"{'outlines [px]':26s}{'n':>5s}{'lost':>5s}{'bias':>8s}{'rms':>7s}{'95 %':>7s}{'most':>7s}"
        f"{'scatter':>9s}{'pull':>6s}{'rob.':>6s}  " + f"{'bias':>9s}{'rms':>6s}" * 3
    )
    for title, chosen in rows():
        print(row(title, {m: [o for o in outlines if chosen(o)] for m, outlines in found.items()}))


if __name__ == "__main__":
    main()
