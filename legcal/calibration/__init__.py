"""The jobs: calibrate, check, detect, identify, locate.

The input is a :class:`legcal.data.dataset.Dataset`. ``calibrate`` (``pipeline``) checks
identifiability (``identify``), puts the dataset into canonical order (``ordered_dataset``),
recognises and measures the legs, runs the four steps (``four_steps``) and the joint fit
(``joint_fit``), measures again (sections 3.1 to 3.5), judges the accuracy of the platform
(``verdict``) and writes the result (``result_folder``). The output is a :class:`Calibration` and
its document :class:`Result`, which ``check`` (``verification``) reads back.
``doctor`` and ``detect`` (``doctor``, ``detection``) and ``check`` use the same phases;
``evaluate`` (eq 20), ``calibrate_camera`` and ``locate`` are independent. The output of ``--json``
is a document model for each job.
"""
