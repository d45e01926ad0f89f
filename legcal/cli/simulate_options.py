"""The options of ``legcal simulate``, in the groups that its help shows."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

_MACHINE, _MOTION, _CAMERAS = "The true machine", "Poses and images", "Cameras"
_NOISE, _LOOK = "Noise", "Photographs"


class LevelChoice(StrEnum):
    """What the dataset gives a calibration to work on."""

    AXES = "axes"
    OUTLINES = "outlines"
    PHOTOGRAPHS = "photographs"


class SamplingChoice(StrEnum):
    """How poses are drawn."""

    EXTREME = "extreme"
    WORKSPACE = "workspace"


class AngleChoice(StrEnum):
    """How the angles of Table 1 are read."""

    DEGREES = "degrees"
    RADIANS = "radians"


OutputOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="DATASET", help="The folder to write.")
]
LevelOption = Annotated[
    LevelChoice,
    typer.Option(
        help="Rendered photographs; outlines with noise in pixels (observations.csv); or leg "
        "axes with the noise of the paper's Table 1 (axes.csv)."
    ),
]
SeedOption = Annotated[
    int, typer.Option(help="The same seed gives the same dataset, to the last bit.")
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace an earlier simulated dataset in that folder.")
]
ErrorOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KIND=SIZE",
        help="How far the true machine is from the model: joints, base-joints, platform-joints, "
        "offsets, lengths (2mm), axes, twists (0.1deg), radii (0mm); uniform in +-SIZE, or "
        "SIZE:normal; none for no errors. May be repeated.",
        rich_help_panel=_MACHINE,
        show_default="joints, offsets, lengths=2mm; axes, twists=0.1deg",
    ),
]
CoplanarOption = Annotated[
    bool,
    typer.Option(
        "--coplanar",
        help="Keep joints in the plane that they are nominally in.",
        rich_help_panel=_MACHINE,
    ),
]
PosesOption = Annotated[
    str,
    typer.Option(
        metavar="N|CSV",
        help="Poses for each view; or a CSV of readings in metres, the motors' joints in its "
        "header, for all views.",
        rich_help_panel=_MOTION,
    ),
]
SamplingOption = Annotated[
    SamplingChoice | None,
    typer.Option(
        help="Every motor near an end of its travel, or anywhere.",
        rich_help_panel=_MOTION,
        show_default="extreme",
    ),
]
SharedPosesOption = Annotated[
    bool | None,
    typer.Option(
        "--shared-poses/--own-poses",
        help="All views see the same poses (several cameras at once), or each its own (one "
        "camera that is moved).",
        rich_help_panel=_MOTION,
        show_default="own",
    ),
]
ImagesOption = Annotated[
    int, typer.Option(help="Images of each pose in each view.", rich_help_panel=_MOTION)
]
ViewsOption = Annotated[
    int | None,
    typer.Option(
        help="Cameras around the machine, where its legs are seen well.",
        rich_help_panel=_CAMERAS,
        show_default="3",
    ),
]
CamerasOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Instead: a YAML with views: {NAME: {T_base_camera: {xyz, quat_xyzw}, camera}}.",
        rich_help_panel=_CAMERAS,
    ),
]
CameraOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Camera file (ROS, OpenCV, Kalibr).",
        rich_help_panel=_CAMERAS,
        show_default="1024 x 768 px, slight distortion",
    ),
]
BoardOption = Annotated[
    str | None,
    typer.Option(
        metavar="KIND|FILE",
        help="A calibration board on the base: chessboard, charuco or aprilgrid, of a size that "
        "fits the machine, or a YAML with the block board of a dataset.",
        rich_help_panel=_CAMERAS,
        show_default="none",
    ),
]
BoardPoseOption = Annotated[
    bool,
    typer.Option(
        "--board-pose", help="Tell where the board is in the base link.", rich_help_panel=_CAMERAS
    ),
]
HandHeldOption = Annotated[
    bool,
    typer.Option(
        "--hand-held",
        help="Take every image from a place of its own, with the board in it.",
        rich_help_panel=_CAMERAS,
    ),
]
HintsOption = Annotated[
    bool,
    typer.Option(
        "--hints/--no-hints",
        help="Tell roughly where cameras stand (15 mm, 1.5 deg), and the legs of each view.",
        rich_help_panel=_CAMERAS,
    ),
]
TellGammaOption = Annotated[
    bool | None,
    typer.Option(
        "--gamma/--no-gamma",
        help="Tell how the cameras encode light.",
        rich_help_panel=_LOOK,
        show_default="gamma",
    ),
]
PixelNoiseOption = Annotated[
    str | None,
    typer.Option(
        metavar="SIGMA",
        help="Of each edge point of an outline, and each corner of a board.",
        rich_help_panel=_NOISE,
        show_default="0.1px",
    ),
]
TableNoiseOption = Annotated[
    AngleChoice | None,
    typer.Option(
        help="How the angles of Table 1 are read.", rich_help_panel=_NOISE, show_default="degrees"
    ),
]
EncoderNoiseOption = Annotated[
    str,
    typer.Option(
        metavar="SIGMA", help="Of readings; 3um:uniform for +-3um.", rich_help_panel=_NOISE
    ),
]
AppearanceOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="A YAML of lights, background, clutter, sensor and more.",
        rich_help_panel=_LOOK,
    ),
]
BlurOption = Annotated[
    float | None,
    typer.Option(metavar="PX", help="Sigma of the lens's blur.", rich_help_panel=_LOOK),
]
ClutterOption = Annotated[
    int | None,
    typer.Option(help="Rods, boxes and balls in the background.", rich_help_panel=_LOOK),
]
BitsOption = Annotated[
    int | None, typer.Option(help="Bits of a pixel, 8 or 16.", rich_help_panel=_LOOK)
]
ColourOption = Annotated[
    bool | None,
    typer.Option("--colour/--grey", help="Colour or grey.", rich_help_panel=_LOOK),
]
