"""Intrinsics that the legs determine, estimated jointly with all other unknowns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.report import CameraIntrinsics
from legcal.estimation.uncertainty import marginal_rows
from legcal.vision.camera import shared_cameras

INTRINSICS = ("fx", "fy", "cx", "cy")
_MAX_SIGMA = 0.1  # focal lengths: above, intrinsics are not determined
_OPEN = 0.05  # least component of an intrinsic in an open direction


def expected_intrinsics(analysis: Analysis) -> tuple[CameraIntrinsics, ...]:
    """Return the expected uncertainty of the intrinsics of all cameras of a session."""
    session, choices = analysis.session, analysis.choices
    cameras = {view.name: view.camera for view in session.cameras}
    owners = tuple(dict.fromkeys(shared_cameras(list(cameras), list(cameras.values()))))
    names = [f"{owner}.{key}" for owner in owners for key in INTRINSICS]
    estimated = replace(
        choices,
        fixed=choices.fixed.difference(names),
        free=choices.free.union(names),
        priors={name: prior for name, prior in choices.priors.items() if name not in names},
    )
    found = session.contributions(estimated, analysis.noise).of_shared()
    of_names = {name.removeprefix("camera "): i for i, name in enumerate(found.names)}
    columns = [of_names[name if name in of_names else name.rpartition(".")[2]] for name in names]
    focal = np.repeat([np.sqrt(cameras[o].K[0, 0] * cameras[o].K[1, 1]) for o in owners], 4)
    rows = np.concatenate([found.all_gains(), found.known])
    _, singular, basis = np.linalg.svd(marginal_rows(rows, np.array(columns)) * focal)
    is_determined = singular > 1.0 / _MAX_SIGMA
    spread = np.sqrt(np.sum((basis[is_determined].T / singular[is_determined]) ** 2, axis=1))
    is_open = np.sqrt(np.sum(basis[~is_determined] ** 2, axis=0)) > _OPEN
    sigmas, opens = (x.reshape(len(owners), -1).tolist() for x in (spread * focal, is_open))
    return tuple(
        CameraIntrinsics(
            owner,
            not any(open_),
            {k: None if o else s for k, s, o in zip(INTRINSICS, sigma, open_, strict=True)},
        )
        for owner, sigma, open_ in zip(owners, sigmas, opens, strict=True)
    )
