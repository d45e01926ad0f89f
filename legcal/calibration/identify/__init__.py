"""What a session can identify: conditions (10)-(17), ranks, weak directions, remedies.

`predicted_observations` says what is observed, `information` what that determines, `ranks` judges
the joint fit by it, `remedies` says what to change, `identifiability` is the job, and `report` what
it returns.
"""
