"""Beyond the paper: one fit of everything at once, in the image."""

from legcal.refinement.build import build_fit
from legcal.refinement.legs import FittedLegs, fitted_legs
from legcal.refinement.platform_error import PlatformError, predict_platform_error
from legcal.refinement.refine import refine, refine_from_best, solve_fit
from legcal.refinement.settings import DEFAULT_SETTINGS, RefinementSettings
from legcal.refinement.solution import Solution
from legcal.refinement.start import Start, cameras_from_hints, platform_poses, start_from

__all__ = [
    "DEFAULT_SETTINGS",
    "FittedLegs",
    "PlatformError",
    "RefinementSettings",
    "Solution",
    "Start",
    "build_fit",
    "cameras_from_hints",
    "fitted_legs",
    "platform_poses",
    "predict_platform_error",
    "refine",
    "refine_from_best",
    "solve_fit",
    "start_from",
]
