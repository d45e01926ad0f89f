"""Diagnosis of a session that its images contradict: the common mistake that fits best.

Every mistake is undone in turn, and the images say how well they agree then (how many of the legs
that they should show are there, with cameras placed anywhere). A few images of the views that
disagree most say which mistakes are worth a closer look, all images judge these. One is named where
far more images agree; those that images cannot tell from it are named with it. Where none is, the
likeliest are undone and others tried beside them, near the cameras that are known by then.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.board import BoardViews, usable_board
from legcal.calibration.diagnosis import MIN_SHARE, Diagnosis, exchanged_legs
from legcal.calibration.mistakes import (
    TURNS,
    Assumed,
    Mistake,
    as_given,
    both,
    joints_of,
    limited_to,
    mistakes,
    moved_cameras,
    shifted_from,
    turned_images,
)
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.geometry.types import Array, IntArray
from legcal.machine.model import Machine, readings_at, vectors_A_to_B
from legcal.perception.agreement import (
    Agreement,
    Assumption,
    compare_assumptions,
    pairs_of_outlines,
)
from legcal.perception.alignment import is_moved
from legcal.perception.diagnostics import far_off
from legcal.perception.placement import Group, Placement, Search, group_views

_Judged = tuple[Mistake, Agreement]  # with what all images say of it

STAGE = "Trying common mistakes"

_AGREE_ALREADY = 0.9  # of the images: then nothing common is wrong
MIN_IMAGES = 3  # of a group of views
_MIN_PLACE = 5  # images that say where a camera stood: of fewer some pose fits nearly anything
_MOST = 0.8  # of the images
_FEW = 6  # images, at least, that say which mistakes are worth a closer look
_SUITS = 0.5  # of the legs that they should show
_STARTS = 1, 1, 2  # images that suggest cameras, of all
_FEW_STARTS = (1,), (1, 1)  # of the first few, and of the next few if these suit no mistake
_POOL = 3  # cameras of other mistakes that are tried
_NEAR_GROUPS = 3  # of views, by which mistakes are judged near known cameras first
_FINALISTS = 6  # mistakes that all images judge
_AHEAD = 12  # mistakes ahead in one group of views for which cameras of the next are searched for
_FIRSTS = 3  # mistakes beside which others are tried
_CLEARLY = 2.0  # gain of the first of them over the second, where it leads
_SAME_AMOUNT = 2  # of these that differ by how much
_NEAR_BEST = 0.5  # of the gain of the best, which few images gave, that all images judge as well
# kinds that may begin during a session, and how many of these are tried
_OF_SOME, _MOST_OF_SOME = ("columns exchanged", "direction of an encoder", "readings shifted"), 3
_RARE = ("joints exchanged",)  # kinds that are tried where no other makes all images agree
_FINER = (0.5, 0.25)  # steps of an amount between those that are tried
_SYMMETRIC = 0.03  # of the size of the machine, and the sine of angles
_SAME = 0.03  # in the share of legs: no more than the lens makes of mirrored images
_NEARLY = 0.8  # of the support of things as they are, near their cameras: others may suit better
_ALIKE = 0.9  # of the best support: as good, where images do not tell them apart
_MIN_GAIN, _SURE_GAIN = 0.1, 0.05  # in the share of legs that images show, on average
_MIRROR_X, _MIRROR_Y = np.diag([-1.0, 1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0, 1.0])
_MIN_SIGMAS = 2.5  # of its signed ranks: chance gains in some images and loses in others
_PLAIN_GAIN, _FEW_SIGMAS = 0.3, 2.2  # of all of six images
_LEAST_GAIN = 0.03  # where an opposite is worse: errors of the model make up for less
_SURE_SIGMAS = 4.5  # of a gain that may be small: in nearly all of many images


def diagnose(data: OrderedDataset, board: BoardViews | None = None) -> tuple[Diagnosis, ...] | None:
    """Return the likely mistakes of a session, the likeliest first; empty if none is likely.

    None where there is nothing to explain, or too little to judge by. Views of one or two images
    that no board relates to others do not count: some camera pose fits them under any hypothesis;
    nor do views between whose images the camera moved: none fits them.
    """
    machine = data.machine
    rows = _rows_seen(data)
    if not (machine.is_determined and len(machine.motors) and len(rows)):
        return None
    groups = _groups(data, rows, board)
    if not groups:
        return None
    judge = _Judge(data, groups)
    if judge.agree_already:
        return judge.exchanged_legs() or None
    stood = [group for group in groups if not judge.is_in_hand(group)]
    if len(stood) < len(groups):
        if not stood:
            return None
        judge = _Judge(data, stood)
    common = mistakes(data)
    tried = [
        *common,
        *judge.in_some_images(common),
        *judge.in_the_rest(),
        *(judge.turned_images() or judge.moved_cameras()),  # upside down is as a camera that rolled
    ]
    finalists, gain = judge.finalists(tried)
    likeliest = judge.likeliest(judge.judged(finalists))
    renamed = () if likeliest else judge.exchanged_legs()
    most_agree = judge.own.images >= _MOST * len(judge.own.row)
    if not (likeliest or renamed or most_agree):  # two at once leave few images that agree
        likeliest = judge.of_two(tried, gain)
    data.progress(STAGE, 1, 1)
    if not likeliest:
        return renamed or (None if most_agree else ())
    suited = [judge.hints_suited(one) for _, one in likeliest]
    by_hints = len(suited) > 1 and suited[0] > max(suited[1:])
    first = [what for what, _ in likeliest]
    return (_diagnosis(first, likeliest[0][1], judge.own, by_hints=by_hints),)


def agreement_with_zeros(data: OrderedDataset, zeros: Sequence[Mapping[str, float]]) -> list[float]:
    """Return how many legs all images show where motors stand further than they read by *zeros*.

    Of each hypothesis, by motor [m or rad]; all are 0 where there is no image.
    """
    rows = _rows_seen(data)
    groups = _groups(data, rows, usable_board(data), 1) if len(rows) else []
    if not groups:
        return [0.0] * len(zeros)
    judge = _Judge(data, groups)
    assumed = (replace(judge.given, q=data.with_zero_offsets(one).measurements.q) for one in zeros)
    return [_total(judge.all(one)) for one in assumed]


def _rows_seen(data: OrderedDataset) -> IntArray:
    """Return the rows of photographs or given outlines, without those of views that name no leg.

    The edge pairs that outlines make are added to those of images.
    """
    paths = [data.dataset.image_path(row) for row in data.order.rows.tolist()]
    has_image = [path is not None and path.exists() for path in paths]
    given = pairs_of_outlines(data.photographs.keep, data.measurements)
    data.edge_pairs.update({row: own for row, own in given.items() if not has_image[row]})
    shown = [
        row
        for row, view in enumerate(data.measurements.view.tolist())
        if data.measurements.views[view].legs != () and (has_image[row] or row in data.edge_pairs)
    ]
    return np.array(shown, dtype=np.intp)


def _groups(
    data: OrderedDataset, rows: IntArray, board: BoardViews | None, least: int = MIN_IMAGES
) -> list[Group]:
    """Return groups of views with enough images; views of the board on the base form one."""
    hints = [view.T_base_camera for view in data.measurements.views]
    joined = None if board is None else board.T_board_camera
    groups = group_views(data.measurements, rows, hints, joined)
    return [group for group in groups if len(group.rows) >= least]


class _Judge:
    """Judges hypotheses by the images of groups of views."""

    def __init__(self, data: OrderedDataset, groups: Sequence[Group]) -> None:
        self.data, self.groups = data, groups
        self.given = as_given(data)
        rows = np.sort(np.concatenate([group.rows for group in groups])).tolist()
        nowhere = np.full((data.measurements.n_rows, data.machine.n_legs, 3), np.nan)
        placement = Placement(nowhere, nowhere, (None,) * len(data.measurements.views))
        search = data.photographs.search(placement, data.edge_pairs)
        missing = [row for row in rows if row not in data.edge_pairs]
        data.edge_pairs.update(zip(missing, data.pool(search.pairs, missing), strict=True))
        self.search = replace(search, edge_pairs={row: data.edge_pairs[row] for row in rows})
        self.pool: list[list[RigidTransform]] = [self.known(g) for g in range(len(groups))]
        self.of_groups = [
            self.compare([self.given], g, group.rows, _STARTS)[0] for g, group in enumerate(groups)
        ]
        for g, one in enumerate(self.of_groups):
            self.pool[g] += [T for T in one.cameras if T is not None]
        self.own = Agreement.joined(self.of_groups)
        self.symmetries = symmetries(data.machine)

    @property
    def agree_already(self) -> bool:
        """Whether nearly all images with anything like a leg agree as given."""
        n_showing = sum(len(self.search.edge_pairs[row]) > 0 for row in self.own.row.tolist())
        return self.own.images > _AGREE_ALREADY * n_showing

    def is_in_hand(self, group: Group) -> bool:
        """Return whether the camera of a view moved between its photographs."""
        files = self.data.order.rows[group.rows].tolist()
        paths = [self.data.dataset.image_path(row) for row in files]
        shown = [row for row, path in zip(group.rows, paths, strict=True) if path and path.exists()]
        return len(group.views) == 1 and is_moved(self.search.load, shown)

    def exchanged_legs(self) -> tuple[Diagnosis, ...]:
        """Return given outlines with the names of other legs, where all else in images agrees."""
        m, machine = self.data.measurements, self.data.machine
        cameras: dict[int, RigidTransform | None] = {}
        for group, one in zip(self.groups, self.of_groups, strict=True):
            if one.cameras[0] is not None:
                cameras |= group.cameras(one.cameras[0])
        ends = self.given.joints(range(m.n_rows))
        of_views = [cameras.get(v) for v in range(len(m.views))]
        given = self.data.photographs.keep
        return exchanged_legs(given, m, machine.legs, ends, of_views, of_all=self.agree_already)

    def in_some_images(self, tried: Sequence[Mistake]) -> list[Mistake]:
        """Return mistakes in the readings of images that follow each other in the file.

        These gain most with the mistake corrected, near known cameras.
        """
        joined = "rows" if len(self.data.measurements.views) > 1 else None  # each view alone then
        some = [one for one in tried if one.kind in _OF_SOME and one.amount_of != joined]
        gain = np.zeros((len(some), self.data.measurements.n_rows))
        for g, group in enumerate(self.groups):
            now = self.of_groups[g]
            of = [k for k, m in enumerate(some) if not m.true.is_as(self.given, group.rows)]
            # Where all agree, nothing is to be gained.
            gain[np.array(of, dtype=np.intp)[:, None], now.row] = -now.support
            if now.images < len(now.row):
                then = self.compare([some[k].true for k in of], g, group.rows, ())
                for k, one in zip(of, then, strict=True):
                    gain[k, now.row] += one.support
        in_file = np.argsort(self.data.order.rows, kind="stable")
        total = np.pad(np.cumsum(gain[:, in_file], axis=1), ((0, 0), (1, 0)))
        above = total - np.minimum.accumulate(total, axis=1)
        found = list[Mistake]()
        for k in np.argsort(-above.max(axis=1), kind="stable")[:_MOST_OF_SOME].tolist():
            last = int(above[k].argmax())  # + 1
            first = int(np.flatnonzero(above[k, : last + 1] == 0.0)[-1])
            rows, all_changed = in_file[first:last], np.flatnonzero(gain[k])
            if MIN_IMAGES <= len(rows) <= len(all_changed) - MIN_IMAGES:
                found.append(limited_to(self.data, self.given, some[k], rows))
        return found

    def in_the_rest(self) -> list[Mistake]:
        """Return readings shifted from where images cease to agree: a row too many, or missing.

        Through the rest of several views, of which the last may agree nowhere; in the rest of one
        view they are among those of some images.
        """
        in_file = np.argsort(self.data.order.rows, kind="stable")
        agrees = np.isin(in_file, self.own.row[self.own.agrees])
        first = 1 + int(np.argmax(np.cumsum(np.where(agrees, 1, -1))))
        n_views = len(np.unique(self.data.measurements.view[in_file[first:]]))
        if n_views < 2 or len(in_file) - first < MIN_IMAGES or not agrees[:first].any():
            return []
        return shifted_from(self.data, self.given, first)

    def turned_images(self) -> list[Mistake]:
        """Return single images that agree with the camera of their view only if turned over."""
        found = list[Mistake]()
        for g, group in enumerate(self.groups):
            own = self.of_groups[g]
            T_own, left = own.cameras[0], own.row[~own.agrees].tolist()
            if T_own is None or len(left) == len(own.row):  # no image speaks for that camera
                continue
            for v, turn in product(group.views, TURNS):
                rows = [row for row in left if group.view_of_row[row] == v]
                for _ in range(2):  # all that do not agree, then those of them that do
                    if len(rows) >= MIN_IMAGES:
                        true = turned_images(self.data, self.given, rows, turn).true
                        then = self.compare([true], g, rows, (), [T_own])[0]
                        rows = then.row[then.agrees].tolist()
                if len(rows) >= MIN_IMAGES:
                    found.append(turned_images(self.data, self.given, rows, turn))
        return found

    def moved_cameras(self) -> list[Mistake]:
        """Return views whose camera may have moved between images.

        Images that do not agree with the camera of the others agree with another one then, and
        hardly any are left: where readings are wrong, some camera suits a few images as well.
        """
        moved, n_agree = list[list[list[int]]](), 0
        for g, group in enumerate(self.groups):
            own = self.of_groups[g]
            places, left = [own.row[own.agrees].tolist()], own.row[~own.agrees].tolist()
            while len(places[-1]) >= _MIN_PLACE and len(left) >= _MIN_PLACE:
                then = self.compare([self.given], g, left, _STARTS)[0]
                places.append(then.row[then.agrees].tolist())
                left = then.row[~then.agrees].tolist()
            places = [rows for rows in places if len(rows) >= _MIN_PLACE]
            if len(places) > 1 and len(group.views) == 1:  # of a board's views all would move
                moved.append(places)
                n_agree += sum(map(len, places))
            else:
                n_agree += own.images
        if not moved or n_agree < _MOST * len(self.own.row):
            return []
        return [moved_cameras(self.data, self.given, moved)]

    def known(self, g: int) -> list[RigidTransform]:
        """Return the cameras of a group that are known in advance."""
        hint = self.groups[g].hint
        return [] if hint is None else [hint, _mirrored_camera(hint)]

    def finalists(self, tried: Sequence[Mistake]) -> tuple[list[Mistake], Array]:
        """Return the mistakes favoured by some images of the views that disagree most.

        And what each of those that are tried gains.

        These are all images of views that nearly agree, whose cameras are known about, and a few of
        others; more of them in a second round. Cameras are searched for only if no mistake
        suits the images of a few groups near those that are known.
        """
        missing = [float((one.expected - one.support).sum()) for one in self.of_groups]
        left = np.argsort(-np.array(missing), kind="stable").tolist()
        looks = [_Look(self, tried, g) for g in left[:_NEAR_GROUPS]]
        near = Agreement.joined([look.before for look in looks])
        of_looks = np.array([look.near_known() for look in looks])
        best = of_looks[:, int(np.argmax(of_looks.sum(axis=0)))]
        # A mistake may suit one view alone, by chance: others have no right camera then
        suited = [_total(x.before) + own >= _SUITS * float(x.before.expected.sum())
                    for x, own in zip(looks, best, strict=True)]  # fmt: skip
        searches = not (all(suited) and _suits(best.sum() + _total(near), near))
        gain, seen = np.zeros(len(tried)), list[Agreement]()
        judged = np.zeros(len(tried), dtype=np.bool_)
        done, total = 0, len(_FEW_STARTS) * len(tried)
        for starts in _FEW_STARTS:
            n_images = 0
            while left and n_images < _FEW:
                g = left.pop(0)
                look = looks.pop(0) if looks else _Look(self, tried, g)
                seen.append(look.before)
                n_images += 0 if self.nearly_agrees(g) else len(look.asked)
                ahead = np.sort(gain[judged])[-_AHEAD:]
                look.is_open = ~judged | (gain >= ahead[:1].max(initial=-np.inf))
                gain += look.gains(starts, searches=searches)
                judged[look.some] = True
                done += len(tried)
                self.data.progress(STAGE, min(done, total - 1), total)
            own = Agreement.joined(seen)
            if not left or _suits(gain.max() + _total(own), own):
                break
        # Less than this is gained by chance, also by what is wrong with the images of one group.
        least = _SURE_GAIN * min(float(one.expected.sum()) for one in seen)
        found = [k for k, one in enumerate(tried) if one.of_few]  # their own images found them
        amounts = Counter[str]()
        left_for = {True: _FINALISTS, False: _FINALISTS // 2}  # whether of all views, or of some
        for k in np.argsort(-gain, kind="stable").tolist():
            if gain[k] <= max(_NEAR_BEST * gain.max(), least):
                break
            of_all = not any(tried[k].true.is_as(self.given, g.rows) for g in self.groups)
            amount = tried[k].amount_of
            most = 1 if tried[k].finer else _SAME_AMOUNT  # all images find the amount then
            if (not amount or amounts[amount] < most) and left_for[of_all] and k not in found:
                found.append(k)
                left_for[of_all] -= 1
                amounts[amount] += 1
        return [tried[k] for k in sorted(found)], gain  # the commoner first

    def of_two(self, tried: Sequence[Mistake], gain: Array) -> list[_Judged]:
        """Return pairs of mistakes at once that explain half of the images or more, if any do.

        The first of a pair are those that gain most alone, the second one of all images beside
        each. A few images of the group that disagrees most judge near the cameras known by then;
        beside a first one that leads clearly, cameras are searched for where these suit none.
        """
        missing = [float((one.expected - one.support).sum()) for one in self.of_groups]
        g = int(np.argmax(missing))
        rows, before = self.groups[g].some, self.of_groups[g].at(self.groups[g].some)
        order = np.argsort(-gain, kind="stable")[: _FIRSTS + 1].tolist()
        found = dict[frozenset[str], tuple[float, Mistake]]()
        for k in order[:_FIRSTS]:
            beside = [one for one in mistakes(self.data, tried[k].true) if one.kind not in _RARE]
            true = [one.true for one in beside]
            support = [_total(one) for one in self.compare(true, g, rows, ())]
            leads = k == order[0] and gain[k] > _CLEARLY * max(gain[order[1:]], default=0.0)
            if leads and not _suits(max(support), before):
                support = [_total(one) for one in self.compare(true, g, rows, _FEW_STARTS[0])]
            for one, shown in zip(beside, support, strict=True):  # in either order once
                key = frozenset((tried[k].what, one.what))
                found.setdefault(key, (shown, both(tried[k], one)))
        best = sorted(found.values(), key=lambda one: -one[0])[:_FINALISTS]
        alike = [pair for shown, pair in best if shown >= _ALIKE * best[0][0]]
        judged = [(pair, self.all(pair.true)) for pair in alike]
        return self.likeliest([(pair, one) for pair, one in judged
                               if one.images >= MIN_SHARE * len(one.row)])  # fmt: skip

    def nearly_agrees(self, g: int) -> bool:
        """Return whether the images of a group show half of the legs or more as given."""
        return self.of_groups[g].mean >= _SUITS

    def judged(self, finalists: Sequence[Mistake]) -> list[_Judged]:
        """Return the agreement of all images with some mistakes, by their best amounts."""
        found = [(what, self.all(what.true)) for what in finalists]
        if not found:
            return []
        first = max((one for _, one in found), key=_total)
        alike = [[] if T is None else self.alike(T) for T in first.cameras]
        for k, (what, one) in enumerate(found):
            if not _is_as_good(one, first):
                one = _better(one, self.all(what.true, (), alike))
            found[k] = self._best_amount(what, one)
        return found

    def likeliest(self, judged: Sequence[_Judged]) -> list[_Judged]:
        """Return the mistakes that explain the images best, and that they cannot distinguish."""
        found = [(what, one) for what, one in judged if self.is_explained(what, one)]
        best = max((one for _, one in found), key=_total, default=self.own)
        alike = [(what, one) for what, one in found if _is_as_good(one, best)]
        most = dict[str, float]()  # of those that differ by how much
        for what, one in alike:
            most[what.amount_of] = max(_total(one), most.get(what.amount_of, 0.0))
        alike = [(what, one) for what, one in alike
                 if not what.amount_of or _total(one) == most[what.amount_of]]  # fmt: skip
        return sorted(alike, key=lambda one: -self.hints_suited(one[1]))  # then the commoner

    def _best_amount(self, what: Mistake, one: Agreement) -> tuple[Mistake, Agreement]:
        """Return the amount of a mistake that fits all images best, by halving steps."""
        known = [[] if T is None else [T] for T in one.cameras]
        for step in _FINER if what.finer is not None else ():
            assert what.finer is not None
            for other in (what.finer(step), what.finer(-step)):
                again = self.all(other.true, (), known)
                if again.support.sum() > one.support.sum():
                    what, one = other, again
                    break
        return what, one

    def is_explained(self, what: Mistake, one: Agreement) -> bool:
        """Return whether images agree significantly better with a mistake corrected.

        Cameras at another place may nearly make up for one that has an opposite. Images agree
        little better without it then, but worse with the opposite.
        """
        if what.of_few:  # too few for signed ranks, and chosen by what they gain
            some, before = one.at(what.of_few), self.own.at(what.of_few)
            is_plain = float((some.share - before.share).mean()) >= _PLAIN_GAIN
            are_enough = some.images >= before.images + MIN_IMAGES
            return is_plain and are_enough and one.images > self.own.images
        if _explains(one, self.own):
            return _explains(one, self._as_it_is_near(what, one))
        gain = one.share - self.own.share
        is_more = one.images > self.own.images and float(gain.mean()) >= _LEAST_GAIN
        if what.opposite is None or not is_more or _signed_ranks(gain) < _MIN_SIGMAS:
            return False
        known = [[] if T is None else [T] for T in self.own.cameras]
        contrast = one.share - self.all(what.opposite, (), known).share
        is_sure = _signed_ranks(contrast) >= _SURE_SIGMAS
        return is_sure and float(contrast.mean()) >= _SURE_GAIN

    def _as_it_is_near(self, what: Mistake, one: Agreement) -> Agreement:
        """Return the agreement without correction, also near the cameras of a mistake.

        The search for cameras may have missed these, and then a mistake is none.
        """
        found = list(self.of_groups)
        for g, (group, T) in enumerate(zip(self.groups, one.cameras, strict=True)):
            if T is not None and not what.true.is_as(self.given, group.rows):
                near = self.compare([self.given], g, group.rows, (), self.alike(T))[0]
                found[g] = _better(found[g], near)
        return Agreement.joined(found)

    def all(
        self,
        assumed: Assumed,
        starts: Sequence[int] = _STARTS,
        known: Sequence[Sequence[RigidTransform]] = (),
    ) -> Agreement:
        """Return the agreement of all images with a hypothesis."""
        return Agreement.joined(
            [
                self.of_groups[g]
                if assumed.is_as(self.given, group.rows)
                else self.compare([assumed], g, group.rows, starts, known[g] if known else ())[0]
                for g, group in enumerate(self.groups)
            ]
        )

    def alike(self, T_base_camera: RigidTransform) -> list[RigidTransform]:
        """Return the camera poses for which the suspected mistakes give the same images."""
        found = []
        for S in self.symmetries:
            T = S @ T_base_camera.as_matrix()
            if np.linalg.det(S[:3, :3]) < 0.0:
                found.append(RigidTransform.from_matrix(T @ _MIRROR_X))
            else:
                found += [
                    RigidTransform.from_matrix(T),
                    _mirrored_camera(RigidTransform.from_matrix(T)),
                ]
        return found

    def _as_far(self, known: Sequence[RigidTransform], focal: float) -> list[RigidTransform]:
        """Return cameras, and those of another focal length at which the machine looks as large."""
        if focal == 1.0:
            return list(known)
        machine = self.data.machine
        middle = machine.A_base.mean(axis=0)
        back = [(focal - 1.0) * float(T.inv().apply(middle)[2]) for T in known]
        moves = [RigidTransform.from_translation([0.0, 0.0, -z]) for z in back]
        return [*known, *(T * move for T, move in zip(known, moves, strict=True))]

    def hints_suited(self, one: Agreement) -> int:
        """Return the number of rough camera poses that agree with the cameras found."""
        both = zip(self.groups, one.cameras, strict=True)
        return sum(
            group.hint is not None and T is not None and not far_off(group.hint, T)
            for group, T in both
        )

    def compare(
        self,
        assumed: Sequence[Assumed],
        g: int,
        rows: Sequence[int],
        starts: Sequence[int],
        known: Sequence[RigidTransform] = (),
    ) -> list[Agreement]:
        """Return the agreement of some images of a group with hypotheses, near known cameras.

        These are the pool's where none are given.
        """
        parts = [
            (one, [row for row in rows if one.place[row] == place])
            for one in assumed
            for place in np.unique(one.place[rows]).tolist()
        ]
        assumptions = [
            Assumption(
                _search(self.search, one.machine, *joints),
                one.flip,
                one.focal,
                self.groups[g],
                some,
                starts,
                self._as_far(known or self.pool[g], one.focal),
            )
            for (one, some), joints in zip(parts, joints_of(parts), strict=True)
        ]
        found = compare_assumptions(assumptions, self.data.pool)
        of_each = [
            [own for (part, _), own in zip(parts, found, strict=True) if part is one]
            for one in assumed
        ]
        return [Agreement.of_places(own, rows) for own in of_each]


class _Look:
    """Gains: how many more legs some images of a group show with each mistake corrected.

    Cameras are tried where they are known roughly, and about where those of images that nearly
    agree are. They are searched for where that suits none, or suits as well as things as they are:
    a symmetric machine nearly agrees with its mirror image.
    """

    def __init__(self, judge: _Judge, tried: Sequence[Mistake], g: int) -> None:
        self.judge, self.tried, self.g = judge, tried, g
        group, own = judge.groups[g], judge.of_groups[g]
        self.asked = group.rows if judge.nearly_agrees(g) else group.some
        self.before = own.at(self.asked)
        is_as = [one.true.is_as(judge.given, group.rows) for one in tried]
        self.some = np.flatnonzero(~np.array(is_as, dtype=np.bool_)).tolist()
        self.is_open = np.ones(len(tried), dtype=np.bool_)  # cameras are searched for of these
        self.support = np.zeros(len(tried))
        self.cameras: dict[int, RigidTransform | None] = {}
        self.T_near = own.cameras[0] if judge.nearly_agrees(g) else None
        self.is_near = False

    def near_known(self) -> Array:
        """Return the gains near known cameras, (n_tried,)."""
        if not self.is_near:
            known = [] if self.T_near is None else self.judge.alike(self.T_near)
            known += self.judge.known(self.g) if known else []
            rare = [k for k in self.some if self.tried[k].kind in _RARE]
            self._at([k for k in self.some if k not in rare], (), known)
            if self.support.max(initial=0.0) < _AGREE_ALREADY * self.before.expected.sum():
                self._at(rare, (), known)
            self.is_near = True
        return self._gained()

    def gains(self, starts: Sequence[int], *, searches: bool) -> Array:
        """Return the gains (n_tried,), with cameras suggested by *starts* if one *searches*."""
        self.near_known()
        tried, before = self.tried, _total(self.before)
        if self.T_near is not None:
            nearly = [k for k in self.some if self.support[k] >= _NEARLY * before]
            self._at([k for k in nearly if not tried[k].is_small], starts)
        elif searches and not _suits(self.support.max(), self.before):
            far = [k for k in self.some if self.is_open[k] and not tried[k].is_small]
            self._at(far, starts)
            self._at([k for k in self.some if k not in far], ())
        best = int(np.argmax(self.support))
        is_better = self.support[best] >= before + _MIN_GAIN * self.before.expected.sum()
        if is_better and (T_best := self.cameras.get(best)) is not None:
            worse = [k for k in self.some if self.support[k] < _ALIKE * self.support[best]]
            self._at([k for k in worse if not tried[k].is_small], (), self.judge.alike(T_best))
        return self._gained()

    def _gained(self) -> Array:
        gained = np.zeros(len(self.tried))
        gained[self.some] = self.support[self.some] - _total(self.before)
        return gained

    def _at(
        self, which: Sequence[int], starts: Sequence[int], known: Sequence[RigidTransform] = ()
    ) -> None:
        """Judge some mistakes, and keep the cameras that agree with most images in the pool."""
        judge, support = self.judge, self.support
        which_true = [self.tried[k].true for k in which]
        agreements = judge.compare(which_true, self.g, self.asked, starts, known)
        for k, one in zip(which, agreements, strict=True):
            if (now := _total(one)) > support[k]:
                support[k], self.cameras[k] = now, one.cameras[0]
        best = np.argsort(-support, kind="stable")[:_POOL].tolist()
        found = [self.cameras.get(k) for k in best if k in which]
        judge.pool[self.g] += [T for T in found if T is not None]


def symmetries(machine: Machine) -> list[Array]:
    """Return motions (4, 4) of the base link that map legs to legs, and reflections.

    Legs are compared near home where all motors are as far in their travel: home itself is often
    tilted or beside the middle. Two legs of a machine may come to lie on any two others: four
    points on four define a motion.
    """
    q = readings_at(machine, machine.home)
    travel = np.array([leg.travel if leg.is_motor else (0.0, 0.0) for leg in machine.legs])
    motors = [j for j in machine.motors if np.isfinite(travel[j]).all() and np.ptp(travel[j]) > 0.0]
    part = np.mean([(q[j] - travel[j, 0]) / np.ptp(travel[j]) for j in motors] or 0.0)
    q[motors] = travel[motors, 0] + part * np.ptp(travel[motors], axis=1)
    alike = Assumed(machine, q[None], np.ones((1, 2)), np.zeros(1, dtype=np.intp))
    A, B = (ends[0] for ends in alike.joints([0]))
    if np.isnan(B).any():
        B = machine.home.apply(machine.B_platform)
        A = B - vectors_A_to_B(machine, machine.home)
    legs = np.stack([A, B], axis=1)  # (n_legs, 2, 3)
    size = float(np.std(legs.reshape(-1, 3), axis=0).max())
    found = list[Array]()
    for j, k in permutations(range(len(legs)), 2):
        x, y = legs[[0, 1]].reshape(-1, 3), legs[[j, k]].reshape(-1, 3)
        x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
        U, _, Vt = np.linalg.svd((y - y_mean).T @ (x - x_mean))
        for sign in (1.0, -1.0):
            R = U @ np.diag([1.0, 1.0, sign]) @ Vt
            moved = (legs - x_mean) @ R.T + y_mean
            apart = np.linalg.norm(moved[:, None] - legs[None], axis=-1).max(axis=-1)
            S = RigidTransform.identity().as_matrix()
            S[:3, :3], S[:3, 3] = R, y_mean - R @ x_mean
            is_new = all(np.abs(S - other).max() > _SYMMETRIC for other in found)
            if np.all(apart.min(axis=1) < _SYMMETRIC * size) and is_new:
                found.append(S)
    return found


def _total(one: Agreement) -> float:
    return float(one.support.sum())


def _better(one: Agreement, other: Agreement) -> Agreement:
    return one if _total(one) >= _total(other) else other


def _suits(support: float, own: Agreement) -> bool:
    """Return whether images agree well with a mistake corrected, and far fewer without."""
    expected = float(own.expected.sum())
    gain = support - float(own.support.sum())
    return support >= _SUITS * expected and gain >= _MIN_GAIN * expected


def _explains(one: Agreement, own: Agreement) -> bool:
    """Return whether images agree significantly better."""
    gain = one.share - own.share
    if one.images < 2 or one.images <= own.images:
        return False
    changed = gain != 0.0
    size, sigmas = float(gain[changed].mean()), _signed_ranks(gain)
    if np.mean(one.agrees[changed]) < MIN_SHARE:  # images show little, whatever is true
        # The images of one view are too few for what is sure: they gain plainly, nearly all.
        least = _MIN_SIGMAS if size >= _PLAIN_GAIN else _SURE_SIGMAS
        return size >= _MIN_GAIN and sigmas >= least
    is_sure = size >= _SURE_GAIN and sigmas >= _SURE_SIGMAS
    is_plain = size >= _PLAIN_GAIN and sigmas >= _FEW_SIGMAS
    return is_plain or is_sure or (size >= _MIN_GAIN and sigmas >= _MIN_SIGMAS)


def _is_as_good(one: Agreement, best: Agreement) -> bool:
    """Return whether images cannot distinguish a hypothesis from the best one."""
    if float(one.support.sum()) < _ALIKE * float(best.support.sum()):
        return False
    lack = best.share - one.share
    return float(lack.mean()) < _SAME or _signed_ranks(lack) < _MIN_SIGMAS


def _signed_ranks(gain: Array) -> float:
    """Return the sum of signed ranks of gains (n,) over its standard deviation by chance.

    Few images may tell most: their gains are no sample of a normal distribution (Wilcoxon's test).
    """
    some = gain[gain != 0.0]
    rank = 1.0 + np.argsort(np.argsort(np.abs(some)))
    return float(np.sum(np.sign(some) * rank) / max(np.linalg.norm(rank), 1.0))


def _diagnosis(
    alike: Sequence[Mistake], after: Agreement, before: Agreement, *, by_hints: bool
) -> Diagnosis:
    """Return the diagnosis of mistakes that images cannot distinguish."""
    first = alike[0]
    kinds = {one.kind: one for one in reversed(alike) if one.kind != first.kind}  # their first
    of_kinds = [*first.same_as, *(one.what for one in alike if kinds.get(one.kind) is one)]
    same = dict.fromkeys([*of_kinds, *(one.what for one in alike[1:])])
    tests = dict.fromkeys(one.test for one in alike if one.test) if same else {}
    rough = "; the rough camera poses (T_base_camera) favour the first explanation" * by_hints
    return Diagnosis(
        kind=first.kind,
        what=first.what,
        same_as=tuple(same),
        mended=first.mended,
        images=len(after.row),
        images_before=before.images,
        images_after=after.images,
        score=after.mean,
        remedy=first.remedy + rough,
        tests=tuple(tests)[:2],
        n_kinds=len(of_kinds),
    )


def _mirrored_camera(T_base_camera: RigidTransform) -> RigidTransform:
    """Return the pose at which a camera sees mirrored images of a machine with y reversed."""
    return RigidTransform.from_matrix(_MIRROR_Y @ T_base_camera.as_matrix() @ _MIRROR_X)


def _search(search: Search, machine: Machine, A: Array, B: Array) -> Search:
    """Return the search for a machine with joints A, B."""
    cylinders = [leg.cylinders for leg in machine.legs]
    return replace(search, A_base=A, B_base=B, cylinders=cylinders)
