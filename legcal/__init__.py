"""Calibrate parallel robots from photographs of their legs.

The method is Renaud, Andreff, Gogu, Martinet, *On vision-based kinematic calibration of
n-leg parallel mechanisms* (IFAC 2002), followed by one joint fit in the image.

Notation, the same everywhere (with the letters of the paper):

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

import lazy_loader

_loaded, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Return what is public, imported at the first use."""
    from types import FunctionType

    from legcal.arguments import with_arguments_in_words

    if name == "ExportOptions":  # of version 0.1
        raise AttributeError(f"No {__name__} attribute {name}: legcal.export takes nodes=")
    found = _loaded(name)
    if isinstance(found, FunctionType):
        found = globals()[name] = with_arguments_in_words(found, __name__)
    return found
