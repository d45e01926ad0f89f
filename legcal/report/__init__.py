"""Results of the jobs as text and as pages.

Results of :mod:`legcal.calibration` or their documents become rich renderables with the tables of
``render``, or HTML files (``page``).
"""
