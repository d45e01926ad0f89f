"""The contents of the pages of the jobs: sections and blocks of :mod:`legcal.pages`.

``calibration_page`` is the page of a calibration, ``text_page`` the page of other jobs, made from
their text; ``writing`` renders them and writes the files.
"""
