"""What commands, files and the documented Python API give: recorded once, compared ever after.

Nothing here imports a module of the package but ``legcal`` itself and ``legcal.cli``, so that the
suite outlives every change of what is inside.

=====================  ==================================================================
``running``            one command line in this process: exit code, output, document
``inputs``             datasets and files that several cases start from, made once
``cases``              the command lines, by name, and the files that they leave
``refusals``           what must be refused: input, command, and the words that are named
``facts``              what of a document or a folder is recorded: no sentences, no times
``comparison``         when two of them agree: counts exactly, parameters within their sigmas
``record``             ``python -m characterisation.record`` writes ``expected/*.json``
=====================  ==================================================================

``LEGCAL_CHARACTERISATION_SIGMAS`` is how far parameters may be apart, in their own standard
deviations: 0.02 without it, since processors round differently; 1e-6 for two versions on one.
"""
