"""The fit of everything, built and not yet solved: unknowns, measurements, priors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry.types import Array
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parametrization import tied_twist
from legcal.mechanism.sensitivity import freedoms
from legcal.refinement.choices import Choices
from legcal.refinement.constraints import n_bonds
from legcal.refinement.layout import Layout
from legcal.refinement.legs import FittedLegs
from legcal.refinement.observed import ObservedOutlines, Readings
from legcal.refinement.observed_axes import ObservedAxes
from legcal.refinement.priors import Priors
from legcal.refinement.rows import Places
from legcal.refinement.start import Start, with_values
from legcal.refinement.state import State, components
from legcal.vision.camera import Camera
from legcal.vision.intrinsics import intrinsic_names, undistort_derivatives


@dataclass(frozen=True, eq=False)
class FirstValues:
    """Where radii and intrinsics begin; those that are fixed stay there.

    Attributes
    ----------
    radii : (n_radii,) array
        Radii [m].
    cameras : tuple of Camera
        The camera of each view.
    """

    radii: Array
    cameras: tuple[Camera, ...]


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
    priors : Priors
    first : FirstValues
        Where what no start tells begins.
    outline_places, reading_places, axis_places : Places
        The unknowns of each measurement.
    named : tuple of str
        Names of the first unknowns of x: kinematic parameters, radii, biases, intrinsics.
    named_units : tuple of str
        Their units: ``m``, ``rad``, ``px`` or none.
    held : (w, n_kept) array
        Orthonormal directions of x that the solver must not move along.
    """

    legs: FittedLegs
    choices: Choices
    layout: Layout
    outlines: ObservedOutlines
    readings: Readings
    axes: ObservedAxes
    priors: Priors
    first: FirstValues
    outline_places: Places
    reading_places: Places
    axis_places: Places
    named: tuple[str, ...]
    named_units: tuple[str, ...]
    held: Array

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns; a pose counts with the freedoms that its constraints leave."""
        bound = 6 - len(freedoms(self.legs.frame_legs)) + sum(map(n_bonds, self.legs.nominal))
        return self.layout.n_kept + max(6 - bound, 0) * self.layout.n_poses

    @property
    def n_equations(self) -> int:
        """Number of residuals, priors left out."""
        return 2 * len(self.outlines) + len(self.readings) + 4 * len(self.axes)

    def begin(self, start: Start) -> State:
        """Return the state at a start, with everything that is fixed at its value."""
        legs, layout = self.legs, self.layout
        values = legs.vector(legs.nominal)
        at = {
            i: self.choices.values.get(name, float(values[i]))
            for i, name in enumerate(legs.parametrization.names)
            if layout.kinematic[i] >= layout.size
        }
        return State(
            self.tied(with_values(start.legs, legs, at)),
            self.first.radii,
            np.zeros(len(layout.bias)),
            self.first.cameras,
            *components(start.T_camera_Rb),
            *components(start.T_Rb_Re),
        )

    def tied(self, geometry: tuple[LegGeometry, ...]) -> tuple[LegGeometry, ...]:
        """Return legs whose fixed twists are where they are fixed, whatever turned the axes.

        Turning an axis away and back on another way leaves what is tied to it turned about it.
        """
        moved = list(geometry)
        for j, (leg, nominal) in enumerate(zip(geometry, self.legs.nominal, strict=True)):
            is_free = self.layout.place[j, -1] < self.layout.size
            if nominal.twist is not None and leg.platform_joint == "" and not is_free:
                fixed = self.choices.values.get(f"{self.legs.names[j]}.twist", nominal.twist)
                moved[j] = replace(leg, twist=tied_twist(leg, nominal, fixed))
        return tuple(moved)

    def measured_ends(self, state: State) -> tuple[Array, Array]:
        """Return the ends of outlines on the sensor plane, and how they move with intrinsics.

        Returns
        -------
        xy : (n, 2, 2) array
            Both ends.
        by_intrinsics : (n, 2, 2, n_keys) array
            Their derivatives by the intrinsics that are unknowns.
        """
        o, layout = self.outlines, self.layout
        keys = layout.intrinsic_keys
        xy, slopes = o.feet.copy(), np.zeros((len(o), 2, 2, len(keys)))
        if not keys:
            return xy, slopes
        for v in np.unique(o.view):
            camera, of_view = state.cameras[v], o.view == v
            known = [k for k, key in enumerate(keys) if key in intrinsic_names(camera)]
            pixels = o.pixels[of_view]
            xy[of_view] = camera.undistort(pixels)
            some = np.zeros((*pixels.shape, len(keys)))
            some[..., known] = undistort_derivatives(camera, pixels, [keys[k] for k in known])
            slopes[of_view] = some
        return xy, slopes
