"""The closed chain in Pinocchio: the URDF's tree, and anchors where loops close.

This is the one module that touches Pinocchio. Two of its traps are kept in here: the Jacobian
of an anchor is silently zero unless ``computeJointJacobians`` came first, and off the constraint
the frame anchor's Jacobian is that of the logarithm only after ``Jlog6(M) Ad(M)^-1``.

:func:`rigid_bodies` gives the rigid bodies and the joints between them, independent of the tree.
Links connected by fixed joints are one body, and so are two bodies welded by a ``6d`` closure.
The remaining connections are the movable joints of the tree and a spherical joint at each ``3d``
closure. The virtual platform joint carries nothing and is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import RigidTransform

from legcal.errors import ModelError
from legcal.geometry.motions import matrix_inverse, matrix_product, motion_of
from legcal.geometry.types import Array, IntArray
from legcal.machine.urdf import VIRTUAL, Urdf, UrdfJointType

ClosureKind = Literal["3d", "6d"]


@dataclass(frozen=True)
class Closure:
    """Two frames of the tree that coincide: their points (``3d``) or the whole frames (``6d``)."""

    kind: ClosureKind
    frames: tuple[str, str]

    @property
    def rows(self) -> int:
        """Number of equations."""
        return 3 if self.kind == "3d" else 6

    def __str__(self) -> str:
        return f"'{self.frames[0]}' and '{self.frames[1]}'"


class ClosedChain:
    """A tree of joints with loop closures.

    Configurations are Pinocchio's (quaternions for floating joints, cosine and sine for planar and
    continuous ones), velocities its tangent vectors. The object holds Pinocchio's work space, so
    that one object serves one thread; it pickles by being built again. *normals* holds, for each
    frame closure that need hold in a plane only, the normal of that plane in its first frame: where
    all joints move in the plane, rounding of their axes opens it across. *gains* of joints, by
    name, divide their values in configurations, as encoders read them.

    Raises ModelError if Pinocchio cannot build the model.
    """

    def __init__(
        self,
        text: str,
        closures: Sequence[Closure],
        normals: Sequence[Array | None] = (),
        gains: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self.text = text
        self.gains = {joint: gain for joint, gain in gains.items() if gain != 1.0}
        self.closures = tuple(closures)
        self.normals = tuple(normals) or (None,) * len(self.closures)
        self._in_plane = [None if n is None else _projector(n) for n in self.normals]
        try:
            self._model: Any = pin.buildModelFromXML(text)
        except (ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise ModelError(
                f"the URDF could not be built: found '{reason}' from Pinocchio, needed a tree that "
                "it reads; correct the URDF."
            ) from error
        self._data: Any = self._model.createData()
        self._frames: dict[str, int] = {}  # cached frame indices by name
        self._anchors = [self._anchor(closure) for closure in self.closures]
        self._anchor_data = [anchor.createData() for anchor in self._anchors]
        self.nq: int = self._model.nq
        self.nv: int = self._model.nv
        self.n_rows = sum(closure.rows for closure in self.closures)
        self._joints = {
            name: (int(joint.idx_q), int(joint.idx_v))
            for name, joint in zip(self._model.names, self._model.joints, strict=True)
        }
        self._of_value, self._of_rate = np.ones(self.nq), np.ones(self.nv)
        for joint, gain in self.gains.items():
            q, v = self._joints[joint]
            self._of_value[q] = self._of_rate[v] = gain
        # Last configurations evaluated in the work space of Pinocchio, as bytes.
        self._placed_at = self._linearized_at = b""
        self._linear = np.zeros(0), np.zeros((0, 0))  # last result of linearize

    @classmethod
    def of(
        cls,
        urdf: Urdf,
        closures: Sequence[Closure],
        normals: Sequence[Array | None] = (),
        gains: Mapping[str, float] = MappingProxyType({}),
    ) -> "ClosedChain":
        """Return the closed chain of a URDF, which errors name."""
        try:
            return cls(urdf.text, closures, normals, gains)
        except ModelError as error:
            raise error.map_problems(lambda problem: problem.in_file(urdf.path)) from error

    def __reduce__(self) -> tuple[type["ClosedChain"], tuple[object, ...]]:
        return ClosedChain, (self.text, self.closures, self.normals, self.gains)

    def neutral(self) -> Array:
        """Return the configuration with every joint at zero."""
        return np.array(pin.neutral(self._model))

    def integrate(self, configuration: Array, step: Array) -> Array:
        """Return the configuration after a step in the tangent space."""
        return np.asarray(pin.integrate(self._model, configuration, step))

    def residual(self, configuration: Array) -> Array:
        """Return the residuals of all closures, (n_rows,) [m] and [rad].

        Components across a plane of motion count here, in contrast to :meth:`linearize`.
        """
        self._place(configuration)
        pieces = []
        for anchor, data in zip(self._anchors, self._anchor_data, strict=True):
            anchor.calc(self._model, self._data, data)
            pieces.append(data.constraint_position_error)
        return np.concatenate(pieces) if pieces else np.zeros(0)

    def linearize(self, configuration: Array) -> tuple[Array, Array]:
        """Return the residual (n_rows,) of the closures and its exact Jacobian (n_rows, nv).

        Three rows [m] for a point, six [m, rad] for a frame, in the order of the closures.
        """
        model, data, here = self._model, self._data, configuration.tobytes()
        if here == self._linearized_at == self._placed_at:
            return self._linear
        pin.computeJointJacobians(model, data, self._of_value * configuration)
        residual, jacobian = np.empty(self.n_rows), np.empty((self.n_rows, self.nv))
        row = 0
        for closure, anchor, anchor_data, in_plane in zip(
            self.closures, self._anchors, self._anchor_data, self._in_plane, strict=True
        ):
            anchor.calc(model, data, anchor_data)
            rows = slice(row, row + closure.rows)
            residual[rows] = anchor_data.constraint_position_error
            block = anchor.jacobian(model, data, anchor_data)
            if closure.kind == "6d":
                M = anchor_data.c1Mc2
                block = pin.Jlog6(M) @ M.inverse().action @ block
            if in_plane is not None:
                residual[rows], block = in_plane @ residual[rows], in_plane @ block
            jacobian[rows] = block * self._of_rate
            row = rows.stop
        residual.flags.writeable = jacobian.flags.writeable = False
        self._placed_at, self._linearized_at, self._linear = here, here, (residual, jacobian)
        return residual, jacobian

    def placement(self, configuration: Array, base: str, frame: str) -> tuple[Array, Array]:
        """Return rotation (3, 3) and translation (3,) [m] of a frame in another at a configuration.

        Like :meth:`pose`, as arrays: faster, for inner loops.
        """
        self._place(configuration)
        M = self._placement(base).actInv(self._placement(frame))
        return M.rotation, M.translation

    def turns(self, configuration: Array, base: str, frames: Sequence[str]) -> Array:
        """Return the rotations (n, 3, 3) of frames in another one at a configuration."""
        self._place(configuration)
        R = self._placement(base).rotation.T
        return np.array([R @ self._placement(frame).rotation for frame in frames])

    def pose(self, configuration: Array, base: str, frame: str) -> RigidTransform:
        """Return T_base_frame between two frames at a configuration."""
        return motion_of(*self.placement(configuration, base, frame))

    def welded(self, base: str, frame: str, T_base_frame: RigidTransform) -> tuple[Array, Array]:
        """Return residual (6,) [m, rad] and Jacobian (6, nv) of holding a frame at a pose.

        Both hold at the last linearisation; the residual is the logarithm of the remaining motion.
        """
        M = self._placement(base).actInv(self._placement(frame))
        matrix = T_base_frame.as_matrix()
        error = pin.SE3(matrix[:3, :3], matrix[:3, 3]).actInv(M)
        jacobian = pin.Jlog6(error) @ self.twist(base, frame)
        return np.array(pin.log6(error).vector), np.asarray(jacobian)

    def twist(self, base: str, frame: str) -> Array:
        """Return the Jacobian (6, nv) of the motion of a frame in another: displacement, rotation.

        It holds at the last linearisation and is expressed in ``frame``.
        """
        M = self._placement(base).actInv(self._placement(frame))
        J_frame, J_base = (
            pin.getFrameJacobian(self._model, self._data, self._frame(name), pin.LOCAL)
            for name in (frame, base)
        )
        return np.asarray((J_frame - M.inverse().action @ J_base) * self._of_rate)

    def q_index(self, joint: str) -> int:
        """Return the index of the value of a joint in a configuration."""
        return self._joints[joint][0]

    def v_index(self, joint: str) -> int:
        """Return the index of the rate of a joint in a tangent vector."""
        return self._joints[joint][1]

    def rotation_columns(self) -> IntArray:
        """Return the indices of the tangent coordinates that are angles."""
        columns: list[int] = []
        for joint in list(self._model.joints)[1:]:  # the first is the universe
            name, start, size = joint.shortname(), int(joint.idx_v), int(joint.nv)
            if "Free" in name:
                columns += range(start + 3, start + 6)
            elif "Planar" in name:
                columns.append(start + 2)
            elif "R" in name.removeprefix("JointModel")[:1] and size == 1:
                columns.append(start)
        return np.array(columns, dtype=np.intp)

    def row_weights(self, metre: float) -> Array:
        """Return the weights (n_rows,) that make residuals dimensionless: lengths in *metre*."""
        weights = [[1.0 / metre] * 3 + [1.0] * (closure.rows - 3) for closure in self.closures]
        return np.concatenate([*weights, np.zeros(0)])

    def column_units(self, metre: float) -> Array:
        """Return the units (nv,) of dimensionless tangent steps: *metre* [m], and 1 for angles."""
        units = np.full(self.nv, metre)
        units[self.rotation_columns()] = 1.0
        return units

    def with_platform(
        self,
        configuration: Array,
        joint: str,
        base: str,
        platform: str,
        T_base_platform: RigidTransform,
    ) -> Array:
        """Return the configuration with the virtual joint that carries the platform set.

        A planar joint takes the component of the motion in its plane.
        """
        self._place(configuration)
        index = self._model.getJointId(joint)
        before = self._data.oMi[self._model.parents[index]] * self._model.jointPlacements[index]
        after = self._data.oMi[index].actInv(self._placement(platform))
        matrix = T_base_platform.as_matrix()
        wanted = self._placement(base) * pin.SE3(matrix[:3, :3], matrix[:3, 3]) * after.inverse()
        motion = before.actInv(wanted)
        placed = configuration.copy()
        start = self.q_index(joint)
        if self._model.joints[index].nv == 3:
            angle = np.arctan2(
                motion.rotation[1, 0] - motion.rotation[0, 1],
                motion.rotation[0, 0] + motion.rotation[1, 1],
            )
            x, y = motion.translation[:2]
            placed[start : start + 4] = (x, y, np.cos(angle), np.sin(angle))
        else:
            placed[start : start + 7] = pin.SE3ToXYZQUAT(motion)
        return placed

    def _place(self, configuration: Array) -> None:
        """Place all joints, unless the configuration is the last one."""
        here = configuration.tobytes()
        if here != self._placed_at:
            pin.forwardKinematics(self._model, self._data, self._of_value * configuration)
            self._placed_at = here

    def _frame(self, name: str) -> int:
        """Return the index of the frame of a link, or of a joint if no link has the name."""
        if name in self._frames:
            return self._frames[name]
        if self._model.existBodyName(name):
            self._frames[name] = int(self._model.getFrameId(name, pin.BODY))
        elif self._model.existFrame(name):
            self._frames[name] = int(self._model.getFrameId(name))
        else:
            raise ModelError(
                f"the frame '{name}' could not be found: the URDF has no link or joint of that "
                "name, needed one; correct closed_loop."
            )
        return self._frames[name]

    def _placement(self, name: str) -> Any:
        """Return the placement of a frame in the world, as of the last kinematics."""
        frame = self._model.frames[self._frame(name)]
        return self._data.oMi[frame.parentJoint] * frame.placement

    def _anchor(self, closure: Closure) -> Any:
        """Return Pinocchio's constraint for a closure."""
        first, second = (self._model.frames[self._frame(name)] for name in closure.frames)
        make = (
            pin.PointAnchorConstraintModel
            if closure.kind == "3d"
            else pin.FrameAnchorConstraintModel
        )
        return make(
            self._model, first.parentJoint, first.placement, second.parentJoint, second.placement
        )


def _projector(normal: Array) -> Array:
    """Return the projection (6, 6) onto displacements in a plane and rotations about its normal."""
    projector = np.zeros((6, 6))
    projector[3:, 3:] = np.outer(normal, normal)
    projector[:3, :3] = np.eye(3) - projector[3:, 3:]
    return projector


@dataclass(frozen=True, eq=False)
class Connection:
    """A joint between two bodies, one of the tree or a ``3d`` closure, passed in one direction."""

    type: UrdfJointType | Literal["sphere"]
    bodies: tuple[str, str]  # near and far, named by one of their links
    T_body_joint: tuple[Array, Array]  # (4, 4) each
    axis: Array | None  # (3,) unit axis in the joint frame; None for a sphere
    joint: str | None  # the URDF joint; None for a closure
    closure: int | None  # the index of the closure; None for a joint of the tree
    is_forward: bool = True  # from parent to child: the joint moves the far body in the near one

    @property
    def name(self) -> str:
        """The joint, in words."""
        return self.joint or "the 3d closure"

    @property
    def is_virtual(self) -> bool:
        """Whether it can only say where the platform is, as no joint of a leg."""
        return self.type in VIRTUAL

    def line(self, side: int) -> tuple[Array, Array]:
        """Return a point [m] and the direction of the axis in the near (0) or far body (1)."""
        matrix = self.T_body_joint[side]
        return matrix[:3, 3], matrix[:3, :3] @ (np.zeros(3) if self.axis is None else self.axis)

    def from_body(self, body: str) -> "Connection":
        """Return the joint passed from one of its bodies to the other."""
        if self.bodies[0] == body:
            return self
        return replace(
            self,
            bodies=self.bodies[::-1],
            T_body_joint=self.T_body_joint[::-1],
            is_forward=not self.is_forward,
        )


@dataclass(frozen=True, eq=False)
class Bodies:
    """The bodies and connections of a mechanism."""

    body_of: dict[str, str]  # body of every link
    T_body_link: dict[str, Array]  # (4, 4)
    connections: tuple[Connection, ...]  # without the virtual platform joint


def rigid_bodies(urdf: Urdf, closures: Sequence[Closure], platform_joint: str | None) -> Bodies:
    """Return the bodies of a tree with closures, and the joints between them.

    Raises ModelError if a weld closes a loop of bodies that are rigid already.
    """
    body_of = {link: link for link in urdf.links}
    T_body_link = {link: np.eye(4) for link in urdf.links}
    for joint in urdf.joints.values():
        if not joint.moves:
            T = joint.T_parent_origin.as_matrix()
            _merge(body_of, T_body_link, joint.parent, joint.child, T)
    for closure in closures:
        if closure.kind == "6d":
            first, second = map(urdf.link_of, closure.frames)
            if body_of[first] == body_of[second]:
                raise ModelError(
                    f"the 6d closure of {closure} could not be used",
                    "both on one rigid body",
                    "two",
                    "remove it",
                    urdf.path,
                )
            _merge(body_of, T_body_link, first, second, np.eye(4))
    tree = [
        Connection(
            "revolute" if joint.type == "continuous" else joint.type,
            (body_of[joint.parent], body_of[joint.child]),
            (
                matrix_product(T_body_link[joint.parent], joint.T_parent_origin.as_matrix()),
                T_body_link[joint.child],
            ),
            joint.axis,
            joint.name,
            None,
        )
        for joint in urdf.joints.values()
        if joint.moves and joint.name != platform_joint
    ]
    spheres = []
    for i, closure in enumerate(closures):
        if closure.kind == "3d":
            first, second = map(urdf.link_of, closure.frames)
            bodies, poses = (
                (body_of[first], body_of[second]),
                (T_body_link[first], T_body_link[second]),
            )
            spheres.append(Connection("sphere", bodies, poses, None, None, i))
    return Bodies(body_of, T_body_link, (*tree, *spheres))


def _merge(
    body_of: dict[str, str],
    T_body_link: dict[str, Array],
    keep: str,
    join: str,
    T_keep_join: Array,
) -> None:
    into, gone = body_of[keep], body_of[join]
    T_into_gone = matrix_product(T_body_link[keep], T_keep_join, matrix_inverse(T_body_link[join]))
    for link, body in body_of.items():
        if body == gone:
            body_of[link] = into
            T_body_link[link] = matrix_product(T_into_gone, T_body_link[link])
