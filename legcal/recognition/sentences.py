"""Why views could not be placed, in one sentence each."""

from collections.abc import Sequence

import numpy as np

from legcal.recognition.placed import Placed


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
