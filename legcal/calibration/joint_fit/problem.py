"""The problem of the joint fit: its variables, its factors, and the exact constraints of poses.

The blocks, in the order of x: kinematic parameters (``legs``), ``radii``, intrinsics (``cameras``),
``board_scale`` of the board on each link, common-mode edge ``biases``, all of which have names;
``camera_pose``, ``board_pose`` and ``own_zeros`` of encoders in some images; and the eliminated
``platform_pose``. Another kind of measurement is a class with a factor, registered in
:class:`legcal.calibration.joint_fit.factors.Observed`; what it depends on besides is a field of
:class:`State` and a block in :func:`_build_problem`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.factors import (
    BoardCorners,
    Observed,
    ObservedCorners,
    ObservedEdges,
    ObservedOutlines,
    Readings,
    measured_lengths,
    observed_arrays,
    observed_corners,
    observed_edges,
    observed_readings,
)
from legcal.calibration.joint_fit.outline_errors import EdgeBiases, NoiseModel
from legcal.calibration.joint_fit.parameter_choices import (
    NO_CHOICES,
    Choices,
    KnownIntrinsics,
    Prior,
    board_scale,
)
from legcal.calibration.joint_fit.part_errors import part_errors
from legcal.calibration.joint_fit.variables import (
    DEFAULT_SETTINGS,
    FittedLegs,
    LegConstraints,
    LegParameters,
    Postures,
    RefinementSettings,
    Start,
    State,
    changed_cameras,
    intrinsic_of,
)
from legcal.calibration.tuning import EDGE_BIAS_PX, EDGE_SHARE, LEAN_SIGMA
from legcal.data.measurements import Measurements, row_names
from legcal.data.outlines import Outlines
from legcal.errors import NotIdentifiable
from legcal.estimation.loss import PseudoHuber
from legcal.estimation.problem import (
    NO_PRIOR,
    EstimationProblem,
    Frames,
    GaussianPrior,
    Linearization,
    Variables,
    all_free,
    fixed_at_start,
)
from legcal.estimation.solver import NormalEquations
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns
from legcal.machine.equations import freedoms
from legcal.machine.leg import LINKS, Leg, ParameterId, radius_name
from legcal.machine.parameters import Parametrization, is_held_by_default
from legcal.machine.rods import reading_legs, readings_of_rods
from legcal.machine.ties import wholly_tied
from legcal.vision.camera import (
    Camera,
    intrinsic_names,
    intrinsic_unit,
    intrinsic_values,
    shared_cameras,
    stated_covariances,
    with_intrinsics,
)

_MAX_STEP = (0.3, 0.3, 0.3, np.inf, np.inf, np.inf)  # of a frame: [rad], and any displacement


@dataclass(frozen=True, eq=False, kw_only=True)
class FitProblem(EstimationProblem[State]):
    """A joint fit, built and not yet solved."""

    parameters: LegParameters
    choices: Choices
    observed: Observed
    first_radii: Array  # (n_radii,) starting values
    first_cameras: tuple[Camera, ...]
    first_board_scale: Array  # (2,)
    keys: tuple[str, ...]  # names of the estimated intrinsics
    images: Mapping[tuple[int, int], str]  # name of an image, by view and pose
    settings: RefinementSettings
    rejected_corners: tuple[tuple[int, int, int], ...] = ()  # view, pose (-1: all), number

    @property
    def loss(self) -> PseudoHuber:
        """Robust loss of outlines and corners."""
        return PseudoHuber(self.settings.loss_width)

    @property
    def legs(self) -> FittedLegs:
        """The legs."""
        return self.parameters.legs

    @property
    def outlines(self) -> ObservedOutlines:
        """The outlines."""
        return self.observed.outlines

    @property
    def readings(self) -> Readings:
        """The readings."""
        return self.observed.readings

    @property
    def edges(self) -> ObservedEdges:
        """The edges of bodies."""
        return self.observed.edges

    @property
    def boards(self) -> tuple[ObservedCorners, ...]:
        """Corners of the calibration board on each link; empty without a board."""
        return self.observed.boards

    @property
    def free(self) -> BoolArray:
        """Which kinematic parameters are unknowns, (p,)."""
        return self.parameters.free

    @property
    def calibrated(self) -> IntArray:
        """Columns in x of the intrinsics with the covariance of their camera files as prior."""
        block = self.block("cameras")
        names = [block.labels[i] for i in block.prior.unknown.tolist()]
        is_of_file = np.array([name not in self.choices.priors for name in names], dtype=np.bool_)
        return self.where("cameras")[block.prior.unknown[is_of_file]]

    @property
    def n_kinematic(self) -> int:
        """Number of estimated kinematic parameters, the first unknowns."""
        return int(self.free.sum())

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns; a pose counts with its degrees of freedom under constraints."""
        d = self.d_element
        bound = 6 - len(freedoms(self.legs.frame_legs))
        bound += sum(leg.n_constraints for leg in self.legs.nominal)
        bound -= self.legs.ties.n_dependent
        n_tied = self.parameters.n_tied
        return self.n_kept - n_tied + max(d - bound, 0) * self.n_elements

    @property
    def n_equations(self) -> int:
        """Number of residuals, priors left out."""
        return sum(factor.n * factor.n_rows for factor in self.factors)

    def require_determined(self) -> None:
        """Raise NotIdentifiable if there are fewer equations than unknowns."""
        equations = self.n_equations + len(self.priors.mean)
        if equations >= self.n_unknowns:
            return
        raise NotIdentifiable(
            f"The fit is not determined: {len(self.images)} images with {len(self.outlines)} "
            f"outlines and {len(self.readings)} readings give {equations} equations for "
            f"{self.n_unknowns} unknowns; add images."
        )

    def begin(self, start: Start) -> State:
        """Return the state at a start, fixed parameters at their values."""
        return State(
            self.parameters.at_fixed(start.legs),
            self.first_radii,
            self.first_cameras,
            self.first_board_scale,
            np.zeros(self.block("biases").n_unknowns),
            Frames.of(start.T_camera_Rb),
            Frames.of([start.T_Rb_board, start.T_Re_board]),
            self.postures(start.legs, start.T_Rb_Re),
            np.zeros(self.block("own_zeros").n_unknowns),
            np.zeros((len(self.edges.bodies), 3)),
        )

    def postures(self, legs: Sequence[Leg], T_Rb_Re: Sequence[RigidTransform]) -> Postures:
        """Return postures at poses, with measured readings of actuators.

        Missing readings are solved from the rods. These are starting values only: they have no
        derivative where a rod is perpendicular to the motion of its joint at A.
        """
        R, t = Frames.of(T_Rb_Re)
        q, read = readings_of_rods(legs, R, t), self.readings
        of_actuators = read.actuator >= 0
        q[read.pose[of_actuators], read.actuator[of_actuators]] = read.reading[of_actuators]
        return Postures(R, t, q)

    @property
    def lengthening(self) -> Array:
        """The readings (n_poses, n_legs) as :func:`solve_poses` takes them, NaN where unknown.

        They are s q of actuated legs [m], and q of rods on actuators [m or rad].
        """
        table = np.full((self.n_elements, self.legs.n_legs), np.nan)
        table[self.readings.pose, self.readings.leg] = self.readings.length
        return table[:, list(reading_legs(self.legs.nominal))]

    def offsets(self, state: State) -> Array:
        """Return the offsets of both ends of outlines from predicted ones, (n, 2) [px]."""
        return self.outlines.offsets(self.keys, state)

    def weighted(self, noise: NoiseModel, weight: Array | BoolArray | None = None) -> FitProblem:
        """Set the noise of outlines, and weights (n_outlines,) of their squares."""
        whitening = noise.whitening(self.outlines.covariance, weight)
        return self.with_factors(replace(self.factor("outlines"), whitening=whitening))

    def unknown_errors(self, shifts: Array) -> dict[str, Array]:
        """Return how errors that a fit does not know move whitened residuals, by their factor.

        By one standard deviation of each, (n, q, c): of *shifts* (n, 2, k) of both ends of outlines
        [px], and in photographs of what each edge of a body keeps in all images of a view.
        """
        outlines, edges = (self.factor(name).whitening for name in ("outlines", "edges"))
        used = np.asarray(edges)[:, 0, 0] > 0.0
        lines = EDGE_SHARE * self.edges.lines_in_views(used & self.choices.of_photographs)
        before, behind = (shifts.shape[2], 0), (0, lines.shape[2])
        return {
            "outlines": np.pad(outlines @ shifts, ((0, 0), (0, 0), behind)),
            "edges": np.pad(lines, ((0, 0), (0, 0), before)),
        }

    def with_biases(self, biases: EdgeBiases) -> FitProblem:
        """Replace the common-mode edge biases."""
        outlines = replace(self.outlines, bias_index=biases.index, bias_shift=biases.shift)
        factor = replace(outlines.factor(self.keys), whitening=self.factor("outlines").whitening)
        other = replace(self, observed=self.observed._replace(outlines=outlines))
        return other.with_parts((_bias_block(biases),), (factor,))

    def with_corners(
        self, corners: ObservedCorners, rejected: Sequence[tuple[int, int, int]]
    ) -> FitProblem:
        """Replace the corners of a calibration board, and record rejected ones."""
        other = replace(
            self,
            observed=self.observed.with_corners(corners),
            rejected_corners=(*self.rejected_corners, *rejected),
        )
        return other.with_factors(corners.factor(self.keys))

    def with_measurements(
        self, measurements: Measurements, outlines: ObservedOutlines, biases: EdgeBiases
    ) -> FitProblem:
        """Replace the measurements by other images of the same views, without boards.

        The parts of the problem come first in *outlines*; further parts have fixed radii.
        """
        observed = Observed(
            replace(outlines, bias_index=biases.index, bias_shift=biases.shift),
            observed_readings(measurements, self.legs),
            replace(observed_edges(None, measurements, self.legs, ()), bodies=self.edges.bodies),
            *observed_corners(None, measurements, ()),
        )
        radii = self.block("radii")
        more = np.full((len(outlines.parts) - len(radii.unknown), 1), -1)
        radii = replace(radii, unknown=np.concatenate([radii.unknown, more]))
        blocks = {"radii": radii, "biases": _bias_block(biases)}
        return replace(
            self,
            observed=observed,
            variables=tuple(blocks.get(block.name, block) for block in self.variables),
            eliminated=_poses(measurements.n_poses, self.legs.n_actuators),
            factors=observed.factors(self.keys),
        )

    def with_choices(self, choices: Choices) -> FitProblem:
        """Rebuild the problem for the same measurements with other choices of parameters."""
        observed = self.observed._replace(outlines=self.outlines.without_biases())
        cameras, n_poses = self.first_cameras, self.n_elements
        return _build_problem(
            self.legs, observed, cameras, n_poses, self.images, self.settings, choices
        )


FitLinear = Linearization[FitProblem, State]
FitNormal = NormalEquations[FitProblem, State]


def build_fit(
    legs: FittedLegs,
    measurements: Measurements,
    outlines: Outlines,
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    board: BoardCorners | None = None,
    choices: Choices = NO_CHOICES,
    edges: Outlines | None = None,
) -> FitProblem:
    """Build the joint fit without solving it; arguments as those of :func:`refine`.

    The images need not determine the parameters (:meth:`FitProblem.require_determined`); more may
    follow.

    Raises DatasetError if an outline cannot be used.
    """
    cameras = tuple(
        _with_values(camera, owner, choices)
        for camera, owner in zip(measurements.cameras, measurements.owners, strict=True)
    )
    observed = observed_arrays(measurements, legs, outlines, board, cameras, edges)
    places = zip(measurements.view.tolist(), measurements.pose.tolist(), strict=True)
    images, n_poses = dict(zip(places, row_names(measurements), strict=True)), measurements.n_poses
    return _build_problem(legs, observed, cameras, n_poses, images, settings, choices)


def _with_values(camera: Camera, owner: str, choices: Choices) -> Camera:
    """Set the intrinsics that are fixed at given values."""
    given = {
        key: choices.values[f"{owner}.{key}"]
        for key in intrinsic_names(camera)
        if f"{owner}.{key}" in choices.values
    }
    return with_intrinsics(camera, given) if given else camera


def _build_problem(
    legs: FittedLegs,
    observed: Observed,
    cameras: tuple[Camera, ...],  # of the views
    n_poses: int,
    images: Mapping[tuple[int, int], str],
    settings: RefinementSettings,
    choices: Choices,
) -> FitProblem:
    """Build the problem of measurements with the unknowns and priors of choices."""
    outlines, boards = observed.outlines, observed.boards
    parameters, kinematic = _kinematic(legs, outlines, settings, choices)
    owners = shared_cameras(outlines.views, cameras)
    shown = {owners[v] for v in observed.views.tolist()}
    intrinsics, keys = _intrinsics(outlines.views, cameras, owners, shown, choices)
    camera_pose = fixed_at_start(len(cameras), 6)
    camera_pose[observed.views] = all_free(len(observed.views), 6)
    board_pose = fixed_at_start(len(boards), 6)
    has_board = np.array([len(corners) > 0 for corners in boards])
    board_pose[has_board] = all_free(int(has_board.sum()), 6)
    no_biases = Variables("biases", np.zeros((0, 1), dtype=np.intp))
    nominal = np.array([legs.radii[part] for part in outlines.parts])
    radii = [radius_name(legs.names[leg], part) for leg, part in outlines.parts]
    if all(leg.reads_angle for leg in legs.nominal):
        choices = replace(choices, priors=_with_edge_bias(choices.priors, radii, nominal, outlines))
    blocks = (
        kinematic,
        _scalars("radii", radii, "m", nominal, settings.radius_sigma * nominal, choices),
        intrinsics,
        _board_scales(boards, settings, choices),
        _leans(legs.names, observed.edges.bodies),
        no_biases,
        Variables("camera_pose", camera_pose, Frames.moved, max_step=_MAX_STEP),
        Variables("board_pose", board_pose, Frames.moved, max_step=_MAX_STEP),
        Variables("own_zeros", all_free(observed.readings.by_zero.shape[1], 1)),
    )
    return FitProblem(
        variables=tuple(_stated(block, choices) for block in blocks),
        eliminated=_poses(n_poses, legs.n_actuators),
        factors=(*observed.factors(keys), measured_lengths(legs.names, choices).factor()),
        constraint=LegConstraints(parameters),
        name="joint fit",
        remedy="start nearer to the truth (joints to 1 % of a leg length, cameras to 2 % and 2 "
        "deg) and check the camera poses, the readings and that outlines or axes are those of the "
        "right legs and edges",
        parameters=parameters,
        choices=choices,
        observed=observed,
        first_radii=np.array(
            [choices.values.get(n, r) for n, r in zip(radii, nominal.tolist(), strict=True)]
        ),
        first_cameras=cameras,
        first_board_scale=np.array([choices.values.get(board_scale(k), 1.0) for k in LINKS]),
        keys=keys,
        images=images,
        settings=settings,
    )


def _kinematic(
    legs: FittedLegs, outlines: ObservedOutlines, settings: RefinementSettings, choices: Choices
) -> tuple[LegParameters, Variables]:
    """Estimated kinematic parameters, and their block.

    The lines of visible arms have default priors; parameters with a choice have none.
    """
    names, chosen = legs.parametrization.names, {*choices.fixed, *choices.free, *choices.priors}
    seen = [leg for leg, part in outlines.parts if (leg, part) in outlines.arms]
    sigmas = arm_sigmas(legs.parametrization, legs.nominal, seen, settings)
    arms = {name: sigma for name, sigma in sigmas.items() if name not in chosen}
    free = np.array(
        [not choices.holds(n, by_default=is_held_by_default(n) and n not in arms) for n in names],
        dtype=np.bool_,
    )
    parameters = LegParameters(legs, free, choices.values)
    if parameters.n_tied:
        free[free] &= ~wholly_tied(parameters.tie_rows(legs.nominal)[1])
        parameters = LegParameters(legs, free, choices.values)
    unknown = tuple(n for n, is_free in zip(names, free, strict=True) if is_free)
    units = zip(legs.parametrization.units, free, strict=True)
    prior = GaussianPrior(
        np.array([unknown.index(name) for name in arms], dtype=np.intp),
        np.zeros(len(arms)),
        np.array(list(arms.values())),
    )
    if choices.built is not None:
        prior = part_errors(legs, choices.built).prior(free)
    block = Variables(
        "legs",
        parameters.unknown,
        parameters.retract,
        unknown,
        tuple(u for u, is_free in units if is_free),
        parameters.coordinates,
        lru_cache(maxsize=1)(parameters.jacobian) if parameters.turns else None,
        prior=prior,
    )
    return parameters, block


def arm_sigmas(
    parametrization: Parametrization,
    legs: Sequence[Leg],
    seen: Iterable[int],  # legs with visible arms
    settings: RefinementSettings = DEFAULT_SETTINGS,
) -> dict[str, float]:
    """Return the prior standard deviations of the lines of arms, by parameter [rad, m]."""
    lengths = [leg.q0 for leg in legs if leg.actuator is not None]
    length = float(np.mean(lengths)) if lengths else 0.0
    sigmas = (settings.arm_axis_sigma,) * 2 + (settings.arm_point_sigma * length,) * 2
    names, place = parametrization.names, parametrization.place[:, ActuatorColumns.ARM]
    return {
        names[i]: sigma
        for leg in seen
        for i, sigma in zip(place[leg].tolist(), sigmas, strict=True)
    }


def _leans(names: Sequence[str], bodies: Sequence[tuple[int, str]]) -> Variables:
    """Return the block of the leans of bodies, with their prior."""
    labels = tuple(f"{names[leg]}.lean.{link}.{axis}" for leg, link in bodies for axis in "xyz")
    n = len(labels)
    prior = GaussianPrior(np.arange(n, dtype=np.intp), np.zeros(n), np.full(n, LEAN_SIGMA))
    return Variables("leans", all_free(n // 3, 3), labels=labels, units=("rad",) * n, prior=prior)


def _poses(n_poses: int, n_actuators: int) -> Variables:
    max_step = (*_MAX_STEP, *(0.3,) * n_actuators)
    free = all_free(n_poses, len(max_step))
    return Variables("platform_pose", free, Postures.moved, max_step=max_step)


def _scalars(
    name: str, labels: Sequence[str], unit: str, mean: Array, sigma: Array, choices: Choices
) -> Variables:
    """Block of scalars with priors; freed ones have none, and some may be fixed."""
    is_free = np.array([not choices.holds(label) for label in labels], dtype=np.bool_)
    unknown = np.where(is_free, np.cumsum(is_free) - 1, -1).astype(np.intp)
    with_prior = [
        i
        for i, label in enumerate(labels)
        if is_free[i] and label not in choices.free and label not in choices.priors
    ]
    prior = GaussianPrior(unknown[with_prior], mean[with_prior], sigma[with_prior])
    free = tuple(label for label, one in zip(labels, is_free, strict=True) if one)
    return Variables(name, unknown[:, None], labels=free, units=(unit,) * len(free), prior=prior)


def _with_edge_bias(
    priors: Mapping[str, Prior], radii: Sequence[str], nominal: Array, outlines: ObservedOutlines
) -> dict[str, Prior]:
    """Widen stated priors of radii by a common-mode bias of edges.

    Where readings carry no length, radii determine the scale of the machine, and a common bias of
    all edges does not show in residuals: rods look thinner, as in a larger machine. Errors of
    single radii average out over the rods and the common bias does not, so that its variance is
    added to each radius, times their number.
    """
    stated = [name for name in radii if name in priors]
    relative_bias = EDGE_BIAS_PX / (0.5 * outlines.width_px)  # of a radius
    sigma_of = dict(zip(radii, np.sqrt(len(stated)) * relative_bias * nominal, strict=True))
    wider = {
        n: replace(priors[n], sigma=float(np.hypot(priors[n].sigma, sigma_of[n]))) for n in stated
    }
    return {**priors, **wider}


def _board_scales(
    boards: Sequence[ObservedCorners], settings: RefinementSettings, choices: Choices
) -> Variables:
    """Block of scale factors of boards; fixed for a link without a board."""
    seen = [len(corners) > 0 for corners in boards]
    names = [board_scale(c.link) for c in boards if len(c)]
    sigma = np.full(len(names), settings.board_scale_sigma)
    block = _scalars("board_scale", names, "", np.ones(len(names)), sigma, choices)
    unknown = np.full((len(boards), 1), -1, dtype=np.intp)
    unknown[seen] = block.unknown
    return replace(block, unknown=unknown)


def _stated(block: Variables, choices: Choices) -> Variables:
    """Add the stated priors to a block."""
    which = [i for i, label in enumerate(block.labels) if label in choices.priors]
    if not which:
        return block
    priors = [choices.priors[block.labels[i]] for i in which]
    stated = GaussianPrior(
        np.array(which, dtype=np.intp),
        np.array([prior.mean for prior in priors]),
        np.array([prior.sigma for prior in priors]),
    )
    return replace(block, prior=block.prior + stated)


def _intrinsics(
    views: Sequence[str],
    cameras: Sequence[Camera],
    owners: Sequence[str],
    shown: Collection[str],  # owners that measurements depend on
    choices: Choices,
) -> tuple[Variables, tuple[str, ...]]:
    """Block of intrinsics, shared by views of one camera, and the names of its columns.

    The prior of intrinsics without a choice is the covariance of the camera file.
    """
    chosen, stated = {*choices.free, *choices.priors}, dict(choices.cameras)
    for owner, covariance in stated_covariances(views, cameras).items():
        mean = intrinsic_values(cameras[views.index(owner)])
        stated.setdefault(owner, KnownIntrinsics(mean, covariance))
    names, prior = list[str](), NO_PRIOR
    for view, camera in zip(views, cameras, strict=True):
        if view not in owners:
            continue
        names_of_view = [f"{view}.{key}" for key in intrinsic_names(camera)]
        intrinsics = stated.get(view) if view in shown else None
        variances = (
            [0.0] * len(names_of_view)
            if intrinsics is None
            else np.diagonal(intrinsics.covariance).tolist()
        )
        has_prior = [
            v > 0.0 and name not in chosen | choices.fixed
            for name, v in zip(names_of_view, variances, strict=True)
        ]
        free = [k for k, name in enumerate(names_of_view) if has_prior[k] or name in chosen]
        with_prior = [k for k in free if has_prior[k]]
        if intrinsics is not None and with_prior:
            numbers = np.array([len(names) + free.index(k) for k in with_prior], dtype=np.intp)
            covariance = intrinsics.covariance[np.ix_(with_prior, with_prior)]
            prior += GaussianPrior.from_covariance(numbers, intrinsics.mean[with_prior], covariance)
        names += [names_of_view[k] for k in free]
    parameters = [ParameterId.parse(name) for name in names]
    keys = tuple(dict.fromkeys(number.kind for number in parameters))
    number = {name: i for i, name in enumerate(names)}
    index = [[number.get(f"{owner}.{key}", -1) for key in keys] for owner in owners]
    unknown = np.array(index, dtype=np.intp).reshape(len(views), len(keys))
    view_and_key = [(views.index(number.owner), number.kind) for number in parameters]
    block = Variables(
        "cameras",
        unknown,
        partial(changed_cameras, keys=keys),
        tuple(names),
        tuple(intrinsic_unit(key) for _, key in view_and_key),
        lambda found: np.array([intrinsic_of(found[view], key) for view, key in view_and_key]),
        prior=prior,
    )
    return block, keys


def _bias_block(biases: EdgeBiases) -> Variables:
    """Block of common-mode biases, random with known variances."""
    b = len(biases)
    prior = GaussianPrior(np.arange(b, dtype=np.intp), np.zeros(b), biases.sigmas)
    return Variables("biases", all_free(b, 1), labels=biases.names, units=biases.units, prior=prior)
