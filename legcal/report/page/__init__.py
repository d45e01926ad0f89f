"""What the pages of the jobs say: sections and blocks of :mod:`legcal.pages`, made of results.

``calibration_page`` is the page of a calibration, ``text_page`` that of any job whose text says
all: ``writing`` renders them and writes the files.
"""
