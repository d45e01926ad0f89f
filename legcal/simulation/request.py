"""The options of ``legcal simulate``, declared once: the command line takes them from here.

Nothing but the standard library is imported here, so that help and completion answer at once.
:func:`legcal.simulation.settings.requested` makes them into settings.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from legcal.option_fields import option

_MACHINE, _MOTION, _CAMERAS = "The true machine", "Poses and images", "Cameras"
_NOISE, _LOOK = "Noise", "Photographs"


class Level(StrEnum):
    """What a simulated dataset gives a calibration to work on."""

    AXES = "axes"
    OUTLINES = "outlines"
    PHOTOGRAPHS = "photographs"


class Sampling(StrEnum):
    """How poses are drawn: every motor near an end of its travel, or anywhere in it."""

    EXTREME = "extreme"
    WORKSPACE = "workspace"


class Angles(StrEnum):
    """How the angles of Table 1 are read."""

    DEGREES = "degrees"
    RADIANS = "radians"


def _option(
    text: str,
    panel: str | None = None,
    *,
    only: Level | None = None,  # level that it has an effect on, if only on one
    **how: Any,
) -> dict[str, Any]:
    """Return what the command line and :func:`requested` know of a field beside its type."""
    return option(text, panel, **how) | {"only": only}


@dataclass(frozen=True, kw_only=True)
class Request:
    """The options of ``legcal simulate`` as people write them; None where not given."""

    level: Level = field(
        default=Level.PHOTOGRAPHS,
        metadata=_option(
            "Rendered photographs; outlines with noise in pixels (observations.csv); or leg axes "
            "with the noise of the paper's Table 1 (axes.csv).",
        ),
    )
    seed: int = field(
        default=0, metadata=_option("The same seed gives the same dataset, to the last bit.")
    )
    error: list[str] | None = field(
        default=None,
        metadata=_option(
            "How far the true machine is from the model: joints, base-joints, platform-joints, "
            "offsets, lengths (2mm), axes, twists (0.1deg), radii (0mm); uniform in +-SIZE, or "
            "SIZE:normal; none for no errors. May be repeated.",
            _MACHINE,
            metavar="KIND=SIZE",
            shown="joints, offsets, lengths=2mm; axes, twists=0.1deg",
        ),
    )
    coplanar: bool = field(
        default=False,
        metadata=_option(
            "Keep joints in the plane that they are nominally in.",
            _MACHINE,
            flags=("--coplanar",),
        ),
    )
    poses: str = field(
        default="15",
        metadata=_option(
            "Poses for each view; or a CSV of readings in metres (radians of arms), the motors' "
            "joints in its header, for all views.",
            _MOTION,
            metavar="N|CSV",
        ),
    )
    plan: Path | None = field(
        default=None,
        metadata=_option(
            "Instead of poses and cameras: a session that legcal plan wrote, with tripods as far "
            "off as it allows for.",
            _MOTION,
            metavar="SESSION",
        ),
    )
    sampling: Sampling | None = field(
        default=None,
        metadata=_option(
            "Every motor near an end of its travel, or anywhere.", _MOTION, shown="extreme"
        ),
    )
    shared_poses: bool | None = field(
        default=None,
        metadata=_option(
            "All views see the same poses (several cameras at once), or each its own (one camera "
            "that is moved).",
            _MOTION,
            flags=("--shared-poses/--own-poses",),
            shown="own",
        ),
    )
    images: int = field(default=1, metadata=_option("Images of each pose in each view.", _MOTION))
    views: int | None = field(
        default=None,
        metadata=_option(
            "Cameras around the machine, where its legs are seen well.", _CAMERAS, shown="3"
        ),
    )
    cameras: Path | None = field(
        default=None,
        metadata=_option(
            "Instead: a YAML with views: {NAME: {T_base_camera: {xyz, quat_xyzw}, camera}}.",
            _CAMERAS,
            metavar="FILE",
        ),
    )
    camera: list[str] | None = field(
        default=None,
        metadata=_option(
            "Camera file (ROS, OpenCV, Kalibr); or what it does to photographs: machine-jpeg, "
            "webcam, phone, action or industrial, webcam:60 for another JPEG quality. Once for "
            "each.",
            _CAMERAS,
            metavar="FILE|KIND",
            shown="1024 x 768 px, slight distortion; industrial",
        ),
    )
    board: str | None = field(
        default=None,
        metadata=_option(
            "A calibration board on the base: chessboard, charuco or aprilgrid, of a size that "
            "fits the machine, or a YAML with the block board of a dataset.",
            _CAMERAS,
            metavar="KIND|FILE",
            shown="none",
        ),
    )
    platform_board: str | None = field(
        default=None,
        metadata=_option("The same on the platform.", _CAMERAS, metavar="KIND|FILE", shown="none"),
    )
    board_pose: bool = field(
        default=False,
        metadata=_option(
            "Write the poses of boards in their links into dataset.yaml.",
            _CAMERAS,
            flags=("--board-pose",),
        ),
    )
    hand_held: bool = field(
        default=False,
        metadata=_option(
            "Every image from another camera position, with the board in it.",
            _CAMERAS,
            flags=("--hand-held",),
        ),
    )
    hints: bool = field(
        default=True,
        metadata=_option(
            "Write rough camera poses (15 mm, 1.5 deg) and each view's legs into dataset.yaml.",
            _CAMERAS,
            flags=("--hints/--no-hints",),
        ),
    )
    tell_gamma: bool | None = field(
        default=None,
        metadata=_option(
            "Write the gamma of the cameras into dataset.yaml.",
            _LOOK,
            flags=("--gamma/--no-gamma",),
            shown="gamma",
            only=Level.PHOTOGRAPHS,
        ),
    )
    length: list[str] | None = field(
        default=None,
        metadata=_option(
            "A distance of two joints measured by hand, with this sigma, written into "
            "dataset.yaml: leg1.base:leg1.platform=0.05mm. May be repeated.",
            _NOISE,
            metavar="JOINT:JOINT=SIGMA",
            shown="none",
        ),
    )
    pixel_noise: str | None = field(
        default=None,
        metadata=_option(
            "Sigma of each edge point of an outline, and of each corner of a board.",
            _NOISE,
            metavar="SIGMA",
            shown="0.1px",
            only=Level.OUTLINES,
        ),
    )
    table_noise: Angles | None = field(
        default=None,
        metadata=_option(
            "How the angles of Table 1 are read.", _NOISE, shown="degrees", only=Level.AXES
        ),
    )
    encoder_noise: str = field(
        default="2um",
        metadata=_option(
            "Sigma of readings, 2um or of motors that turn 0.5deg; 3um:uniform for +-3um.",
            _NOISE,
            metavar="SIGMA",
        ),
    )
    appearance: Path | None = field(
        default=None,
        metadata=_option(
            "A YAML of lights, background, clutter, sensor and more.",
            _LOOK,
            metavar="FILE",
            only=Level.PHOTOGRAPHS,
        ),
    )
    blur: float | None = field(
        default=None,
        metadata=_option("Sigma of the lens's blur.", _LOOK, metavar="PX", only=Level.PHOTOGRAPHS),
    )
    clutter: int | None = field(
        default=None,
        metadata=_option("Rods, boxes and balls in the background.", _LOOK, only=Level.PHOTOGRAPHS),
    )
    bits: int | None = field(
        default=None, metadata=_option("Bits of a pixel, 8 or 16.", _LOOK, only=Level.PHOTOGRAPHS)
    )
    colour: bool | None = field(
        default=None,
        metadata=_option(
            "Colour or grey.", _LOOK, flags=("--colour/--grey",), only=Level.PHOTOGRAPHS
        ),
    )
