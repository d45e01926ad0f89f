"""What images that were kept aside say of a fit, as documents and people have it."""

from __future__ import annotations

from typing import Any

import numpy as np

from legcal.refinement.held_out import HeldOut


def held_out_document(held_out: HeldOut) -> dict[str, Any]:
    """Return the block ``holdout`` of ``result.json``."""
    pair = held_out.at_platform
    return {
        "images": held_out.n_images,
        "poses": held_out.n_poses,
        "outlines": held_out.outlines,
        "wrong": held_out.wrong,
        "rms_px": held_out.rms_px,
        "expected_px": held_out.expected_px,
        "views": held_out.rms_px_of_view,
        "platform": None
        if pair is None
        else {
            "poses": len(held_out.displacement),
            "dX_m": pair.displacement,
            "expected_dX_m": pair.expected_displacement,
            "dE_rad": pair.rotation,
            "expected_dE_rad": pair.expected_rotation,
        },
    }


def held_out_lines(held_out: HeldOut) -> list[str]:
    """Return the sentences of the summary."""
    of = f"{held_out.n_images} image{'s' * (held_out.n_images != 1)} kept aside"
    if held_out.rms_px is None or held_out.expected_px is None:
        return [f"Held out: {of} show no outline that could be compared."]
    views = ", ".join(f"{name} {rms:.3f}" for name, rms in held_out.rms_px_of_view.items())
    lines = [
        f"Held out: {of}: {held_out.outlines - held_out.wrong} of {held_out.outlines} outlines are "
        f"{held_out.rms_px:.3f} px (rms) from where the fit of the others foretells them, "
        f"{held_out.expected_px:.3f} px were expected ({views})."
    ]
    pair = held_out.at_platform
    if pair is None:
        return [*lines, "They show too few legs at once to tell the platform's pose alone."]
    return [
        *lines,
        f"At the platform, its pose by what {len(held_out.displacement)} of {held_out.n_poses} "
        f"poses show alone is {1e3 * pair.displacement:.3f} mm / {np.degrees(pair.rotation):.4f} "
        f"deg (rms) from that by the readings; {1e3 * pair.expected_displacement:.3f} mm / "
        f"{np.degrees(pair.expected_rotation):.4f} deg were expected.",
    ]
