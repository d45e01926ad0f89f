"""Simulated measurements of machines with known truth (section 4.3), and studies on them.

In: a model, :class:`SimulationSettings` or the options of the command line. Out: the folder of a
:class:`SimulatedDataset` with the truth beside it; the 6-SPU of section 4.3 and its sessions in
memory; for studies, records of many runs. This package may import all others except report and
command line, and only the command line and benchmarks import it, so that the method cannot see the
truth.
"""
