"""What people read: results of the jobs as text and as pages.

In go the results of :mod:`legcal.calibration` or their documents, out come rich renderables, by one
renderer of tables (``render``), and HTML files, by one template (``page``).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
