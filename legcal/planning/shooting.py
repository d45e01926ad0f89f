"""Guided shooting: which photograph comes next, whether it can be used, and what is known so far.

A session folder is a dataset that grows by one photograph at a time: ``planned.csv`` has the poses
of the plan, ``measurements.csv`` those that were photographed. Its files are complete after each
step, so that a session goes on where it was left. Poses come in the order of the plan; where it
ends, or without one, the pose comes next that determines the platform best with what the
photographs so far show (the information of the joint fit, as in a plan).
"""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.detection import detected
from legcal.calibration.doctor import CLIPPED, FEW_LEGS, SOFT
from legcal.calibration.joint_fit.platform import PlatformError
from legcal.calibration.joint_fit.predicted import (
    DEFAULT_NOISE,
    Contributions,
    Predictor,
    fitted_covariance,
)
from legcal.calibration.ordered_dataset import order_dataset
from legcal.data.dataset import POSES_NAME, Dataset, inspect_files, load_dataset
from legcal.data.image_choice import dataset_at
from legcal.data.image_tables import measurements_at
from legcal.data.measurements import Measurements, measurement_table, measurements_in
from legcal.data.outlines import Outlines, along_legs
from legcal.data.photograph_notes import notes_on_photographs
from legcal.data.reasons import Reason, Rejection
from legcal.errors import (
    Cause,
    DatasetError,
    DidNotConverge,
    LegcalError,
    OutOfResources,
    UsageError,
)
from legcal.files.folder import takes_no_files, write_atomically
from legcal.files.table import format_table
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import Configurations, poses_at
from legcal.machine.kinematics import follow_each, platforms_in_base
from legcal.perception.diagnostics import is_out_of_sight
from legcal.perception.image_quality import Exposure, image_defects, measure_exposure
from legcal.perception.photographs import measure_photographs, nominal_placement
from legcal.planning.exchange import Session, Workspace, criterion_of, workspace_of
from legcal.planning.places import default_setting
from legcal.planning.planner import Task
from legcal.planning.poses import candidate_poses, ways
from legcal.planning.request import measured_length
from legcal.progress import no_progress
from legcal.vision.image_file import ImageFacts, inspect_image, read_image
from legcal.workers import in_turn

PLANNED_NAME = "planned.csv"  # the rows of the plan, once the first photograph is there
SURELY = 0.6  # share of the legs in sight that are found where photographs place their camera
N_PLACING = 3  # photographs of a view by which its camera is placed
N_CANDIDATES = 60  # poses from which the next one is chosen where there is no plan


@dataclass(frozen=True, eq=False)
class Asked:
    """The photograph that comes next."""

    view: str
    pose: str  # its label
    q: Array  # (n_legs,) readings to command [m or rad]; NaN of passive legs
    via: str  # label of the pose to pass first, ``home``, or ""
    is_planned: bool
    image: str  # path in the session, without its ending
    cells: dict[str, str] = field(default_factory=dict)  # of its row in the table of the plan


@dataclass(frozen=True, eq=False)
class Checked:
    """What the check of a photograph found."""

    problems: tuple[str, ...]  # why it is not taken; empty if it is good
    notes: tuple[str, ...]
    exposure: Exposure | None  # None for a file that cannot be read
    facts: ImageFacts
    legs: BoolArray | None  # (n_legs,) legs found; None before the camera of the view is placed
    n_visible: int  # number of legs that should be in sight


class GuidedSession:
    """A session that is being photographed: the folder of ``legcal plan``, or a dataset to extend.

    It is complete at the *target* of the predicted error of the platform [m], without one with its
    plan.
    """

    def __init__(self, folder: str | Path, *, target: float | None = None) -> None:
        self.dataset = load_dataset(folder, check_images=False)
        self.folder, self.target = self.dataset.folder, target
        if refusal := takes_no_files(self.folder):
            raise UsageError(
                f"{self.folder}: the session takes no photograph: found {refusal}; free some space "
                "there, or go on in a copy of the session that can be written."
            )
        self.machine = self.dataset.machine
        self.cameras: dict[str, RigidTransform] = {}  # T_base_camera of placed views
        self.found: dict[str, BoolArray] = {}  # legs found in images, by their names
        self.exposures: dict[str, Exposure] = {}
        self.facts: dict[str, ImageFacts] = {}
        self.notes: list[str] = []  # on photographs that are there
        self.skipped: set[tuple[str, str]] = set()  # views and poses of the plan to leave out
        self._accepted: list[str] = []  # images of this run
        self._read_tables()
        if not self._left and target is None:
            raise UsageError(
                f"{self.folder}: no photograph is left to take: found all of the plan, needed a "
                "predicted error to go on to; give --target 0.05mm, or calibrate the session."
            )
        self._look_at_taken()
        if target is not None and self._work is None:
            raise UsageError(
                "--target could not be used: readings or a camera in the hand do not let the error "
                "of the platform be predicted; leave it out."
            )

    # The tables

    def _read_tables(self) -> None:
        """Read which photographs are taken, and which are planned."""
        self.dataset = load_dataset(self.folder, check_images=False)
        m, table = self.dataset.measurements, self.dataset.table_path
        path = self.folder / PLANNED_NAME
        header, rows = _cells(table)
        paths = [self.dataset.image_path(row) for row in range(m.n_rows)]
        self.taken = [row for row, image in enumerate(paths) if image is None or image.is_file()]
        self._header, self._cells = header, [rows[row] for row in self.taken]
        self._planned, planned = rows, m
        if path.is_file():
            self._planned = _cells(path)[1]
            units = self.dataset.units
            whole, _ = measurement_table(path, units)
            legs = self.machine.legs
            planned, _ = measurements_in(whole, self.folder, m.views, legs, m.sigma_q, units)
        done = {_label(cells) for cells in self._cells}
        self._left = [
            (cells, planned.q[k])
            for k, cells in enumerate(self._planned)
            if cells["image"] and _label(cells) not in done
        ]
        self._vias = {}
        if (self.folder / POSES_NAME).is_file():
            _, poses = _cells(self.folder / POSES_NAME)
            self._vias = {row.get("image", ""): row.get("on the way", "") for row in poses}
        self.__dict__.pop("error", None)

    def _write_tables(self, rows: Sequence[dict[str, str]]) -> None:
        """Write the rows that are taken; the plan is kept beside them."""
        if not (self.folder / PLANNED_NAME).exists() and self._left:
            text = format_table(self._header, ([*row.values()] for row in self._planned))
            write_atomically(self.folder / PLANNED_NAME, text.encode())
        rows = rows or self._planned  # a table has a row at least
        text = format_table(self._header, ([row.get(n, "") for n in self._header] for row in rows))
        write_atomically(self.dataset.table_path, text.encode())
        self._read_tables()

    # What comes next

    def next(self) -> Asked | None:
        """Return the photograph that comes next; None if the session is complete."""
        if self.is_complete:
            return None
        if left := self._to_take:
            cells, q = left[0]
            image = cells["image"]
            pose, via = _label(cells)[1], self._vias.get(image, "")
            stem = str(PurePosixPath(image).with_suffix(""))
            return Asked(cells["view"], pose, q, via, True, stem, cells)
        return self._best()

    @property
    def is_complete(self) -> bool:
        """Whether the target is reached, or without one the plan is done."""
        if self.target is None:
            return not self._to_take
        error = self.error
        return error is not None and error.mean_displacement <= self.target

    @property
    def _to_take(self) -> list[tuple[dict[str, str], Array]]:
        return [(cells, q) for cells, q in self._left if _label(cells) not in self.skipped]

    @property
    def n_planned(self) -> int:
        """Number of photographs of the session with all that is planned."""
        return len(self.taken) + len(self._to_take)

    def _best(self) -> Asked | None:
        """Return the pose that determines the platform best, from where the camera stands."""
        if self._work is None or not self.taken:
            return None
        m = self.dataset.measurements
        view = m.views[int(m.view[self.taken[-1]])].name
        pool = self._pool
        known = self._known_with(view, pool)
        if known is None:
            return None
        session, slot, first = known
        criterion = criterion_of(self._work, self._task.predictor.legs, session.slots[0].basis)
        images = np.arange(first, first + len(pool.poses))
        k = int(np.argmin(criterion(session.with_one_more(slot, images))))
        q = np.where(np.isnan(m.q[0]), np.nan, pool.readings[k])
        used = {_label(cells)[1] for cells in (*self._cells, *self._planned)}
        labels = (f"n{n:02d}" for n in range(1, 10**6))
        label = next(name for name in labels if not {name, f"{view}_{name}"} & used)
        before = self._configurations(self.taken[-1:])
        via, _ = ways(self.machine, np.concatenate([before, pool.configurations[[k]]]))
        cells = {"view": view, "pose": label}
        if "pose" not in self._header:
            cells.pop("pose")
        image = f"images/{view}_{label}"
        return Asked(view, label, q, "home" if via[1] else "", False, image, cells)

    # The check of a photograph

    def check(self, asked: Asked, photograph: Path) -> Checked:
        """Check a photograph of the pose that was asked; nothing is written."""
        m = self.dataset.measurements
        held = f"{asked.view}-1"  # images of a camera in the hand are views: hand-1, hand-2
        v = m.view_names.index(asked.view if asked.view in m.view_names else held)
        camera = m.views[v].camera
        facts, problem = inspect_image(photograph, camera)
        if problem is not None:
            return Checked((str(problem),), (), None, facts, None, 0)
        exposure = measure_exposure(read_image(photograph, camera))
        problems = [*self._other_camera(v, facts), *self._defects(v, exposure)]
        if _digest(photograph) in self._digests.values():
            problems.append("It is a photograph that was taken already; take a new one.")
        notes = []
        if exposure.clipped > CLIPPED:
            notes.append(
                f"{100.0 * exposure.clipped:.0f} % of its pixels are as bright as a file can say: "
                "expose less if these are legs or what is behind them."
            )
        legs, n_visible = None, 0
        if not problems and m.views[v].name in self.cameras:
            one = measurements_at(m, np.zeros(1, dtype=np.intp))
            absolute = str(photograph.absolute())
            one = replace(one, image=(absolute,), view=np.array([v]), q=asked.q[None])
            new = replace(self.dataset, measurements=one)
            legs, n_visible = self._legs_in(new)
            before, T = self._photographs_of(v), self.cameras[m.views[v].name]
            # One pose hardly tells the place of the camera from errors of the model.
            if legs.sum() < FEW_LEGS * n_visible and 0 < len(before) < N_PLACING:
                both = dataset_at(self.dataset, np.array(before))
                if self._is_placed(v, replace(both, measurements=_joined(both.measurements, one))):
                    legs, n_visible = self._legs_in(new)
            if legs.sum() < FEW_LEGS * n_visible:
                self.cameras[m.views[v].name] = T
                problems.append(
                    f"It shows {legs.sum()} of {n_visible} legs where pose {asked.pose} has them: "
                    "is the machine at another pose, or has the camera moved? Set the pose and "
                    "photograph it again."
                )
        return Checked(tuple(problems), tuple(notes), exposure, facts, legs, n_visible)

    def _other_camera(self, view: int, facts: ImageFacts) -> list[str]:
        """Return what says that a photograph is of another camera, lens or zoom."""
        m, new = self.dataset.measurements, "the new photograph"
        more = replace(m, image=(*m.image, new), view=np.append(m.view, view))
        paths = self.dataset.camera_paths
        before = {note.what for note in notes_on_photographs(m, paths, self.facts)}
        after = notes_on_photographs(more, paths, {**self.facts, new: facts})
        return [note.what for note in after if note.what not in before]

    def _defects(self, view: int, exposure: Exposure) -> list[str]:
        """Return why nothing sharp can be seen in a photograph, alone or beside the others."""
        m = self.dataset.measurements
        of_row = {
            row: self.exposures[m.image[row]]
            for row in self.taken
            if m.image[row] in self.exposures
        } | {-1: exposure}
        views = {row: view if row < 0 else int(m.view[row]) for row in of_row}
        lens = {row: str(self.dataset.camera_paths[v]) for row, v in views.items()}
        why = image_defects(of_row, views, lens).get(-1, Rejection())
        if not why and exposure.blur > SOFT:
            detail = Cause("{:.1f} px, needed {:g} px or less", (exposure.blur, SOFT))
            return [f"It is blurred by {detail}; focus on the legs, hold still, and take it again."]
        if why.reason is Reason.NONE:
            return []
        return [f"It cannot be used: {why.cause}; take it again."]

    def _legs_in(self, dataset: Dataset) -> tuple[BoolArray, int]:
        """Return the legs found near their predicted places in one image, and how many should."""
        data = order_dataset(dataset, in_turn, no_progress)
        near = nominal_placement(data.machine, data.measurements, data.T_base_platform)
        cameras = tuple(self.cameras.get(view.name) for view in data.measurements.views)
        near = replace(near, T_base_camera=cameras)
        outlines = measure_photographs(data.photographs, near, no_progress)
        found, visible = self._counted(data.order.restore(outlines), 1)
        return found[0], int(visible[0].sum())

    def _counted(self, outlines: Outlines, n: int) -> tuple[BoolArray, BoolArray]:
        """Return masks (n_images, n_legs) of the legs found, and of those in sight."""
        rods = along_legs(outlines, self.machine.legs)
        found = np.zeros((n, self.machine.n_legs), dtype=np.bool_)
        visible = found.copy()
        found[rods.row[rods.used], rods.leg[rods.used]] = True
        in_sight = rods.used | ~is_out_of_sight(rods)
        visible[rods.row[in_sight], rods.leg[in_sight]] = True
        return found, visible

    # What happens to it

    def accept(
        self,
        asked: Asked,
        photograph: Path | None,
        checked: Checked | None = None,
    ) -> None:
        """Put a photograph into the dataset, complete or not at all.

        Without a photograph, its outlines are given otherwise.
        """
        if photograph is None and "pose" not in self._header:
            raise UsageError(
                "The row could not be written: found neither a photograph nor a column pose, "
                "needed one to tell rows apart; add the column."
            )
        image, cells = "", {**asked.cells, "view": asked.view}
        if not asked.is_planned:
            cells |= self._readings(asked.q)
        if photograph is not None:
            image = asked.image + photograph.suffix.lower()
        cells["image"] = image
        with self._room("the photograph could not be taken into the dataset", "keep it"):
            if photograph is not None:
                (self.folder / image).parent.mkdir(parents=True, exist_ok=True)
                write_atomically(self.folder / image, photograph.read_bytes())
            self._write_tables([*self._cells, cells])
        if checked is not None and checked.exposure is not None:
            self.exposures[image], self.facts[image] = checked.exposure, checked.facts
            if checked.legs is not None:
                self.found[image] = checked.legs
        self._accepted.append(image)
        if photograph is not None:
            self._digests[image] = _digest(photograph)
            self._place(asked.view)

    def undo(self) -> str:
        """Take the last photograph of this run out of the dataset; return its name, or ""."""
        if not self._accepted:
            return ""
        image = self._accepted[-1]
        with self._room(f"{image or 'the last row'} could not be taken out", "undo it"):
            self._write_tables(self._cells[:-1])
            self._accepted.pop()
            if self._digests.pop(image, None):
                (self.folder / image).unlink(missing_ok=True)
                self._read_tables()
        return image or "The last row"

    @contextmanager
    def _room(self, what: str, then: str) -> Iterator[None]:
        """Say in words that the dataset takes no files."""
        try:
            yield
        except OSError as error:
            raise OutOfResources(
                what,
                f"'{error.strerror or error}'",
                "a folder that takes its files",
                f"free some space there, and {then} then",
                self.folder,
            ) from error

    def _readings(self, q: Array) -> dict[str, str]:
        """Return the cells of readings, in the units of the table."""
        legs = self.machine.legs
        names = {str(legs[j].prismatic): float(q[j]) for j in self.machine.motors}
        return {
            name: repr(self.dataset.units[name].reading(value)) for name, value in names.items()
        }

    def _look_at_taken(self) -> None:
        m = self.dataset.measurements
        rows = [row for row in self.taken if m.image[row]]
        self._digests = {m.image[row]: _digest(self.folder / m.image[row]) for row in rows}
        if not rows:
            return
        some = dataset_at(self.dataset, np.array(rows))
        some, unusable = inspect_files(some)
        if unusable:
            raise DatasetError([problem for _, problem in unusable])
        self.facts = dict(some.facts)
        load = self.dataset.image_reader(range(m.n_rows))
        self.exposures = {m.image[row]: measure_exposure(load(row)) for row in rows}
        for view in dict.fromkeys(m.views[int(m.view[row])].name for row in rows):
            self._place(view)

    def _place(self, view: str) -> None:
        """Place the camera of a view by its photographs, and look for the legs in them."""
        m = self.dataset.measurements
        if not self.machine.is_determined or view not in [one.name for one in m.views]:
            return
        v = [one.name for one in m.views].index(view)
        rows = self._photographs_of(v)
        if not rows or (view in self.cameras and m.image[rows[-1]] in self.found):
            return
        if view not in self.cameras:
            some = dataset_at(self.dataset, np.array(rows[-N_PLACING:]))
            if not self._is_placed(v, some):
                if len(rows) >= N_PLACING:
                    self.notes.append(
                        f"The legs were not recognised in the photographs of view {view} so far: "
                        "look at light and background, and at the readings of its poses."
                    )
                return
        for row in rows:
            if m.image[row] not in self.found:
                legs, _ = self._legs_in(dataset_at(self.dataset, np.array([row])))
                self.found[m.image[row]] = legs

    def _photographs_of(self, v: int) -> list[int]:
        m = self.dataset.measurements
        return [row for row in self.taken if m.view[row] == v and m.image[row]]

    def _is_placed(self, v: int, some: Dataset) -> bool:
        """Place the camera of a view by photographs of it; return whether these show its legs."""
        try:
            detection = detected(
                order_dataset(some, in_turn, no_progress), np.arange(some.measurements.n_rows)
            )
        except LegcalError:
            return False
        T = detection.T_base_camera[v]
        found, visible = self._counted(detection.outlines, some.measurements.n_rows)
        if T is None or detection.unplaced or found.sum() < SURELY * max(visible.sum(), 1):
            return False
        self.cameras[some.measurements.views[v].name] = T
        return True

    # What is known

    @cached_property
    def error(self) -> PlatformError | None:
        """The predicted error of the platform with the photographs so far; None if unknown."""
        taken = self._taken(to_choose=False)
        if not taken or self._work is None:
            return None
        poses = [pose for _, _, of_view, _ in taken for pose in of_view]
        parts, legs = [added for _, added, _, _ in taken], self._task.predictor.legs
        return self._work.error(fitted_covariance(parts, legs, poses, self.machine.size))

    @cached_property
    def _task(self) -> Task:
        m, board = self.dataset.measurements, self.dataset.board_on("base")
        lengths, _ = measured_length(self.machine, board=board is not None)
        predictor = Predictor(self.machine, m.views[0].camera, DEFAULT_NOISE, m.sigma_q, lengths)
        return Task(predictor, 1, 1, default_setting(self.machine))

    @cached_property
    def _work(self) -> Workspace | None:
        if any(view.hand_held for view in self.dataset.measurements.views):
            return None
        return workspace_of(self.machine, self._task.predictor.legs)

    @cached_property
    def _pool(self) -> Configurations:
        """Poses from which the next one is chosen."""
        task = self._task
        rng = np.random.default_rng(0)
        return candidate_poses(self.machine, task.predictor.legs, task.setting, N_CANDIDATES, rng)

    def _configurations(self, rows: Sequence[int]) -> Array:
        q = self.dataset.measurements.q[list(rows)][:, list(self.machine.motors)]
        return np.array(list(follow_each(self.machine, q)))

    def _known_with(self, view: str, pool: Configurations) -> tuple[Session, int, int] | None:
        """Return the information of what is taken, with poses that a view may take.

        With the number of this view among the slots, and of its first such pose.
        """
        slots, counts, at = list[Contributions](), list[int](), 0
        for name, added, _, n in self._taken(view, pool, to_choose=True):
            at = len(slots) if name == view else at
            slots.append(added)
            counts.append(n)
        if not slots:
            return None
        session = Session(slots)
        for s, n in enumerate(counts):
            for k in range(n):
                session.changed(s, k, 1.0)
        session.renewed()
        return session, at, counts[at]

    def _taken(
        self, view: str = "", pool: Configurations | None = None, *, to_choose: bool
    ) -> list[tuple[str, Contributions, Sequence[RigidTransform], int]]:
        """Return placed views, the information of their images, poses, and numbers of images taken.

        The poses of the *pool* follow those that are taken from a *view*. Nothing where readings do
        not determine a pose.
        """
        m, machine = self.dataset.measurements, self.machine
        views = list[tuple[str, Contributions, Sequence[RigidTransform], int]]()
        for v, one in enumerate(m.views if self._work is not None else ()):
            rows = [row for row in self.taken if m.view[row] == v]
            T = self.cameras.get(one.name, one.T_base_camera)
            if T is None or not rows:
                continue
            try:
                configurations = list(self._configurations(rows))
            except DidNotConverge:
                return []
            n, n_legs = len(rows), machine.n_legs
            found = np.array([self.found.get(m.image[row], np.ones(n_legs, dtype=np.bool_))
                              for row in rows])  # fmt: skip
            if pool is not None and one.name == view:
                configurations += list(pool.configurations)
                found = np.concatenate([found, np.ones((len(pool.poses), n_legs), dtype=np.bool_)])
            poses = platforms_in_base(machine, poses_at(machine, configurations).poses)
            added = self._task.contributions(
                T, poses, surely=False, to_choose=to_choose, found=found
            )
            if added is not None:
                views.append((one.name, added, poses, n))
        return views


def _cells(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Return the header and the rows of a table that has been read before."""
    table = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig")))
    rows = [{k.strip(): (x or "").strip() for k, x in row.items()} for row in table]
    return [name.strip() for name in table.fieldnames or ()], rows


def _joined(several: Measurements, one: Measurements) -> Measurements:
    """Return rows and one more row, at a pose of its own."""
    return replace(
        several,
        image=several.image + one.image,
        view=np.concatenate([several.view, one.view]),
        pose=np.append(several.pose, several.n_poses),
        q=np.concatenate([several.q, one.q]),
        pose_labels=(),
        time=None,
    )


def _label(cells: Mapping[str, str]) -> tuple[str, str]:
    """Return view and pose of a row, which name its photograph."""
    return cells["view"], cells.get("pose") or PurePosixPath(cells["image"]).stem


def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()
