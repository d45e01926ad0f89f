"""What a session can identify: conditions (10)-(17), ranks, weak directions, remedies.

`session` has images and poses before a fit, `identifiability` judges the information of the joint
fit at them and says what to change, and `report` is what it returns.
"""
