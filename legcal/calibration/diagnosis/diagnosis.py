"""What is wrong with a session that images contradict: common mistakes tried, the best one named.

Every mistake is undone in turn, and the images say how well they agree then (how many of the legs
that they should show are there, with cameras placed anywhere). One is named where far more images
agree; those that images cannot tell from it are named with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.diagnosis.mistakes import Assumed, Mistake, mistakes
from legcal.calibration.documents import DiagnosisBlock
from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.geometry import Array, IntArray
from legcal.perception import (
    Agreement,
    Group,
    Placement,
    Search,
    compare_assumptions,
    group_views,
    pairs_of_images,
)

STAGE = "Trying common mistakes"

_AGREE_ALREADY = 0.9  # of the images: then nothing common is wrong
_MIN_IMAGES = 3  # of a view
_N_GROUPS = 2  # of views, a few of whose images say which mistakes are worth a closer look
_FINALISTS = 5  # that all images judge
_NEAR_BEST = 0.7  # of the support of the best, which few images gave, that all images judge as well
_ALIKE = 0.95  # of the best support: as good
_MIN_SHARE = 0.6  # of the images, that agree then
_MIN_GAIN = 0.1  # in the share of legs that images show, on average
_MIN_SIGMAS = 2.5  # of its signed ranks: chance gains in some images and loses in others


@dataclass(frozen=True)
class Diagnosis:
    """What looks wrong with a session.

    Attributes
    ----------
    kind : str
        What it is in a few words: ``columns exchanged``, ``handedness``, ...
    what : str
        The same as a clause that names columns, views and legs.
    same_as : tuple of str
        Clauses of what images cannot tell from it, the commoner first.
    mended : str
        What it would take.
    images, before, after : int
        How many images judged, how many of them agree as things are, and how many without it.
    score : float
        Share of the legs that images then show where they should.
    remedy : str
        What to do.
    """

    kind: str
    what: str
    same_as: tuple[str, ...]
    mended: str
    images: int
    before: int
    after: int
    score: float
    remedy: str

    @property
    def sentence(self) -> str:
        """The diagnosis for people."""
        others = "".join(f", or {other}" for other in self.same_as)
        is_of_legs = self.kind.startswith("columns") and bool(self.same_as)
        tell = "; look which leg is the first in a picture to tell these apart" * is_of_legs
        what = self.what[0].upper() + self.what[1:]
        return (
            f"{what}{others}: {self.mended} {self.after} of {self.images} images agree, as it is "
            f"{self.before}; {self.remedy}{tell}."
        )

    def document(self) -> DiagnosisBlock:
        """Return the entry of documents."""
        return DiagnosisBlock(
            kind=self.kind,
            what=self.what,
            same_as=list(self.same_as),
            images_before=self.before,
            images_after=self.after,
            score=self.score,
            remedy=self.remedy,
        )


def diagnose(data: OrderedDataset) -> tuple[Diagnosis, ...]:
    """Return what looks wrong with a session, the likeliest first; nothing where nothing does.

    Views of one or two images say nothing: some camera pose fits them whatever is assumed.
    """
    machine, photographs = data.machine, data.photographs
    rows = _rows_with_image(data)
    if not (machine.is_determined and len(machine.motors) and len(rows)):
        return ()
    n_views = len(data.measurements.views)
    every = group_views(data.measurements, rows, [None] * n_views, None)
    groups = [group for group in every if len(group.rows) >= _MIN_IMAGES]
    if not groups:
        return ()
    rows = np.sort(np.concatenate([group.rows for group in groups]))
    nowhere = np.full((data.measurements.n_rows, machine.n_legs, 3), np.nan)
    search = photographs.search(Placement(nowhere, nowhere, (None,) * n_views))
    search = replace(search, edge_pairs=pairs_of_images(search, rows.tolist(), data.pool))

    def judged(
        assumed: Sequence[Assumed], groups: Sequence[Group], *, quick: bool
    ) -> list[Agreement]:
        cases = ((_search(search, one), one.flip, one.focal) for one in assumed)
        return compare_assumptions(cases, groups, data.pool, quick=quick)

    given = Assumed(machine, data.measurements.q)
    (own,) = judged([given], groups, quick=False)
    if own.images > _AGREE_ALREADY * len(rows):
        return ()
    tried = mistakes(data)
    data.progress(STAGE, 0, len(tried))
    few = sorted(groups, key=lambda group: -len(group.rows))[:_N_GROUPS]
    support = np.array([one.support for one in judged([m.true for m in tried], few, quick=True)])
    best_first = np.argsort(-support, kind="stable")[:_FINALISTS]
    finalists = best_first[support[best_first] >= _NEAR_BEST * support[best_first[0]]].tolist()
    others = judged([tried[k].true for k in finalists], groups, quick=False)
    data.progress(STAGE, len(tried), len(tried))
    found = {k: one for k, one in zip(finalists, others, strict=True) if _explains(one, own)}
    if not found:
        return ()
    best = max(one.support for one in found.values())
    alike = sorted(k for k, one in found.items() if one.support >= _ALIKE * best)  # commoner first
    return (_diagnosis([tried[k] for k in alike], found[alike[0]], own),)


def _rows_with_image(data: OrderedDataset) -> IntArray:
    """Return the rows whose photographs are there, without those of views that name no leg."""
    paths = [data.dataset.image_path(row) for row in data.order.rows.tolist()]
    views = [data.measurements.views[v] for v in data.measurements.view.tolist()]
    shown = [
        k
        for k, (path, view) in enumerate(zip(paths, views, strict=True))
        if path is not None and path.exists() and view.legs != ()
    ]
    return np.array(shown, dtype=np.intp)


def _explains(one: Agreement, own: Agreement) -> bool:
    """Say whether images agree so much better that it is no chance."""
    n, gain = len(one.row), one.share - own.share
    return (
        one.images >= max(_MIN_SHARE * n, 2)
        and one.images > own.images
        and float(gain.mean()) >= _MIN_GAIN
        and _signed_ranks(gain) >= _MIN_SIGMAS
    )


def _signed_ranks(gain: Array) -> float:
    """Return the sum of signed ranks of gains (n,) over its standard deviation by chance.

    Few images may tell most: their gains are no sample of a normal distribution (Wilcoxon's test).
    """
    some = gain[gain != 0.0]
    rank = 1.0 + np.argsort(np.argsort(np.abs(some)))
    return float(np.sum(np.sign(some) * rank) / max(np.linalg.norm(rank), 1.0))


def _diagnosis(alike: Sequence[Mistake], after: Agreement, before: Agreement) -> Diagnosis:
    """Return the diagnosis of mistakes that images cannot tell apart."""
    first = alike[0]
    same = dict.fromkeys([*first.same_as, *(one.what for one in alike[1:])])
    return Diagnosis(
        kind=first.kind,
        what=first.what,
        same_as=tuple(same),
        mended=first.mended,
        images=len(after.row),
        before=before.images,
        after=after.images,
        score=after.support / max(after.expected, 1e-9),
        remedy=first.remedy,
    )


def _search(search: Search, assumed: Assumed) -> Search:
    """Return what should be seen if something is true."""
    A, B = assumed.joints()
    return replace(
        search, A_base=A, B_base=B, cylinders=[leg.cylinders for leg in assumed.machine.legs]
    )
