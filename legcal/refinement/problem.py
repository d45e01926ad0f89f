"""The fit of everything, built and not yet solved: unknowns, measurements, priors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parametrization import tied_twist
from legcal.mechanism.sensitivity import freedoms
from legcal.refinement.choices import Choices
from legcal.refinement.constraints import n_bonds
from legcal.refinement.couplings import Couplings
from legcal.refinement.layout import Layout
from legcal.refinement.legs import FittedLegs
from legcal.refinement.observed import ObservedOutlines, Readings
from legcal.refinement.observed_axes import ObservedAxes
from legcal.refinement.observed_board import ObservedBoard
from legcal.refinement.priors import Priors
from legcal.refinement.start import Start, with_values
from legcal.refinement.state import State, components
from legcal.vision.camera import Camera
from legcal.vision.intrinsics import intrinsic_names, undistort_derivatives


@dataclass(frozen=True, eq=False)
class FirstValues:
    """Where radii, intrinsics and the size of the board begin; those that are fixed stay there.

    Attributes
    ----------
    radii : (n_radii,) array
        Radii [m].
    cameras : tuple of Camera
        The camera of each view.
    board_scale : float
        Factor on the dimensions of the calibration board.
    """

    radii: Array
    cameras: tuple[Camera, ...]
    board_scale: float = 1.0


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A fit, built and not yet solved.

    Attributes
    ----------
    legs : FittedLegs
    choices : Choices
        What is fixed, freed or known.
    layout : Layout
    outlines : ObservedOutlines
    readings : Readings
    axes : ObservedAxes
    board : ObservedBoard
        The corners of a calibration board that stands on the base.
    priors : Priors
    first : FirstValues
        Where what no start tells begins.
    couplings : Couplings
        The unknowns of each measurement.
    named : tuple of str
        Names of the first unknowns of x: kinematic parameters, radii, biases, intrinsics, the size
        of the calibration board.
    named_units : tuple of str
        Their units: ``m``, ``rad``, ``px`` or none.
    held : (w, n_kept) array
        Orthonormal directions of x that the solver must not move along.
    rejected_corners : tuple of (int, int)
        View and number of the corners of the board that were left out.
    """

    legs: FittedLegs
    choices: Choices
    layout: Layout
    outlines: ObservedOutlines
    readings: Readings
    axes: ObservedAxes
    board: ObservedBoard
    priors: Priors
    first: FirstValues
    couplings: Couplings
    named: tuple[str, ...]
    named_units: tuple[str, ...]
    held: Array
    rejected_corners: tuple[tuple[int, int], ...] = ()

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns; a pose counts with the freedoms that its constraints leave."""
        bound = 6 - len(freedoms(self.legs.frame_legs)) + sum(map(n_bonds, self.legs.nominal))
        return self.layout.n_kept + max(6 - bound, 0) * self.layout.n_poses

    @property
    def n_equations(self) -> int:
        """Number of residuals, priors left out."""
        return (
            2 * len(self.outlines) + len(self.readings) + 4 * len(self.axes) + 2 * len(self.board)
        )

    def begin(self, start: Start) -> State:
        """Return the state at a start, with everything that is fixed at its value."""
        return State(
            self.tied(with_values(start.legs, self.legs, self._fixed())),
            self.first.radii,
            np.zeros(len(self.layout.bias)),
            self.first.cameras,
            *components(start.T_camera_Rb),
            *components(start.T_Rb_Re),
            *components([start.T_Rb_board]),
            np.array([self.first.board_scale]),
        )

    def tied(self, geometry: tuple[LegGeometry, ...]) -> tuple[LegGeometry, ...]:
        """Return legs whose fixed angles are where they are fixed, whatever turned the axes.

        Turning an axis away and back on another way leaves what is tied to it turned about it, and
        turning it by one of its angles changes the other a little.
        """
        moved = geometry
        if self._half_fixed:
            at = {i: value for i, value in self._fixed().items() if i in self._half_fixed}
            moved = with_values(moved, self.legs, at)
        return tuple(
            replace(leg, twist=tied_twist(leg, nominal, self._fixed_twist(j, nominal.twist)))
            if nominal.twist is not None and leg.platform_joint == "" and not self._is_free(j, -1)
            else leg
            for j, (leg, nominal) in enumerate(zip(moved, self.legs.nominal, strict=True))
        )

    def _is_free(self, leg: int, number: int) -> bool:
        """Say whether one of the numbers of a leg is an unknown."""
        return bool(self.layout.place[leg, number] < self.layout.size)

    def _fixed_twist(self, leg: int, nominal: float) -> float:
        return self.choices.values.get(f"{self.legs.names[leg]}.twist", nominal)

    def _fixed(self) -> dict[int, float]:
        """Return the values of the kinematic parameters that are no unknowns, by their number."""
        legs, layout = self.legs, self.layout
        values = legs.vector(legs.nominal)
        return {
            i: self.choices.values.get(name, float(values[i]))
            for i, name in enumerate(legs.parametrization.names)
            if layout.kinematic[i] >= layout.size
        }

    @cached_property
    def _half_fixed(self) -> frozenset[int]:
        """The angles of axes that are fixed where the other one is not."""
        place, found = self.legs.parametrization.place, set[int]()
        for j in range(self.legs.n_legs):
            for pair in ((7, 8), (9, 10)):
                fixed = [n for n in pair if place[j, n] >= 0 and not self._is_free(j, n)]
                if len(fixed) == 1:
                    found.add(int(place[j, fixed[0]]))
        return frozenset(found)

    def measured_ends(self, state: State) -> tuple[Array, Array]:
        """Return the ends of outlines on the sensor plane, and how they move with intrinsics.

        Returns
        -------
        xy : (n, 2, 2) array
            Both ends.
        by_intrinsics : (n, 2, 2, n_keys) array
            Their derivatives by the intrinsics that are unknowns.
        """
        return self._on_sensor(state, self.outlines.view, self.outlines.feet, self.outlines.pixels)

    def measured_corners(self, state: State) -> tuple[Array, Array]:
        """Return the corners of the board on the sensor plane, and how they move with intrinsics.

        Returns
        -------
        xy : (n, 2) array
        by_intrinsics : (n, 2, n_keys) array
        """
        return self._on_sensor(state, self.board.view, self.board.feet, self.board.pixels)

    def _on_sensor(
        self, state: State, view: IntArray, feet: Array, pixels: Array
    ) -> tuple[Array, Array]:
        """Return points (n, ..., 2) of images on the sensor plane, and (n, ..., 2, n_keys)."""
        keys = self.layout.intrinsic_keys
        xy, slopes = feet.copy(), np.zeros((*feet.shape, len(keys)))
        if not keys:
            return xy, slopes
        for v in np.unique(view):
            camera, of_view = state.cameras[v], view == v
            known = [k for k, key in enumerate(keys) if key in intrinsic_names(camera)]
            seen = pixels[of_view]
            xy[of_view] = camera.undistort(seen)
            some = np.zeros((*seen.shape, len(keys)))
            some[..., known] = undistort_derivatives(camera, seen, [keys[k] for k in known])
            slopes[of_view] = some
        return xy, slopes
