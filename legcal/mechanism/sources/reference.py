"""Where the links of a tree are when all of its joint values are zero."""

from scipy.spatial.transform import RigidTransform

from legcal.mechanism.urdf import Urdf


def reference_poses(urdf: Urdf) -> dict[str, RigidTransform]:
    """Return the pose of every link in the root link, all joint values zero."""
    children: dict[str, list[str]] = {}
    for joint in urdf.joints.values():
        children.setdefault(joint.parent, []).append(joint.name)
    poses = {urdf.root: RigidTransform.identity()}
    pending = [urdf.root]
    while pending:
        link = pending.pop()
        for name in children.get(link, ()):
            joint = urdf.joints[name]
            poses[joint.child] = poses[link] * joint.T_parent_origin
            pending.append(joint.child)
    return poses
