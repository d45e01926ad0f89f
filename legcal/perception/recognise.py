"""Which leg is which in all images, and where their cameras stand: with rough poses or without.

Bars of every image vote, all images of a view together. A rough camera pose is where the search of
its view begins; if the images do not agree near it, the view is searched as if there were none, and
a pose that they agree on elsewhere is used and said.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data import Outlines, is_edited, join_outlines
from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception.agreement import NEAREST, Picture, Poses, exchanged
from legcal.perception.camera_search import (
    START_PICTURES,
    Placed,
    is_mirrored,
    may_be_mirrored,
    mirrored,
    place_camera,
    place_near,
    with_first,
)
from legcal.perception.detection import NOT_PLACED, detect_outlines
from legcal.perception.outline import OUTSIDE, outline_parts
from legcal.perception.radii import LEFT, MOST_TURNS, NO_OTHER_RADII, OtherRadii, Part, other_radii
from legcal.perception.search import Group, Search, group_views
from legcal.perception.view_fit import (
    ViewFit,
    derivatives_by,
    fit_view,
    least_evidence,
    metric_of,
    offsets_of,
)
from legcal.workers import Run, in_turn


def named(names: Sequence[str]) -> str:
    """Return the name of a view, or of a group."""
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def few_outlines(name: str, n_outlines: int, n_images: int) -> str:
    """Say that hardly an outline was found at the pose that bars suggest."""
    return (
        f"view {name}: its camera could not be placed: found only {n_outlines} outlines that "
        f"agree in its {n_images} image{'s' * (n_images != 1)}, needed more than other edges give "
        "by chance; add images at other readings, in better light, or a rough T_base_camera."
    )


def placing_problem(name: str, placed: Placed, hinted: bool, *, is_mirrored: bool) -> str:
    """Say why a view could not be placed."""
    if is_mirrored:
        return (
            f"view {name}: its camera could not be placed: found that its images show the legs if "
            "left and right are exchanged, needed photographs as the camera took them; replace "
            "the mirrored images by the originals."
        )
    where = "near its T_base_camera or anywhere else" if hinted else "anywhere"
    if len(placed.poses) == 0:
        return (
            f"view {name}: its camera could not be placed: found no pair of edges in its images "
            "that could be a leg, needed legs; check that the photographs show the machine, "
            "sharp and neither black nor overexposed."
        )
    legs, n = float(placed.support[0].mean()), placed.expected[0].mean()
    if not placed.is_enough:
        return (
            f"view {name}: its camera could not be placed: found no pose {where} at which its "
            f"images show the legs (at the best one {legs:.1f} of {n:.0f} legs an image), needed "
            f"{placed.needed:.1f}; check that the images belong to this machine and to their "
            "readings, that they are no mirror images, the camera file, and the legs of the view "
            "if dataset.yaml names them."
        )
    if len(placed.poses) == 1 or (placed.by_outlines is False and placed.leads):
        return (
            f"view {name}: its camera could not be placed: found too few outlines at the pose "
            f"{where} at which its images show {legs:.1f} of {n:.0f} legs an image, needed more "
            "than other edges in the images make as well; add images at other readings, in "
            "better light, or a rough T_base_camera."
        )
    other = placed.pose(1)
    apart = placed.pose().inv() * other
    return (
        f"view {name}: its camera could not be placed: found two poses at which its images show "
        f"the legs about as well ({legs:.1f} and {placed.support[1].mean():.1f} legs an image; "
        f"{1e3 * np.linalg.norm(apart.translation):.0f} mm and "
        f"{np.degrees(apart.rotation.magnitude()):.0f} deg apart), needed one; add images at "
        "readings that differ more between the legs, or a rough T_base_camera."
    )


@dataclass(frozen=True, eq=False)
class Recognised:
    """Where the legs and the cameras are.

    Attributes
    ----------
    T_base_camera : list of RigidTransform or None, for each view
        None where a view could not be placed, or has no images.
    shift : (n_views, n_legs, 2, 3) array
        Where each view sees A and B of the legs, against the model, in the base link [m].
    joint_error : (n_views, n_legs) array
        How far the legs may still be from there [m].
    unplaced : dict of str
        Why views could not be placed, by view: one sentence for each.
    radii : OtherRadii
        Radii that the images contradict: the cameras were placed with those that they show.
    """

    T_base_camera: list[RigidTransform | None]
    shift: Array
    joint_error: Array
    unplaced: dict[int, str]
    radii: OtherRadii


def shifted(found: Recognised, view: IntArray, A: Array, B: Array) -> tuple[Array, Array]:
    """Return joint centres (n_rows, n_legs, 3) where the view of each row sees them [m]."""
    return A + found.shift[view][:, :, 0], B + found.shift[view][:, :, 1]


def sideways_sigmas(search: Search, group: Group, fit: ViewFit) -> Array:
    """Return how well a fit knows where legs are seen, (n_rows, n_legs) [px].

    One standard deviation across each leg, at the joint where it is known worse; infinite for
    legs that reach behind the camera, and in images of other views.
    """
    m, n_legs = search.measurements, search.n_legs
    A, B = fit.joints(search.A_base, search.B_base)
    T_group_base = fit.T_base_group.inv()
    centre = T_group_base.apply(fit.middle)
    sigma = np.full((m.n_rows, n_legs), np.inf)
    for v in group.views:
        rows = [row for row in group.rows if m.view[row] == v]
        T, camera = group.T_group_camera[v].inv(), m.views[v].camera
        X_group = T_group_base.apply(np.stack([A[rows], B[rows]], axis=2).reshape(-1, 3))
        X = T.apply(X_group).reshape(-1, 2, 3)
        front = X[..., 2].min(axis=1) > NEAREST
        X = np.where(front[:, None, None], X, [[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
        ends = X[..., :2] / X[..., 2:]
        thin, edge = np.zeros(len(X)), np.zeros(len(X), dtype=np.intp)
        D = offsets_of(X, thin, edge, ends, metric_of(camera, ends))[1] @ T.rotation.as_matrix()
        J = derivatives_by(D, X_group.reshape(-1, 2, 3) - centre, T_group_base.rotation.as_matrix())
        leg = np.tile(np.arange(n_legs), len(rows))
        place = np.concatenate(
            [np.broadcast_to(np.arange(6), (len(leg), 6)), 6 + 6 * leg[:, None] + np.arange(6)], 1
        )
        of_leg = fit.covariance[place[:, :, None], place[:, None, :]]
        variance = np.einsum("nei,nij,nej->ne", J[..., :12], of_leg, J[..., :12])
        variance += fit.image_sigma**2 * np.sum(J[..., 12:] ** 2, axis=-1)
        worst = np.sqrt(variance.max(axis=1))
        sigma[rows] = np.where(front, worst, np.inf).reshape(len(rows), n_legs)
    return sigma


def reversed_pose(search: Search, group: Group, T_base_group: RigidTransform) -> RigidTransform:
    """Return the pose at which a flat machine looks alike from far: near and far exchanged."""
    X = np.concatenate([search.A_base[group.rows], search.B_base[group.rows]]).reshape(-1, 3)
    T = T_base_group.inv()
    R, t = exchanged(T.rotation.as_matrix()[None], T.translation[None], X)
    return RigidTransform.from_components(t[0], Rotation.from_matrix(R[0])).inv()


DISAGREES = "disagrees with the other legs of its view"  # a reason
WINDOW = 2.0, 3.0  # around a fit: [px], standard deviations
WIDEST = 40.0  # [px]
CLEAR = 0.7  # of the evidence that a doubtful pose must have, where bars leave no doubt
Legs = set[tuple[int, int]]  # in images: row and leg


@dataclass(frozen=True, eq=False)
class Closer:
    """What a closer look gave.

    Attributes
    ----------
    recognised : Recognised
        Cameras and joints by the outlines.
    A_base, B_base : (n_rows, n_legs, 3) array
        Joint centres where the images see them [m].
    outlines : Outlines
        Those that agree with them; what was searched for and not found keeps its reason.
    fits : tuple of ViewFit or None
        The fit of each group; None where it was not placed or has no outlines.
    """

    recognised: Recognised
    A_base: Array
    B_base: Array
    outlines: Outlines
    fits: tuple[ViewFit | None, ...]


def look_closer(
    search: Search,
    groups: Sequence[Group],
    found: Recognised,
    outlines: Outlines,
    leg_names: Sequence[str],
    *,
    together: bool = True,
    run: Run = in_turn,
    progress: Callable[[int], None] | None = None,
) -> Closer:
    """Fit all views to their outlines, and look for the legs that are missing near that.

    Parameters
    ----------
    search : Search
        The images and the model.
    groups : sequence of Group
        Views that are placed together.
    found : Recognised
        Where the legs and the cameras are.
    outlines : Outlines
        Measured near there.
    leg_names : sequence of str
        Names of the legs.
    together : bool
        As for :func:`legcal.perception.outline.outline_parts`.
    run : callable
        How images are searched.
    progress : callable, optional
        Called with the row of each image that was searched again.
    """
    fits = _turned_over(search, groups, found, outlines)
    found = _fitted(groups, found, fits)
    outlines, fits = _agreeing(search, groups, found, outlines, fits)
    window = _windows(search, groups, fits, outlines)
    found = _fitted(groups, found, fits)
    A, B = _joints(search, groups, found, fits)
    again = detect_outlines(
        search.load,
        search.measurements,
        A,
        B,
        search.cylinders,
        found.T_base_camera,
        search.wanted,
        leg_names,
        window=window,
        progress=progress,
        run=run,
        method=partial(outline_parts, together=together, foretold=True),
    )
    outlines = _merged(outlines, again)
    fits = _fits(search, groups, found, outlines)
    outlines, fits = _agreeing(search, groups, found, outlines, fits)
    found = _believed(search, groups, _fitted(groups, found, fits), fits)
    placed = np.array([T is not None for T in found.T_base_camera])
    outlines = _rejected(outlines, ~placed[search.measurements.view[outlines.row]], NOT_PLACED)
    return Closer(found, *_joints(search, groups, found, fits), outlines, tuple(fits))


def _agreeing(
    search: Search,
    groups: Sequence[Group],
    found: Recognised,
    outlines: Outlines,
    fits: list[ViewFit | None],
) -> tuple[Outlines, list[ViewFit | None]]:
    """Return outlines without misfits, and the fits to the others."""
    if not any(fit is not None and fit.misfits.any() for fit in fits):
        return outlines, fits
    outlines = _without_misfits(outlines, fits)
    return outlines, _fits(search, groups, found, outlines)


def _fits(
    search: Search, groups: Sequence[Group], found: Recognised, outlines: Outlines
) -> list[ViewFit | None]:
    """Return the fit of each group; None where it was not placed or has no outlines."""
    fits: list[ViewFit | None] = []
    for group in groups:
        v = group.views[0]
        T = found.T_base_camera[v]
        if T is None:
            fits.append(None)
            continue
        T_base_group = T * group.T_group_camera[v].inv()
        fits.append(fit_view(search, group, T_base_group, found.shift[v], outlines))
    return fits


def _turned_over(
    search: Search, groups: Sequence[Group], found: Recognised, outlines: Outlines
) -> list[ViewFit | None]:
    """Return fits, with near and far exchanged where outlines suit that better."""
    fits = _fits(search, groups, found, outlines)
    for g, (group, fit) in enumerate(zip(groups, fits, strict=True)):
        if fit is None or len(group.views) > 1 or fit.suits:
            continue
        other = reversed_pose(search, group, fit.T_base_group)
        over = fit_view(search, group, other, np.zeros_like(fit.shift), outlines)
        if over is not None and over.evidence > fit.evidence:
            fits[g] = over
    return fits


def _without_misfits(outlines: Outlines, fits: Sequence[ViewFit | None]) -> Outlines:
    """Return outlines without those of legs that do not fit; what people edited stays."""
    wrong: Legs = set()
    for fit in fits:
        if fit is not None:
            wrong.update(
                zip(fit.row[fit.misfits].tolist(), fit.leg[fit.misfits].tolist(), strict=True)
            )
    return _rejected(outlines, _among(outlines, wrong), DISAGREES)


def _rejected(outlines: Outlines, wrong: BoolArray, why: str) -> Outlines:
    """Return outlines without some of those that were used."""
    out = outlines.used & wrong & ~is_edited(outlines)
    reason = tuple(
        why if is_out else reason
        for is_out, reason in zip(out.tolist(), outlines.reason, strict=True)
    )
    return replace(outlines, used=outlines.used & ~out, reason=reason)


def _believed(
    search: Search, groups: Sequence[Group], found: Recognised, fits: Sequence[ViewFit | None]
) -> Recognised:
    """Return cameras without those for which hardly an outline speaks, near no rough pose."""
    T, unplaced = list(found.T_base_camera), dict(found.unplaced)
    for group, fit in zip(groups, fits, strict=True):
        least = CLEAR * least_evidence(group)
        is_sure = fit is not None and fit.is_determined and fit.evidence >= least
        if group.hint is not None or T[group.views[0]] is None or is_sure:
            continue
        name = named([search.measurements.views[v].name for v in group.views])
        n = 0 if fit is None else int(fit.n_outlines.sum())
        for v in group.views:
            T[v], unplaced[v] = None, few_outlines(name, n, len(group.rows))
    return replace(found, T_base_camera=T, unplaced=unplaced)


def _windows(
    search: Search, groups: Sequence[Group], fits: Sequence[ViewFit | None], outlines: Outlines
) -> Array:
    """Return how far missing legs may be from a fit (n_rows, n_legs) [px]; NaN for others."""
    missing = np.zeros((search.measurements.n_rows, search.n_legs), dtype=np.bool_)
    visible = [not why.startswith((OUTSIDE, NOT_PLACED)) for why in outlines.reason]
    missing[outlines.row[visible], outlines.leg[visible]] = True
    missing[outlines.row[outlines.used], outlines.leg[outlines.used]] = False
    window = np.full(missing.shape, np.nan)
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None and missing[group.rows].any():
            sigma = sideways_sigmas(search, group, fit)[group.rows]
            near = np.minimum(WINDOW[0] + WINDOW[1] * sigma, WIDEST)
            window[group.rows] = np.where(missing[group.rows], near, np.nan)
    return window


def _merged(outlines: Outlines, again: Outlines) -> Outlines:
    """Return outlines with those of legs that were found again in their place."""
    found = set(zip(again.row[again.used].tolist(), again.leg[again.used].tolist(), strict=True))
    kept, new = outlines.choose(~_among(outlines, found)), _among(again, found)
    return join_outlines([kept, again.choose(new)])


def _among(outlines: Outlines, legs: Legs) -> BoolArray:
    """Return which outlines are of some legs."""
    own = zip(outlines.row.tolist(), outlines.leg.tolist(), strict=True)
    return np.array([one in legs for one in own], dtype=np.bool_)


def _fitted(
    groups: Sequence[Group], found: Recognised, fits: Sequence[ViewFit | None]
) -> Recognised:
    """Return cameras and shifts by the fits."""
    T, shift = list(found.T_base_camera), found.shift.copy()
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None:
            for v in group.views:
                T[v], shift[v] = fit.T_base_group * group.T_group_camera[v], fit.shift
    return replace(found, T_base_camera=T, shift=shift)


def _joints(
    search: Search, groups: Sequence[Group], found: Recognised, fits: Sequence[ViewFit | None]
) -> tuple[Array, Array]:
    """Return joint centres (n_rows, n_legs, 3) by the fits, elsewhere as they were recognised."""
    A, B = shifted(found, search.measurements.view, search.A_base, search.B_base)
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None:
            by_fit = fit.joints(search.A_base, search.B_base)
            A[group.rows], B[group.rows] = (X[group.rows] for X in by_fit)
    return A, B


N_POSES, N_CLOSER = 4, 3  # that are looked at, and at the best of which missing legs are sought
# How many times the evidence for any other pose one needs, and how much more than the least.
TIMES, MORE = 1.6, 3.0
TIMES_AGREED, MORE_AGREED = 1.5, 0.0  # the same where bars are convincing by themselves
WITHOUT_RIVAL = 4.0  # times the evidence for others, from which on no more is needed either
TIMES_ALONE, MORE_ALONE = 2.5, 6.0  # and of a single image
JOINT_ERROR = 3e-3  # of the legs as a pose has them [m]
SAME_PX, SAME_PART = 3.0, 0.7  # of outlines that two poses share: how near, how many of them


@dataclass(frozen=True, eq=False)
class _Look:
    """What outlines say of a pose."""

    found: Recognised
    outlines: Outlines
    fit: ViewFit | None

    @property
    def evidence(self) -> float:
        """How much they speak for it."""
        return 0.0 if self.fit is None else self.fit.evidence


def look_again(search: Search, group: Group, placed: Placed, pictures: Sequence[Picture]) -> Placed:
    """Return poses with the one first that outlines speak for, and whether they leave a doubt.

    Parameters
    ----------
    search : Search
        The images and the model.
    group : Group
        Views that are placed together.
    placed : Placed
        Their poses by bars.
    pictures : sequence of Picture
        Of the group.
    """
    near = placed.hinted and placed.is_convincing
    if len(placed.poses) == 0 or near or placed.is_clear:
        return placed
    few = replace(group, rows=group.some)
    looks = [_look(search, few, placed, 0)]
    if not (placed.leads_clearly and _is_decided(looks, placed, few)):
        looks += [_look(search, few, placed, i) for i in range(1, min(N_POSES, len(placed.poses)))]
        if not (placed.is_convincing and _is_decided(looks, placed, few)):
            by_both = placed.score[: len(looks)] + [look.evidence for look in looks]
            for i in np.argsort(-by_both, kind="stable")[:N_CLOSER].tolist():
                looks[i] = _look_closer(search, few, looks[i])
    best = _best(looks)
    fit = looks[best].fit
    if fit is None or not _is_decided(looks, placed, few):
        return replace(placed, by_outlines=False)
    T = fit.T_base_group.inv()
    pose = Poses(T.rotation.as_matrix()[None], T.translation[None], fit.shift[None])
    return replace(with_first(placed, best, pose, pictures), by_outlines=True)


def _best(looks: Sequence[_Look]) -> int:
    """Return the pose that outlines speak for most."""
    return int(np.argmax([look.evidence for look in looks]))


def _is_decided(looks: Sequence[_Look], placed: Placed, group: Group) -> bool:
    """Say whether outlines speak for one pose, and not nearly as much for another one."""
    best = _best(looks)
    others = [
        look.evidence
        for i, look in enumerate(looks)
        if i != best and not _same(look.outlines, looks[best].outlines)
    ]
    more, times = (MORE, TIMES) if len(group.rows) > 1 else (MORE_ALONE, TIMES_ALONE)
    fit, other = looks[best].fit, max(others, default=0.0)
    if fit is None or not fit.is_determined:
        return False
    if best == 0 and placed.is_convincing:
        more, times = MORE_AGREED, TIMES_AGREED
    elif len(group.rows) > 1 and fit.evidence >= WITHOUT_RIVAL * other:
        more = MORE_AGREED
    return fit.evidence >= max(least_evidence(group) + more, times * other)


def _look(search: Search, group: Group, placed: Placed, i: int) -> _Look:
    """Measure outlines at a pose, and fit it to them."""
    m, shift = search.measurements, placed.poses.shift[i]
    T: list[RigidTransform | None] = [None] * len(m.views)
    for v in group.views:
        T[v] = placed.pose(i) * group.T_group_camera[v]
    n_views = len(m.views)
    shifts = np.broadcast_to(shift, (n_views, *shift.shape)).copy()
    error: Array = np.full((n_views, search.n_legs), JOINT_ERROR)
    found = Recognised(T, shifts, error, {}, NO_OTHER_RADII)
    image = tuple(name if row in group.rows else "" for row, name in enumerate(m.image))
    outlines = detect_outlines(
        search.load,
        replace(m, image=image),
        search.A_base + shift[:, 0],
        search.B_base + shift[:, 1],
        search.cylinders,
        T,
        search.wanted,
        [str(leg + 1) for leg in range(search.n_legs)],
        joint_error=error,
    )
    fit = fit_view(search, group, placed.pose(i), shift, outlines)
    return _Look(found, outlines, fit)


def _look_closer(search: Search, group: Group, look: _Look) -> _Look:
    """Return a look with the legs that are missing at a pose, as far as they are found."""
    if look.fit is None:
        return look
    names = [str(leg + 1) for leg in range(search.n_legs)]
    closer = look_closer(search, [group], look.found, look.outlines, names)
    return _Look(closer.recognised, closer.outlines, closer.fits[0])


def _same(one: Outlines, other: Outlines) -> bool:
    """Say whether two poses have most legs at the same places."""
    where = [
        {
            (row, leg, part, edge): middle
            for row, leg, part, edge, middle, used in zip(
                o.row.tolist(), o.leg.tolist(), o.part, o.edge.tolist(), o.ends, o.used, strict=True
            )
            if used
        }
        for o in (one, other)
    ]
    common = [key for key in where[0] if key in where[1]]
    alike = sum(_gap(where[0][key], where[1][key]) <= SAME_PX for key in common)
    return alike >= SAME_PART * max(1, min(len(w) for w in where))


def _gap(one: Array, other: Array) -> float:
    """Return how far the middle of a line (2, 2) is from another line [px]."""
    along = other[1] - other[0]
    step = one.mean(axis=0) - other[0]
    return float(abs(along[0] * step[1] - along[1] * step[0]) / np.linalg.norm(along))


RADII_GAIN = 1.18  # of the support, by which radii that all differ must explain more
SCALED = (0.8, 1.25)  # radii, in a view that could not be placed
MIRRORED_STARTS = 1, 1  # as START_PICTURES, for mirrored pictures
UNSEEN_ERROR = 6e-3  # of the joint centres of a leg that a view did not show [m]
LEAST_ERROR, ERROR_REACH = 1.5e-3, 2.5  # of those of a leg that it did: [m], standard deviations


def recognise(
    search: Search,
    rows: IntArray,
    hints: Sequence[RigidTransform | None],
    joined: Sequence[RigidTransform | None] | None = None,
    *,
    doubtful: Collection[Part] = (),
    progress: Callable[[int], None] | None = None,
    run: Run = in_turn,
) -> Recognised:
    """Find the cameras of all views and the legs in their images.

    Parameters
    ----------
    search : Search
        The images and the model.
    rows : (n,) array of int
        The images to use.
    hints : sequence of RigidTransform or None, for each view
        Rough camera poses T_base_camera.
    joined : sequence of RigidTransform or None, for each view
        T_x_camera of views that know how they stand to each other, by a calibration board x: they
        are placed together.
    doubtful : collection of (int, float)
        Parts, by leg and radius [m], whose outlines were not found with the radii of the model:
        they may have others.
    progress : callable, optional
        Called with the row of each image when it has been searched.
    run : callable
        How images are searched: in turn, or by several processes.

    Returns
    -------
    Recognised
        Also where views could not be placed.
    """
    groups = group_views(search.measurements, rows, hints, joined)
    near = [r for group in groups if group.hint is not None for r in group.some]
    far = [r for group in groups if group.hint is None for r in group.rows]
    pictures = _pictures(search, sorted([*near, *far]), progress, run)
    found: list[Placed | None] = [
        None
        if group.hint is None
        else place_near(group.pictures(pictures, group.some), group.hint, search.n_legs)
        for group in groups
    ]
    # Views without a rough pose, and those whose images do not agree near it: all images, anywhere.
    doubted = [g for g, near in enumerate(found) if near is None or not near.is_clear]
    missing = [r for g in doubted for r in groups[g].rows if r not in pictures]
    pictures |= _pictures(search, missing, progress, run)
    for g, anywhere in zip(doubted, _anywhere(groups, doubted, pictures, search, run), strict=True):
        hint = groups[g].hint
        if hint is None:
            found[g] = anywhere
            continue
        of_group = groups[g].pictures(pictures, groups[g].rows)
        found[g] = _better(place_near(of_group, hint, search.n_legs), anywhere)
    placed = [one for one in found if one is not None]
    radii = NO_OTHER_RADII
    if doubtful:
        radii = _radii(search, groups, placed, pictures, run).only(doubtful)
    given, step, as_given = search.cylinders, radii, (search, placed, pictures)
    for _ in range(MOST_TURNS):
        if not step.factor:
            break
        search = replace(search, cylinders=radii.corrected(given))
        pictures = {row: search.retargeted(row, one) for row, one in pictures.items()}
        placed = _placed_again(search, groups, placed, pictures, run)
        few = _for_radii(groups, placed, pictures)
        step = radii.of_the_same(other_radii(few, LEFT, alone=not radii.common))
        radii = radii.then(step)
    if radii.common and _mean_support(placed) < RADII_GAIN * _mean_support(as_given[1]):
        (search, placed, pictures), radii = as_given, NO_OTHER_RADII  # the scale is not known well
    looking = partial(_look_recognise, search, groups, placed, pictures)
    placed = list(run(looking, range(len(groups))))
    return _gathered(search, groups, placed, pictures, radii, run)


def _pictures(
    search: Search, rows: Sequence[int], progress: Callable[[int], None] | None, run: Run
) -> dict[int, Picture]:
    found = {}
    for row, picture in zip(rows, run(search.picture, rows), strict=True):
        found[row] = picture
        if progress is not None:
            progress(row)
    return found


def _anywhere(
    groups: Sequence[Group],
    chosen: Sequence[int],
    pictures: dict[int, Picture],
    search: Search,
    run: Run,
) -> list[Placed]:
    """Return the cameras of some groups by all of their images, searched for anywhere."""
    of_group = [groups[g].pictures(pictures, groups[g].rows) for g in chosen]
    return list(run(partial(_place, of_group, search.n_legs, START_PICTURES), range(len(chosen))))


def _place(
    groups: Sequence[Sequence[Picture]], n_legs: int, starts: Sequence[int], group: int
) -> Placed:
    return place_camera(groups[group], n_legs, starts)


def _look_recognise(
    search: Search,
    groups: Sequence[Group],
    placed: Sequence[Placed],
    pictures: dict[int, Picture],
    g: int,
) -> Placed:
    """Return the poses of a group, judged by outlines where bars leave a doubt."""
    of_group = groups[g].pictures(pictures, [r for r in groups[g].rows if r in pictures])
    return look_again(search, groups[g], placed[g], of_group)


def _radii(
    search: Search,
    groups: Sequence[Group],
    placed: Sequence[Placed],
    pictures: dict[int, Picture],
    run: Run,
) -> OtherRadii:
    """Return the radii that the images contradict, as far as the views can be placed."""
    if not any(one.is_convincing for one in placed):
        for factor in SCALED:
            cylinders = [
                [replace(c, radius=factor * c.radius) for c in leg] for leg in search.cylinders
            ]
            scaled = replace(search, cylinders=cylinders)
            others = {row: scaled.retargeted(row, one) for row, one in pictures.items()}
            placed = _anywhere(groups, range(len(groups)), others, scaled, run)
            if any(one.is_clear for one in placed):
                break
    return other_radii(_for_radii(groups, placed, pictures))


def _for_radii(
    groups: Sequence[Group], placed: Sequence[Placed], pictures: dict[int, Picture]
) -> Iterator[tuple[int, list[Picture], Poses]]:
    """Return a few pictures of each group that was placed."""
    for g, (group, one) in enumerate(zip(groups, placed, strict=True)):
        if one.is_convincing:
            yield g, group.pictures(pictures, group.some), one.poses


def _mean_support(placed: Sequence[Placed]) -> float:
    """Return how many legs agree in a picture, over all groups that were placed."""
    return sum(float(one.support[0].mean()) for one in placed if one.is_convincing)


def _placed_again(
    search: Search,
    groups: Sequence[Group],
    placed: Sequence[Placed],
    pictures: dict[int, Picture],
    run: Run,
) -> list[Placed]:
    """Return the cameras by other radii: near where they were, or anywhere if they were not."""
    found = list(placed)
    lost = [g for g, one in enumerate(placed) if not one.is_convincing]
    for g, one in zip(lost, _anywhere(groups, lost, pictures, search, run), strict=True):
        found[g] = one
    for g, one in enumerate(placed):
        if one.is_convincing:
            some = groups[g].pictures(pictures, groups[g].some)
            near = place_near(some, one.pose(), search.n_legs)
            found[g] = near if near.is_convincing else one
    return found


def _better(near: Placed, anywhere: Placed) -> Placed:
    """Return the pose with the greater support, that near a rough pose if they are alike."""
    if len(anywhere.poses) == 0 or not anywhere.is_convincing:
        return near
    if len(near.poses) == 0:
        return anywhere
    mean = [float(found.support[0].mean()) for found in (near, anywhere)]
    return anywhere if mean[1] > 1.1 * mean[0] else near


def _gathered(
    search: Search,
    groups: Sequence[Group],
    poses: Sequence[Placed],
    pictures: dict[int, Picture],
    radii: OtherRadii,
    run: Run,
) -> Recognised:
    """Put the views together, with what is to be said of them."""
    views = search.measurements.views
    n_views, n_legs = len(views), search.n_legs
    found: list[RigidTransform | None] = [None] * n_views
    shift = np.zeros((n_views, n_legs, 2, 3))
    error = np.full((n_views, n_legs), UNSEEN_ERROR)
    unplaced: dict[int, str] = {}
    doubted = [g for g, placed in enumerate(poses) if may_be_mirrored(placed)]
    flipped = [_flipped(groups[g], poses[g], pictures) for g in doubted]
    place = partial(_place, flipped, n_legs, MIRRORED_STARTS)
    mirrors = dict(zip(doubted, run(place, range(len(doubted))), strict=True))
    for g, (group, placed) in enumerate(zip(groups, poses, strict=True)):
        name = named([views[v].name for v in group.views])
        exchanged = g in mirrors and is_mirrored(placed, mirrors[g])
        if exchanged or not placed.is_convincing:
            sentence = placing_problem(name, placed, group.hint is not None, is_mirrored=exchanged)
            unplaced |= dict.fromkeys(group.views, sentence)
            continue
        of_leg = np.where(
            np.isfinite(placed.leg_error),
            LEAST_ERROR + ERROR_REACH * placed.leg_error,
            UNSEEN_ERROR,
        )
        for v in group.views:
            found[v] = placed.pose() * group.T_group_camera[v]
            shift[v], error[v] = placed.poses.shift[0], of_leg
    return Recognised(found, shift, error, unplaced, radii)


def _flipped(group: Group, placed: Placed, pictures: dict[int, Picture]) -> list[Picture]:
    """Return the pictures by which a group was placed, with left and right exchanged."""
    few = placed.hinted and placed.support.shape[1] == len(group.some)
    return mirrored(group.pictures(pictures, group.some if few else group.rows))
