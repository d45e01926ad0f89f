"""What a session can identify: conditions (10)-(17), ranks, weak directions, remedies.

`predicted_observations` predicts the observations of a session, `information` linearises the joint
fit at them, `steps` and `ranks` test the four steps and the joint fit, `remedies` proposes changes,
`identifiability` is the job, and `report` its result.
"""
