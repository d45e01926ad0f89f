"""What a session can identify: conditions (10)-(17), ranks, weak directions, remedies.

`session` has images and poses before a fit, `ranks` judges the information of the joint fit at
them, `remedies` says what to change, `identifiability` is the job, and `report` what it returns.
"""
