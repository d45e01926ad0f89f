"""What people read: results of the jobs as text and as pages.

In go the results of :mod:`legcal.calibration` or their documents, out come rich renderables, by one
renderer of tables (``render``), and HTML files, by one template (``page``).
"""
