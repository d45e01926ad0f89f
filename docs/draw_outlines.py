"""Draw the picture of the README: the outlines of a result over one of its photographs.

python docs/draw_outlines.py examples/hexapod calibrated images/c1_k01.jpg docs/outlines.jpg
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from legcal import load_dataset
from legcal.observations.table import read_observations

USED, REJECTED = (80, 220, 60), (60, 60, 240)
SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


def draw(dataset_folder: str, result_folder: str, image: str, destination: str) -> None:
    """Draw used outlines in green and rejected ones in red, with the leg's name."""
    dataset = load_dataset(dataset_folder)
    mechanism, measurements = dataset.mechanism, dataset.measurements
    table = Path(result_folder) / "observations.csv"
    outlines = read_observations(table, mechanism.legs, measurements)
    row = measurements.image.index(image)
    picture = cv2.cvtColor(dataset.read_image(row).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    for i in np.flatnonzero((outlines.row == row) & np.isfinite(outlines.ends).all(axis=(1, 2))):
        colour = USED if outlines.used[i] else REJECTED
        p, r = np.round(outlines.ends[i] * 2**SHIFT).astype(int).tolist()
        cv2.line(picture, p, r, colour, 2, cv2.LINE_AA, SHIFT)
        if outlines.edge[i] == 1:
            u, v = (0.65 * outlines.ends[i, 0] + 0.35 * outlines.ends[i, 1]).astype(int).tolist()
            name = mechanism.leg_names[outlines.leg[i]]
            cv2.putText(picture, name, (u - 62, v), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, 2)
    cv2.imwrite(destination, picture)


if __name__ == "__main__":
    draw(*sys.argv[1:])
