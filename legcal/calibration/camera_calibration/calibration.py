"""From photographs of a board to a camera: ``legcal camera``."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from legcal.calibration.camera_calibration.consensus import MIN_CORNERS, RobustFit
from legcal.calibration.camera_calibration.diagnostics import (
    MIN_IMAGES,
    Repeats,
    noise_correlation,
    refuse_divided,
    refuse_undetermined,
    repeat_noise,
    tilts,
    too_few_images,
    warnings,
)
from legcal.calibration.camera_calibration.document import (
    CAMERA_FILE,
    PICTURE_FILE,
    BoardImage,
    CameraCalibration,
    write_camera,
    write_picture,
)
from legcal.calibration.camera_calibration.lens import ChosenLens, chosen_lens, given_lens
from legcal.data.photograph_notes import differences, recorded
from legcal.errors import DatasetError, DidNotConverge, NotVisible, Problem, UsageError
from legcal.files.schema import MAX_IMAGE, describe, few, natural_key, read_bytes
from legcal.perception.board_adjustment import SHEET, BoardImages
from legcal.perception.board_corners import (
    NumberedCorners,
    SeenBoard,
    board_in_words,
    describe_image,
    search_images,
    shown_board,
    tags_are_mirrored,
)
from legcal.progress import Progress, shown_progress
from legcal.vision.board import Board, board_of
from legcal.vision.camera import Camera
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import (
    BadImage,
    Grey,
    ImageFacts,
    ImageSize,
    image_size,
    image_suffixes,
    likely_cause,
    read_facts,
    read_image,
)
from legcal.vision.point_pose import on_a_line
from legcal.workers import Workers, worker_pool

_ADJUSTING = "Adjusting the camera"
_N_DESCRIBED = 2  # images without the board that are described
# smallest motion of the board between two images, relative to its diagonal, and smallest change of
# its shape where it is shifted by less than the last number
_SAME_PLACE, _SAME_SHAPE, _SHIFTED = 0.01, 0.002, 0.05


def calibrate_camera(
    images: str | Path | Sequence[str | Path],
    board: str | Path | Board,
    *,
    model: DistortionModel | None = None,
    output: str | Path | None = None,
    progress: Progress = False,
    workers: Workers = 1,
    picture: str | Path | None = None,
) -> CameraCalibration:
    """Calibrate a camera from photographs of a flat board.

    Parameters
    ----------
    images : str, Path or sequence of these
        Files, folders or patterns.
    board : str, Path or Board
        Such as ``chessboard:9x6:25mm`` (squares), or a YAML file with the block ``board`` of a
        dataset. Its size does not matter here, its proportions do.
    model : str, optional
        The distortion model of the lens: plumb_bob, rational_polynomial, thin_prism, equidistant or
        splined_radial. Chosen by default: plumb_bob unless a richer model
        explains images that contradict it, or predicts the images better.
    output : path, optional
        Write a ROS camera_info file there, with the covariance of all intrinsics, which
        :func:`legcal.calibrate` takes as their prior.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    workers : int, str or executor
        Search the images there, as :func:`legcal.calibrate` does.
    picture : path, optional
        Write a PNG of the corners and their mean residuals over the field there.

    Returns
    -------
    CameraCalibration
        Look at its ``warnings`` before you use it.

    Raises
    ------
    DatasetError
        If images cannot be read, or differ in size.
    UsageError
        If the board, the model or the output is invalid.
    NotVisible
        If no image shows the board.
    NotIdentifiable
        If fewer than three images show it, or all from one side, or if too few of them agree on
        one camera.
    DidNotConverge
        If no camera explains the corners.
    """
    _check_options(model, output, picture)
    stated = board_of(board)
    photographs = _of_one_size(
        _listed_images([images] if isinstance(images, str | Path) else images)
    )
    with shown_progress(progress) as report:
        with worker_pool(workers) as run:
            paths = tuple(path.absolute() for path in photographs.paths)
            load = replace(photographs, paths=paths).read  # in any process
            board_images = search_images(stated, load, range(len(paths)), run, report)
        board_in_images = _shown_in(stated, photographs, board_images)
        report(_ADJUSTING, 0, 1)
        table, size = board_in_images.table, photographs.size
        lens = chosen_lens(table, size) if model is None else given_lens(table, size, model)
        report(_ADJUSTING, 1, 1)
    if lens is None:
        raise DidNotConverge(
            f"The camera could not be calibrated: found no {model or 'lens model'} that explains "
            "the corners, needed one; check the board and the model of the lens."
        )
    names = [photographs.paths[k].name for k in board_in_images.images]
    refuse_divided(lens.fit, names)
    left_out = [f"{names[i]}: {reason}" for i, reason in lens.fit.left_out.items()]
    refuse_undetermined(lens.fit, [names[i] for i in lens.fit.images], left_out)
    result = _result(photographs, board_in_images, lens)
    if output is not None:
        write_camera(result, Path(output))
    if picture is not None:
        write_picture(result, Path(picture))
    return result


def _check_options(
    model: DistortionModel | None, output: str | Path | None, picture: str | Path | None
) -> None:
    """Raise UsageError for an unknown model, and for files that could not be written."""
    if model is not None and model not in get_args(DistortionModel):
        raise UsageError(
            f"The camera could not be calibrated: found the model {model!r}, needed "
            f"{', '.join(get_args(DistortionModel))}; correct it."
        )
    if output is not None:
        CAMERA_FILE.check_place(Path(output))
    if picture is not None:
        PICTURE_FILE.check_place(Path(picture))
        if output is not None and Path(output).resolve() == Path(picture).resolve():
            raise UsageError(
                f"{picture}: the picture could not be written: found the file of the camera there, "
                "needed one of its own; give another file."
            )


@dataclass(frozen=True, eq=False)
class _Photographs:
    paths: tuple[Path, ...]
    facts: tuple[ImageFacts, ...]  # metadata of each file
    size: ImageSize

    def read(self, k: int) -> Grey:
        """Return the grey levels of photograph k."""
        return read_image(self.paths[k], Camera(np.eye(3), self.size.width, self.size.height))


@dataclass(frozen=True, eq=False)
class _ShownBoard:
    """A board with its corners in photographs."""

    board: Board
    corners: Sequence[NumberedCorners]  # corners in every photograph
    images: Sequence[int]  # photographs with the board in distinct poses
    unused: Mapping[int, str]  # reasons why others are not used, except for lack of corners
    note: str  # difference from the stated board
    repeats: Sequence[tuple[int, int]]  # photographs in which it stands still

    @property
    def table(self) -> BoardImages:
        """The corners of all used images in one table."""
        return self.table_of([self.corners[k] for k in self.images])

    def table_of(self, tables: Sequence[NumberedCorners]) -> BoardImages:
        """Return the corners of some images in one table."""
        return BoardImages(
            np.repeat(np.arange(len(tables)), [len(corners.number) for corners in tables]),
            np.concatenate([self.board.points[corners.number] for corners in tables]),
            np.concatenate([corners.px for corners in tables]),
            np.concatenate([corners.sigma_px for corners in tables]),
            0.5 * self.board.marker if self.board.has_circles else 0.0,
        )


def _shown_in(
    stated: Board, photographs: _Photographs, board_images: Sequence[SeenBoard]
) -> _ShownBoard:
    """Return the board with its corners in the images.

    Raises NotVisible or NotIdentifiable if no image shows the board, or too few do.
    """
    paths = photographs.paths
    board, note = shown_board(stated, board_images)
    if board is None:
        raise _not_visible(stated, note)
    corners_by_image = [board_image.numbered(board) for board_image in board_images]
    enough = [k for k, corners in enumerate(corners_by_image) if len(corners.number) >= MIN_CORNERS]
    lines = {
        k: "only corners on one line of the board were found"
        for k in enough
        if on_a_line(board.points[corners_by_image[k].number])
    }
    usable = [k for k in enough if k not in lines]
    if not usable:
        n = len(paths)
        described = (describe_image(stated, photographs.read(k)) for k in range(n)[:_N_DESCRIBED])
        what = next((words for words in described if words), "nothing like the board")
        raise _not_visible(stated, f"{what} in its {n} image{'s' * (n != 1)}")
    copies, repeats = _copies(corners_by_image, usable, paths)
    distinct = [k for k in usable if k not in copies]
    if len(distinct) < MIN_IMAGES:
        same = _by_reason((paths[k].name, reason) for k, reason in copies.items())
        raise too_few_images(len(distinct), [paths[k].name for k in distinct], copies=same)
    without = set(range(len(paths))).difference(enough) if board.dictionary else ()
    mirrored = {
        k: "mirrored, left and right exchanged"
        for k in sorted(without)
        if tags_are_mirrored(board, photographs.read(k))
    }
    unused = copies | mirrored | lines
    return _ShownBoard(board, corners_by_image, distinct, unused, note, repeats)


def _not_visible(board: Board, instead: str) -> NotVisible:
    hint = ""
    if board.kind == "chessboard":
        hint = f" (squares are counted: {board.columns - 1} x {board.rows - 1} inner corners)"
    return NotVisible(
        f"The camera could not be calibrated: found {instead}, needed {board_in_words(board)}"
        f"{hint}; correct --board, or take sharper images of the whole board."
    )


def _copies(
    corners: Sequence[NumberedCorners], usable: Sequence[int], paths: Sequence[Path]
) -> tuple[dict[int, str], list[tuple[int, int]]]:
    """Return a reason for each image with the board in the pose of an earlier one, and the pairs.

    Such images share the errors of corners by lens and print, and add no information on the camera,
    also where the picture is shifted by a few pixels; but they tell the noise of corners.
    """
    copies: dict[int, str] = {}
    pairs: list[tuple[int, int]] = []
    distinct: list[int] = []
    for k in usable:
        for i in distinct:
            _, a, b = np.intersect1d(corners[i].number, corners[k].number, return_indices=True)
            if 2 * len(a) < max(len(corners[i].number), len(corners[k].number)):
                continue
            moved = corners[k].px[b] - corners[i].px[a]
            size = float(np.linalg.norm(np.ptp(corners[i].px, axis=0)))
            shift = moved.mean(axis=0)
            by, changed = (
                float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) / size
                for off in (moved, moved - shift)
            )
            if not moved.any():
                copies[k] = f"the same photograph as {paths[i].name}"
            elif by < _SAME_PLACE:
                copies[k] = f"the board stands as in {paths[i].name}"
            elif by < _SHIFTED and changed < _SAME_SHAPE:
                copies[k] = f"the board stands as in {paths[i].name}, only shifted in the picture"
            else:
                continue
            pairs.append((i, k))
            break
        else:
            distinct.append(k)
    return copies, pairs


def _repeats(board_in_images: _ShownBoard, fitted: RobustFit) -> Repeats | None:
    """Return the noise of corners by images in which the board stands as in a used one."""
    number = {board_in_images.images[k]: i for i, k in enumerate(fitted.images)}
    tables, first = list[NumberedCorners](), list[int]()
    for pair in board_in_images.repeats:
        if pair[0] not in number:
            continue
        both = [board_in_images.corners[k] for k in pair]
        rows = np.intersect1d(both[0].number, both[1].number, return_indices=True)[1:]
        tables += [corners.choose(these) for corners, these in zip(both, rows, strict=True)]
        first.append(number[pair[0]])
    return repeat_noise(fitted, board_in_images.table_of(tables), first) if first else None


def _result(
    photographs: _Photographs, board_in_images: _ShownBoard, lens: ChosenLens
) -> CameraCalibration:
    fitted, paths, facts = lens.fit, photographs.paths, photographs.facts
    adjusted, corners = fitted.adjusted, fitted.corners
    used = {board_in_images.images[k]: i for i, k in enumerate(fitted.images)}
    left_out = {
        **board_in_images.unused,
        **{board_in_images.images[k]: reason for k, reason in fitted.left_out.items()},
    }
    square = np.sum(adjusted.residual**2, axis=1)
    tilt = tilts(fitted)
    length_px, effective = noise_correlation(corners, adjusted.residual)
    images = []
    for k, path in enumerate(paths):
        i = used.get(k)
        reason = left_out.get(k, "" if k in board_in_images.images else "the board was not found")
        of_image = corners.image == i
        images.append(
            BoardImage(
                image=path.name,
                corners=len(board_in_images.corners[k].number),
                used=int(np.count_nonzero(of_image)),
                rms_px=None if i is None else adjusted.rms_px(of_image),
                tilt_rad=None if i is None else float(tilt[i]),
                reason=(reason or None) if i is None else None,
            )
        )
    used_images = [k for k, image in enumerate(images) if image.used]
    of_reasons = _by_reason((image.image, image.reason) for image in images if image.reason)
    n_dof = max(2 * len(square) - len(adjusted.covariance) - 6 * len(fitted.images), 1)
    return CameraCalibration(
        camera=adjusted.camera,
        covariance=fitted.covariance,
        board=board_in_images.board,
        images=tuple(images),
        rms_px=adjusted.rms_px(),
        noise_px=float(np.sqrt(square.sum() / n_dof)),
        noise_length_px=length_px,
        effective_corners=effective,
        repeats=_repeats(board_in_images, fitted),
        sheet=fitted.sheet,
        sheet_covariance=fitted.all_covariance[-len(SHEET) :, -len(SHEET) :],
        error_ratio=float(np.sqrt(fitted.ratio)),
        lens=lens.reason,
        validated_px=lens.validated_px,
        corners=np.concatenate([corners.px, adjusted.residual], axis=1),
        warnings=(
            *([board_in_images.note] if board_in_images.note else []),
            *(f"{', '.join(names)} left out: {why}." for why, names in of_reasons.items()),
            *lens.warnings,
            *warnings(fitted),
            *_changes(
                [paths[k] for k in used_images], [facts[k] for k in used_images], photographs.size
            ),
        ),
        photographs=recorded([facts[k] for k in used_images]),
    )


def _by_reason(left_out: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    names_by_reason: dict[str, list[str]] = {}
    for name, reason in left_out:
        names_by_reason.setdefault(reason, []).append(name)
    return names_by_reason


def _listed_images(named: Sequence[str | Path]) -> list[Path]:
    """Return the image files without duplicates; a folder or pattern is sorted by name."""
    files: dict[Path, None] = {}
    problems = []
    for name in named:
        paths = _matching(str(name))
        if not paths:
            problems.append(
                f"The images {describe(str(name))} could not be read: found no such file, folder "
                f"with images or pattern that matches one, needed {', '.join(image_suffixes())}; "
                "check the path."
            )
        files |= dict.fromkeys(paths)
    if problems or not files:
        raise DatasetError(
            problems or "The images could not be read: found none, needed some; name them."
        )
    return list(files)


def _matching(name: str) -> list[Path]:
    """Return the images of a file, folder or pattern."""
    if not name:
        return []
    path, suffixes = Path(name), image_suffixes()
    if path.is_dir():
        hits = [p for p in path.iterdir() if not p.name.startswith(".")]
    elif os.path.lexists(path):
        return [path]
    else:
        hits = [Path(hit) for hit in glob.glob(name, recursive=True)]
    hits.sort(key=lambda hit: natural_key(hit.as_posix()))
    return [hit for hit in hits if hit.suffix.lower() in suffixes and hit.is_file()]


def _of_one_size(paths: Sequence[Path]) -> _Photographs:
    """Return photographs; raise DatasetError if they cannot be read or differ in size."""
    sizes: dict[ImageSize, list[Path]] = {}
    facts: list[ImageFacts] = []
    problems = []
    for path in paths:
        try:
            content = read_bytes(path, MAX_IMAGE)
            sizes.setdefault(image_size(content), []).append(path)
            facts.append(read_facts(content))
            continue
        except OSError as error:
            mismatch = f"'{error.strerror}'", "a readable file"
        except BadImage as error:
            mismatch = str(error.found), error.needed
        unread, remedy = "the image could not be read", "copy it again or leave it out"
        problems.append(Problem(unread, *mismatch, remedy, str(path)))
    if problems:
        raise DatasetError(problems)
    if len(sizes) > 1:
        by_count = sorted(sizes.items(), key=lambda item: -len(item[1]))
        usual = by_count[0][0]
        first = {size: facts[paths.index(paths_of_size[0])] for size, paths_of_size in by_count}
        sizes_in_words = "; ".join(
            f"{size.width} x {size.height} px in {few([path.name for path in paths_of_size])}"
            f"{likely_cause(size, usual, first[size]) if size != usual else ''}"
            for size, paths_of_size in by_count
        )
        raise DatasetError(
            f"The camera could not be calibrated: found images of different sizes, "
            f"{sizes_in_words}, needed one size; leave out those that another camera took, or that "
            "were scaled, cropped or turned."
        )
    return _Photographs(tuple(paths), tuple(facts), next(iter(sizes)))


def _changes(paths: Sequence[Path], facts: Sequence[ImageFacts], size: ImageSize) -> Iterator[str]:
    """Yield a warning for each fact that photographs of a camera must share."""
    named = list(zip([path.name for path in paths], facts, strict=True))
    for difference in differences(named, (size.width, size.height), {}):
        yield (
            f"No one camera may hold for all images: found {difference.groups}, needed one "
            f"{difference.fact.what}; leave out those that differ, and photograph the machine like "
            "the others."
        )
