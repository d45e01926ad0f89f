"""Draw the picture of docs/simulate.md: rendered photographs of four machines.

python docs/draw_simulated.py docs/simulated.jpg
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from legcal.simulation.dataset import simulate
from legcal.simulation.settings import SimulationSettings

MODELS = ("hexapod", "3-upu-tilted", "3-rpr", "tricept")
SIZE = (512, 384)


def draw(destination: str) -> None:
    """Put one photograph of each machine into a row of two by two."""
    pictures = []
    with tempfile.TemporaryDirectory() as folder:
        for model in MODELS:
            settings = SimulationSettings(seed=1, views=1, poses=1)
            dataset = simulate(model, Path(folder) / model, settings)
            path = dataset.folder / dataset.measurements.image[0]
            picture = cv2.imread(str(path))
            pictures.append(cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA))
    rows = [np.hstack(pictures[k : k + 2]) for k in (0, 2)]
    cv2.imwrite(destination, np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    draw(sys.argv[1])
