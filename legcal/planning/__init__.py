"""Plan a session before it is shot: poses and camera places that determine the machine best.

In: a mechanism, a camera, what is known of the errors of outlines; out: a :class:`Plan`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
