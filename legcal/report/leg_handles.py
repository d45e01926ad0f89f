"""Which origin of a URDF moves one joint of a leg in the body that carries it, and nothing else.

A joint that hangs from the body moves with its own origin. One that the body hangs from, or is
closed on, moves with the fixed joint between them: that under a closure's frame, or the one
that leads from the leg on to the body.
"""

from typing import NamedTuple

from legcal.errors import OutOfClass
from legcal.mechanism.axes import Step
from legcal.mechanism.bodies import Bodies, frame_link, rigid_bodies
from legcal.mechanism.model import Mechanism
from legcal.mechanism.urdf import UrdfJoint


class Handle(NamedTuple):
    """The joint of the URDF whose origin is moved.

    Attributes
    ----------
    joint : UrdfJoint
        The joint.
    is_inverse : bool
        Whether its origin moves the body against the leg's joint, and not this in the body.
    """

    joint: UrdfJoint
    is_inverse: bool


class Handles:
    """What moves the joints of legs in the bodies of a mechanism.

    Parameters
    ----------
    mechanism : Mechanism
        The mechanism, as loaded.

    Attributes
    ----------
    bodies : Bodies
        Links that fixed joints and welds hold together.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism
        self._urdf = mechanism.urdf
        self._closures = mechanism.chain.closures
        self._fixed = rigid_bodies(self._urdf, (), mechanism.platform_joint)
        self.bodies: Bodies = rigid_bodies(self._urdf, self._closures, mechanism.platform_joint)
        self._above = {joint.child: joint for joint in self._urdf.joints.values()}

    def of(self, step: Step, side: int, body: str, leg: str) -> Handle:
        """Return what moves a joint in a body.

        Parameters
        ----------
        step : Step
            The joint of the leg.
        side : int
            Its side in the body.
        body : str
            The link that stands for the body.
        leg : str
            The leg, for messages.

        Raises
        ------
        OutOfClass
            If no origin moves this joint alone.
        """
        connection = step.connection
        if connection.closure is not None:
            closure = self._closures[connection.closure]
            return Handle(self._carrier((closure.frame_1, closure.frame_2)[side], leg), False)
        joint = self._urdf.joints[str(connection.joint)]
        if side == 0:
            return Handle(joint, False)
        if self._fixed.body_of[joint.child] == self._fixed.body_of[body]:
            return Handle(self._onward(joint, body, leg), True)
        return self._weld(joint, body, leg)

    def link(self, step: Step, side: int) -> str:
        """Return the link that carries one side of a joint."""
        connection = step.connection
        if connection.closure is not None:
            closure = self._closures[connection.closure]
            return frame_link(self._urdf, (closure.frame_1, closure.frame_2)[side])
        joint = self._urdf.joints[str(connection.joint)]
        return (joint.parent, joint.child)[side]

    def _onward(self, joint: UrdfJoint, body: str, leg: str) -> UrdfJoint:
        """Return the fixed joint that leads from the child of a joint to the rest of its body."""
        link, onward = body, None
        while link != joint.child and link in self._above:
            onward = self._above[link]
            link = onward.parent
        if link == joint.child and onward is not None and self._carries_only(link, onward):
            return onward
        raise OutOfClass(
            f"{self._mechanism.urdf_path}: leg '{leg}' could not be written: found that joint "
            f"'{joint.name}' carries the link '{body}' itself, needed legs that hang from base or "
            "platform, or are closed on them; let a virtual floating joint carry the platform, or "
            "put a link on a fixed joint between them."
        )

    def _weld(self, joint: UrdfJoint, body: str, leg: str) -> Handle:
        """Return the fixed joint under a frame of the closure that welds a leg to a body."""
        ours, theirs = self._fixed.body_of[body], self._fixed.body_of[joint.child]
        problem: OutOfClass | None = None
        for closure in self._closures:
            frames = closure.frame_1, closure.frame_2
            on = [self._fixed.body_of[frame_link(self._urdf, frame)] for frame in frames]
            if closure.kind == "6d" and set(on) == {ours, theirs}:
                for wanted in (ours, theirs):
                    try:
                        carrier = self._carrier(frames[on.index(wanted)], leg)
                    except OutOfClass as error:
                        problem = problem or error
                        continue
                    return Handle(carrier, wanted == theirs)
        if problem is not None:
            raise problem
        raise OutOfClass(
            f"{self._mechanism.urdf_path}: leg '{leg}' could not be written: found several welds "
            f"between joint '{joint.name}' and the link '{body}', needed one; close the leg once."
        )

    def _carrier(self, frame: str, leg: str) -> UrdfJoint:
        """Return the fixed joint under a closure's frame, which must carry nothing else."""
        link = frame_link(self._urdf, frame)
        above = self._above.get(link)
        if above is not None and not above.moves and self._carries_only(link, None, closures=1):
            return above
        raise OutOfClass(
            f"{self._mechanism.urdf_path}: leg '{leg}' could not be written: found the closure "
            f"frame '{frame}' on a link that carries other things too, needed a link of its own on "
            "a fixed joint; add one at the joint centre."
        )

    def _carries_only(self, link: str, below: UrdfJoint | None, closures: int = 0) -> bool:
        """Say whether a link carries one joint or none, and so many frames of closures."""
        found = [joint for joint in self._urdf.joints.values() if joint.parent == link]
        frames = [f for c in self._closures for f in (c.frame_1, c.frame_2)]
        uses = sum(frame_link(self._urdf, frame) == link for frame in frames)
        return found == ([] if below is None else [below]) and uses == closures
