"""Axes of a simulated hexapod with known errors, for the tests of the fit of axes."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from legcal.calibration.joint_fit.variables import FittedLegs, Start, start_from
from legcal.data.axes import LegAxes, axes_of_table, table_of_axes
from legcal.data.measurements import Measurements
from legcal.geometry.types import Array
from legcal.machine import (
    KinematicParameters,
    from_vector,
    parameters_of_legs,
    point_like_legs,
    to_vector,
)
from legcal.simulation import (
    PAPER_VIEWS,
    TableNoise,
    hexapod_cameras,
    hexapod_session,
    paper_hexapod,
    perturb,
)


@dataclass(frozen=True, eq=False)
class AxesSession:
    """Exact axes, the readings and the truth behind them."""

    legs: FittedLegs
    measurements: Measurements
    axes: LegAxes
    truth: Start

    @property
    def parameters(self) -> KinematicParameters:
        """The true parameters [m]."""
        return parameters_of_legs(self.truth.legs)

    def noisy(self, seed: int) -> tuple[Measurements, LegAxes]:
        """Return readings and axes with the errors that they claim."""
        rng, m = np.random.default_rng(seed), self.measurements
        error = rng.normal(scale=m.sigma_q, size=(m.n_poses, len(self.legs.names)))
        values, sigmas = table_of_axes(self.axes)
        values += sigmas * rng.normal(size=values.shape)
        axes = axes_of_table(self.axes.row, self.axes.leg, values, sigmas)
        return replace(m, q=m.q + error[m.pose]), axes

    def start(self, seed: int = 7, joints: float = 0.002) -> Start:
        """Return a start that is wrong by so much in every parameter [m]; cameras by 1 degree."""
        rng = np.random.default_rng(seed)
        xi = to_vector(self.parameters, self.legs.frame_legs)
        xi = xi + joints * rng.choice([-1.0, 1.0], len(xi))
        cameras = [
            view.T_base_camera.inv()
            for view in self.measurements.views
            if view.T_base_camera is not None
        ]
        return start_from(
            point_like_legs(from_vector(xi, self.legs.n_legs, self.legs.frame_legs)),
            self.measurements,
            self.legs,
            cameras,
            self.truth.T_Rb_Re,
            "nominal",
        )

    def errors(self, parameters: KinematicParameters) -> Array:
        """Return the errors of the free parameters [m]."""
        frame_legs = self.legs.frame_legs
        return to_vector(parameters, frame_legs) - to_vector(self.parameters, frame_legs)


@cache
def axes_session(
    n_poses: int = 8,
    n_images: int = 1,
    *,
    coplanar: bool = False,
    legs: tuple[tuple[int, ...], ...] = PAPER_VIEWS,
) -> AxesSession:
    """Return a session of a hexapod 2 mm off its drawing, seen with the noise of Table 1."""
    rng = np.random.default_rng(3)
    machine = perturb(paper_hexapod(), rng, 0.002, coplanar=coplanar)
    cameras = hexapod_cameras(machine, rng, legs=legs)
    session = hexapod_session(
        machine, cameras, rng, noise=TableNoise(), noisy=False, n_poses=n_poses, n_images=n_images
    )
    # Rough camera poses, about 1 degree and 1 cm wrong.
    rough = hexapod_session(machine, cameras, rng, noise=TableNoise(), n_poses=1).measurements
    legs_true = point_like_legs(machine.parameters)
    return AxesSession(
        FittedLegs(machine.leg_names, legs_true, machine.sign, machine.frame_legs, {}),
        replace(session.measurements, views=rough.views),
        session.axes,
        Start(
            legs_true,
            tuple(camera.T_Rb_camera.inv() for camera in cameras),
            tuple(session.T_Rb_Re),
            "truth",
        ),
    )
