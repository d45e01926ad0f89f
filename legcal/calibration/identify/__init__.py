"""What a session can identify: conditions (10)-(17), ranks, weak directions, remedies.

`predicted_observations` says what is observed, `information` what that determines, `steps` and
`ranks` judge the four steps and the joint fit, `remedies` says what to change, `identifiability` is
the job, and `report` what it returns.
"""
