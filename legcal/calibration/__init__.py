"""The jobs, each a client of the rooms below: calibrate, check, detect, identify, locate.

A :class:`legcal.data.dataset.Dataset` goes in. ``calibrate`` (``pipeline``) checks that it can be
identified (``identify``), puts it into canonical order (``ordered_dataset``), recognises and
measures the legs, runs the four steps (``four_steps``) and the joint fit (``joint_fit``) and
measures again (sections 3.1 to 3.5), judges what the platform gains (``verdict``) and writes the
result (``result_folder``): out comes a :class:`Calibration`, and its document :class:`Result`,
which ``check`` (``verification``, ``change_detection``) reads back. ``doctor`` and ``detect``
(``doctor``, ``examination``) and ``check`` enter through the same phases. Beside them stand
``evaluate`` (eq 20), ``calibrate_camera`` and ``locate``. What ``--json`` prints is a model for
each job.
"""
