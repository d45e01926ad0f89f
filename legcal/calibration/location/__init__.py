"""Base in the world and tool in the platform from measured tool poses.

`locate` is the job: `search` from many starts, `fit` by maximum likelihood, `agreement` of rows,
`open` directions, `judgement`, and the files in `document` and `urdf`.
"""
