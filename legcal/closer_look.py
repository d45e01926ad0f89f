"""The images of a dataset once more, near a fit of each view to the outlines that it showed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.observations.outlines import Outlines
from legcal.observations.sets import choose_outlines, join_outlines, merge_edited
from legcal.photographs import Joined, Photographs, Placement, counted, placed_cameras
from legcal.progress import Report
from legcal.recognition.closer import look_closer
from legcal.recognition.groups import group_views


def closer_look(
    photographs: Photographs,
    placement: Placement,
    outlines: Outlines,
    report: Report,
    joined: Joined = None,
    *,
    together: bool = True,
) -> tuple[Placement, Outlines]:
    """Return cameras by the outlines, and these with the legs that are found near that.

    Parameters
    ----------
    photographs : Photographs
        The images.
    placement : Placement
        What was recognised in them.
    outlines : Outlines
        Measured near there.
    report : callable
        Called as ``report(stage, done, total)``.
    joined : sequence of RigidTransform or None, for each view
        As :func:`legcal.photographs.place` has it.
    together : bool
        As for :func:`legcal.detection.outline.outline_parts`.
    """
    search, found, scene = placement.search, placement.recognised, placement.scene
    hints = [view.T_base_camera for view in search.measurements.views]
    groups = group_views(search.measurements, photographs.detect, hints, joined)
    is_own = np.isin(outlines.row, photographs.detect)
    own, others = choose_outlines(outlines, is_own), choose_outlines(outlines, ~is_own)
    closer = look_closer(
        search,
        groups,
        found,
        own,
        photographs.mechanism.leg_names,
        together=together,
        run=photographs.run,
        progress=counted(report, "Looking for missing legs", len(photographs.detect)),
    )
    searched = np.zeros(search.measurements.n_rows, dtype=np.bool_)
    searched[photographs.detect] = True
    rows = searched[:, None, None]
    cameras, unplaced = placed_cameras(photographs, scene, closer.recognised)
    scene = replace(
        scene,
        A_base=np.where(rows, closer.A_base, scene.A_base),
        B_base=np.where(rows, closer.B_base, scene.B_base),
        T_base_camera=cameras,
    )
    placement = replace(
        placement,
        scene=scene,
        recognised=closer.recognised,
        unplaced={**placement.unplaced, **unplaced},
    )
    return placement, join_outlines([merge_edited(closer.outlines, own), others])
