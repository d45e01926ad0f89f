"""What a session can identify: conditions (10)-(17), ranks, weak directions, remedies.

`session` and `planning` say what is observed, `information` what that determines, `steps` and
`ranks` judge the four steps and the joint fit, `remedies` and `recommend` say what to change, and
`judge` is the job.
"""
