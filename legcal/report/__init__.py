"""Results of the jobs as text and as pages, and machines in space for pages and the viewer.

Results of :mod:`legcal.calibration` or their documents become reports of tables and lines
(``render``), which a terminal and a page (``render.text_page``) show, or a page of their own.
"""
