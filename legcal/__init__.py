"""Calibrate parallel robots from photographs of their legs.

The method is Renaud, Andreff, Gogu, Martinet, *On vision-based kinematic calibration of
n-leg parallel mechanisms* (IFAC 2002), followed by one fit of everything in the image.

Notation, the same everywhere (the letters are the paper's):

=====================  =====================================================================
``T_to_from``          a rigid motion; neighbours cancel: ``p_base = T_base_camera.apply(p_camera)``
frames                 world, base (link), platform (link), tool, camera, image;
                       ``Rb`` and ``Re`` are the frames built on base and platform joint centres
``A_j``, ``B_j``       joint centres of leg j on base and platform [m]
``u``, ``M``           unit direction of a leg axis from base to platform; a point of it
``h``, ``epsilon``     an outline as the unit normal of its plane (eqs 2, 3) and its sign (eq 5)
``q``, ``q0``          encoder reading and offset [m]: leg length L = sign q + q0
``sigma_x``, ``n_x``   a standard deviation, a count
=====================  =====================================================================

SI units and radians everywhere; pixel (0, 0) is the centre of the top-left pixel; camera axes
are x right, y down, z forward.
"""

from typing import TYPE_CHECKING, Any

from legcal.errors import LegcalError
from legcal.version import __version__

if TYPE_CHECKING:
    from legcal.camera_calibration.calibrate import calibrate_camera
    from legcal.checking import check
    from legcal.dataset.folder import load_dataset
    from legcal.detecting import detect
    from legcal.identify.analysis import identifiability
    from legcal.location.document import load_location, write_location
    from legcal.location.locate import locate
    from legcal.location.location import Location
    from legcal.location.tool_poses import ToolPoses
    from legcal.mechanism.configurations import random_configurations
    from legcal.mechanism.kinematics import Follower, forward_kinematics, inverse_kinematics
    from legcal.mechanism.load import load_mechanism
    from legcal.mechanism.singularity import singularity
    from legcal.pipeline import calibrate
    from legcal.repeatability.noise import measure_noise
    from legcal.report.accuracy import evaluate
    from legcal.simulation.parameter_errors import ParameterErrors, Spread
    from legcal.simulation.rendering.appearance import Appearance
    from legcal.simulation.settings import SimulationSettings
    from legcal.simulation.simulate import simulate
    from legcal.simulation.table_noise import TableNoise

__all__ = [
    "Appearance",
    "Follower",
    "LegcalError",
    "Location",
    "ParameterErrors",
    "SimulationSettings",
    "Spread",
    "TableNoise",
    "ToolPoses",
    "__version__",
    "calibrate",
    "calibrate_camera",
    "check",
    "detect",
    "evaluate",
    "forward_kinematics",
    "identifiability",
    "inverse_kinematics",
    "load_dataset",
    "load_location",
    "load_mechanism",
    "locate",
    "measure_noise",
    "random_configurations",
    "simulate",
    "singularity",
    "write_location",
]

_HOME = {
    "Appearance": "legcal.simulation.rendering.appearance",
    "Follower": "legcal.mechanism.kinematics",
    "Location": "legcal.location.location",
    "ParameterErrors": "legcal.simulation.parameter_errors",
    "SimulationSettings": "legcal.simulation.settings",
    "Spread": "legcal.simulation.parameter_errors",
    "TableNoise": "legcal.simulation.table_noise",
    "ToolPoses": "legcal.location.tool_poses",
    "calibrate": "legcal.pipeline",
    "calibrate_camera": "legcal.camera_calibration.calibrate",
    "check": "legcal.checking",
    "detect": "legcal.detecting",
    "evaluate": "legcal.report.accuracy",
    "forward_kinematics": "legcal.mechanism.kinematics",
    "identifiability": "legcal.identify.analysis",
    "inverse_kinematics": "legcal.mechanism.kinematics",
    "load_dataset": "legcal.dataset.folder",
    "load_location": "legcal.location.document",
    "load_mechanism": "legcal.mechanism.load",
    "locate": "legcal.location.locate",
    "measure_noise": "legcal.repeatability.noise",
    "random_configurations": "legcal.mechanism.configurations",
    "simulate": "legcal.simulation.simulate",
    "singularity": "legcal.mechanism.singularity",
    "write_location": "legcal.location.document",
}


def __getattr__(name: str) -> Any:
    """Import the public functions when they are first used: a command loads what it needs."""
    if name not in _HOME:
        raise AttributeError(f"module 'legcal' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOME[name]), name)
