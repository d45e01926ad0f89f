"""Photographs to outlines: recognition, measurement, diagnostics and overlays (section 3.1).

In go :class:`Photographs` (images, the model, which rows to search) and a nominal
:class:`Placement` (rough cameras, joint centres by the model). :func:`place_and_measure` of
``photographs`` is the method in order; out come a Placement,
:class:`legcal.data.outlines.Outlines` with covariance and verdict, and why images or views are left
out. :func:`measure_photographs` measures again near any Placement, as that of a joint fit
(``Placement.of_fit``). Modules by stage::

    images, nominal Placement
      | image_quality     exposure and blur; images that can show nothing are left out
      | candidate_pairs   straight edges of reduced images, in pairs that may be a leg
      | free_poses        platform poses, where readings do not give them
      | recognition       which pair is which leg, where the camera of a view stands
      |   camera_search   poses that pairs suggest, judged and refined by pair_matching,
      |                   or by all edges (EdgeMaps there) where pairs are unclear
      v
    recognised Placement
      | outline           each image: where parts should be, what hides them, both edges of a
      |                   part to a pixel, verdicts
      |   subpixel_edges  their lines: pixels and sums over them (profiles), a limb model (limb),
      |                   pieces fitted one by one (blocks), all together (pooled_fit)
      v
    Outlines
      | view_fit          cameras and joints by outlines; outliers; missing legs are looked for
      | diagnostics       images that are wrong, and why
      v
    Placement, Outlines, rejections -> joint fit -> Placement -> outline, once more

Beside them: ``alignment`` of images whose camera did not stand still, corners of calibration boards
(``board_corners`` by ``corner_lattice``) and where boards stand (``board_adjustment``),
``agreement`` of images with assumptions on a session, ``overlays``. ``tuning`` has the numbers on
which most depends.
"""
