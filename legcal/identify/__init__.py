"""What a calibration can find out: the paper's counts, and the ranks that decide.

``analysis.identifiability`` is the one verb: conditions (10)-(12), (15), (17) as printed, the
rank of each of the four steps, the rank of everything at once, what would mend what is missing.
"""
