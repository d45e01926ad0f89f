"""Cameras of legcal and of mrcal from the same corners: focal length, projection, uncertainty.

    python benchmarks/mrcal_oracle.py --python PYTHON [--sets 20] [--first 1000]

PYTHON is an interpreter with mrcal and OpenCV (mrcal has wheels from Python 3.12 on). Twenty images
of a board with noise of 0.03 px before a plumb_bob lens; mrcal fits LENSMODEL_OPENCV5 from its own
start, and is compared as ``legcal camera --compare`` does. A line for each set: difference of fx in
stated standard deviations; largest difference of the projection over the image, in those of both;
standard deviations of the projection by mrcal over those of legcal: median over the image, and
the 10 and 90 % quantiles, by mrcal's own map and by its covariance of the intrinsics. The former
takes a turn of the camera out by the boards, the latter as legcal does, by the middle of the image.
"""

import argparse
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np

_FIT = """
import pickle, sys
import mrcal, numpy as np
size, spacing, pixels, sets = pickle.load(sys.stdin.buffer)
seed = np.array([size[0], size[0], (size[0] - 1) / 2, (size[1] - 1) / 2], dtype=float)
answers = []
for board in sets:
    n = len(board)
    at = np.stack([np.arange(n), np.zeros(n), -np.ones(n)], axis=1).astype(np.int32)
    pinhole = mrcal.cameramodel(intrinsics=("LENSMODEL_PINHOLE", seed), imagersize=size)
    poses = mrcal.estimate_monocular_calobject_poses_Rt_tocam(
        at[:, :2].copy(), board, spacing, [pinhole])
    inputs = dict(
        intrinsics=np.array([[*seed, 0, 0, 0, 0, 0]]), rt_cam_ref=np.zeros((0, 6)),
        rt_ref_frame=mrcal.rt_from_Rt(poses), points=None, observations_board=board,
        indices_frame_camintrinsics_camextrinsics=at, observations_point=None,
        indices_point_camintrinsics_camextrinsics=None, lensmodel="LENSMODEL_OPENCV5",
        calobject_warp=np.zeros(2), imagersizes=np.array([size], dtype=np.int32),
        calibration_object_spacing=spacing, do_optimize_intrinsics_core=True,
        do_optimize_extrinsics=True, do_optimize_frames=True, do_apply_regularization=False,
        do_apply_outlier_rejection=False, verbose=False)
    for distortions, warp in ((False, False), (True, False), (True, True)):
        inputs["do_optimize_intrinsics_distortions"] = distortions
        inputs["do_optimize_calobject_warp"] = warp
        mrcal.optimize(**inputs)
    model = mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0)
    rays = mrcal.unproject(pixels, *model.intrinsics(), normalize=True)
    sigma = mrcal.projection_uncertainty(rays, model, atinfinity=True, what="worstdirection-stdev")
    _, x, J, _ = mrcal.optimizer_callback(**inputs)
    scale = np.ones(J.shape[1])
    mrcal.unpack_state(scale, **inputs)
    C = np.linalg.inv((J.T @ J).toarray())[:9, :9] * np.outer(scale[:9], scale[:9])
    C *= x @ x / (len(x) - len(scale))
    answers.append((model.intrinsics()[1], sigma, C))
pickle.dump(answers, sys.stdout.buffer)
"""


def main() -> None:
    """Print the table."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from camera_sessions import BOARD, CAMERAS, SIZE, seen_corners

    from legcal.calibration.camera_calibration.consensus import robust_fit
    from legcal.calibration.camera_calibration.projection import (
        GRID,
        compare_cameras,
        projection_sigma,
    )
    from legcal.vision.camera import Camera

    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--python", required=True)
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    options = parser.parse_args()
    truth, (nx, ny) = CAMERAS["plumb_bob"], BOARD.grid
    fits, boards = [], []
    for number in range(options.first, options.first + options.sets):
        seen = seen_corners(truth, 20, number)
        fits.append(robust_fit(seen, SIZE, "plumb_bob"))
        place = np.rint(seen.points[:, :2] / BOARD.side).astype(np.intp)
        board = np.zeros((20, ny, nx, 3))
        board[..., 2] = -1.0  # mrcal's mark of corners that are not seen
        board[seen.image, place[:, 1], place[:, 0]] = np.column_stack(
            [seen.px, np.ones(len(seen.px))]
        )
        boards.append(board)
    question = pickle.dumps(((SIZE.width, SIZE.height), BOARD.side, truth.grid(*GRID), boards))
    command = [options.python, "-c", _FIT]
    answer = subprocess.run(command, input=question, capture_output=True, check=True).stdout
    print(
        "set   fx [sigma]  projection [sigma]  ratio: median  10 %  90 %  alike: median  10 %  90 %"
    )
    for number, fit, (values, sigma, C) in zip(
        range(options.first, options.first + options.sets),
        fits,
        pickle.loads(answer),
        strict=True,
    ):
        assert fit is not None
        camera = fit.adjusted.camera
        K = np.array([[values[0], 0.0, values[2]], [0.0, values[1], values[3]], [0.0, 0.0, 1.0]])
        theirs = Camera(K, SIZE.width, SIZE.height, values[4:])
        own = projection_sigma(camera, fit.covariance)
        off = (values[0] - camera.K[0, 0]) / np.sqrt(fit.covariance[0, 0])
        apart = compare_cameras(camera, theirs).px / np.hypot(own, sigma)
        ratios = ""
        for other in (sigma, projection_sigma(theirs, C)):
            low, median, high = np.quantile(other / own, [0.1, 0.5, 0.9])
            ratios += f" {median:14.2f} {low:5.2f} {high:5.2f}"
        print(f"{number:5d} {off:10.2f} {apart.max():19.2f}{ratios}", flush=True)


if __name__ == "__main__":
    main()
