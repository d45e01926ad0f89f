"""``legcal simulate``."""

from __future__ import annotations

import legcal.cli.simulate_options as opt
from legcal.cli.options import (
    JsonOption,
    ModelArgument,
    image_workers,
    print_json,
    print_table,
)


def simulate(
    model: ModelArgument,
    output: opt.OutputOption,
    level: opt.LevelOption = opt.LevelChoice.PHOTOGRAPHS,
    seed: opt.SeedOption = 0,
    force: opt.ForceOption = False,
    error: opt.ErrorOption = None,
    coplanar: opt.CoplanarOption = False,
    poses: opt.PosesOption = "15",
    sampling: opt.SamplingOption = None,
    shared_poses: opt.SharedPosesOption = None,
    images: opt.ImagesOption = 1,
    views: opt.ViewsOption = None,
    cameras: opt.CamerasOption = None,
    camera: opt.CameraOption = None,
    board: opt.BoardOption = None,
    board_pose: opt.BoardPoseOption = False,
    hand_held: opt.HandHeldOption = False,
    hints: opt.HintsOption = True,
    tell_gamma: opt.TellGammaOption = None,
    pixel_noise: opt.PixelNoiseOption = None,
    table_noise: opt.TableNoiseOption = None,
    encoder_noise: opt.EncoderNoiseOption = "2um",
    appearance: opt.AppearanceOption = None,
    blur: opt.BlurOption = None,
    clutter: opt.ClutterOption = None,
    bits: opt.BitsOption = None,
    colour: opt.ColourOption = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate a dataset of a machine whose true model is known, and write it with the truth.

    The default is 45 photographs: 3 views of 15 extreme poses each.
    """
    from legcal.machine import load_mechanism
    from legcal.report import progress_on_stderr
    from legcal.simulation import Request, requested, summary_document, summary_table
    from legcal.simulation import simulate as run

    request = Request(
        level=level.value,
        seed=seed,
        error=tuple(error or ()),
        coplanar=coplanar,
        poses=poses,
        sampling=None if sampling is None else sampling.value,
        shared_poses=shared_poses,
        images=images,
        views=views,
        cameras=cameras,
        camera=camera,
        board=board,
        board_pose=board_pose,
        hand_held=hand_held,
        hints=hints,
        tell_gamma=tell_gamma,
        pixel_noise=pixel_noise,
        table_noise=None if table_noise is None else table_noise.value,
        encoder_noise=encoder_noise,
        appearance=appearance,
        blur=blur,
        clutter=clutter,
        bits=bits,
        colour=colour,
    )
    nominal = load_mechanism(model)
    settings = requested(request, nominal)
    workers = image_workers()
    with progress_on_stderr() as progress:
        made = run(nominal, output, settings, force=force, workers=workers, progress=progress)
    if as_json:
        print_json(summary_document(made))
    else:
        print_table(summary_table(made))
