"""Base in the world and tool in the platform from measured tool poses.

`locate` is the job: read `tool_poses`, `search` from many starts, `fit` by maximum likelihood to
the inliers, `determinacy`, and the files in `document` and `urdf`; `frames` has the geometry.
"""
