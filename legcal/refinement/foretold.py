"""What a fit knows, put to images that it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.refinement.biases import SharedShifts, possible_shifts
from legcal.refinement.noise import NoiseModel
from legcal.refinement.observed import observed_outlines, of_parts, seen_by
from legcal.refinement.problem import FitProblem
from legcal.refinement.shifted import with_measurements
from legcal.refinement.state import State, components


@dataclass(frozen=True, eq=False)
class Foretold:
    """Images that a fit has not seen, with all that it knows of them.

    Attributes
    ----------
    problem : FitProblem
        Their outlines and readings; its unknowns are those of the fit, with the shifts that these
        outlines share.
    state : State
        Where the fit ended, at the poses of these images.
    covariance : (n_kept, n_kept) array
        What the fit says of all unknowns but poses; shifts that it has not met have their prior.
    """

    problem: FitProblem
    state: State
    covariance: Array


@dataclass(frozen=True, eq=False)
class Posterior:
    """Where a fit ended, with the covariance of everything that is no pose.

    Attributes
    ----------
    problem : FitProblem
        With the shifts that outlines share.
    state : State
    shifts : SharedShifts
    noise : NoiseModel
    covariance : (n_kept, n_kept) array
        Of parameters, radii, shifts, intrinsics and cameras, all together.
    """

    problem: FitProblem
    state: State
    shifts: SharedShifts
    noise: NoiseModel
    covariance: Array

    def of_images(
        self,
        measurements: Measurements,
        outlines: Outlines,
        T_Rb_Re: Sequence[RigidTransform],
    ) -> Foretold:
        """Return what the fit knows of other images of the same views.

        Parameters
        ----------
        measurements : Measurements
            The images.
        outlines : Outlines
            Their outlines; the used ones enter.
        T_Rb_Re : sequence of RigidTransform
            Their poses.

        Raises
        ------
        DatasetError
            If an outline cannot be used.
        """
        legs, state = self.problem.legs, self.state
        found = of_parts(observed_outlines(outlines, measurements, legs), self.problem.layout.parts)
        found = seen_by(found, state.cameras)
        possible = possible_shifts(found, legs.names, self.problem.outlines)
        shifts = possible.of_sizes(self.shifts.sigma)
        problem = with_measurements(self.problem, measurements, found, shifts)
        known = {self.problem.named[i]: i for i in self.problem.layout.bias.tolist()}
        values = dict(zip(known, state.biases.tolist(), strict=True))
        others = [legs.radii[part] for part in found.parts[len(state.radii) :]]
        R, t = components(T_Rb_Re)
        return Foretold(
            problem,
            replace(
                state,
                radii=np.append(state.radii, others),
                biases=np.array([values.get(name, 0.0) for name in shifts.names]),
                R_pose=R,
                t_pose=t,
            ),
            self._covariance_of(problem, shifts),
        )

    def _covariance_of(self, problem: FitProblem, shifts: SharedShifts) -> Array:
        """Return the covariance of the unknowns of a problem with other shifts."""
        old, new = self.problem, problem.layout
        place = {name: i for i, name in enumerate(old.named)}
        cameras = range(old.layout.n_named, old.layout.n_kept)
        where = np.array([*(place.get(name, -1) for name in problem.named), *cameras], np.intp)
        is_known = where >= 0
        covariance = np.zeros((new.n_kept, new.n_kept))
        covariance[new.bias, new.bias] = shifts.sigmas**2
        kept = where[is_known]
        covariance[np.ix_(is_known, is_known)] = self.covariance[np.ix_(kept, kept)]
        return covariance
