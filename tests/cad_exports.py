"""A 6-RSS head as CAD exports it: on a yaw joint, with an antenna, closing frames and meshes only.

The rods are 90 mm between their balls, with a shaft of 6 mm diameter between two eyes, and a collar
nearer to one end. All motors stand at zero in the drawing.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
from layouts import numbers, origin
from scipy.spatial.transform import RigidTransform, Rotation

LENGTH, RADIUS, ARM = 0.090, 0.003, 0.035
SHAFT = 0.008, 0.082  # ends of the round part of a rod, without its eyes
COLLAR = 0.015, 0.019  # outside of which the shaft goes on
TURNED = RigidTransform.from_rotation(Rotation.from_euler("xyz", [0.4, -0.9, 1.3]))  # a CAD frame
YAW = RigidTransform.from_translation([0.0, 0.0, 0.03])


def rod() -> trimesh.Trimesh:
    """Return the mesh of a rod along x, from one ball to the other."""
    eye, collar = SHAFT, COLLAR
    profile = [
        *((0.0, eye[0]), (RADIUS, eye[0]), (RADIUS, collar[0]), (0.005, collar[0])),
        *((0.005, collar[1]), (RADIUS, collar[1]), (RADIUS, eye[1]), (0.0, eye[1])),
    ]
    shaft = trimesh.creation.revolve(np.array(profile), sections=48)
    eyes = [trimesh.creation.box(extents=(0.014, 0.006, 0.016)) for _ in range(2)]
    eyes[1].apply_translation([0.0, 0.0, LENGTH])
    whole = trimesh.util.concatenate([shaft, *eyes])
    assert isinstance(whole, trimesh.Trimesh)
    turn = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    whole.apply_transform(turn)  # z to x
    return whole


def horns() -> list[tuple[RigidTransform, np.ndarray, np.ndarray]]:
    """Return for each leg T_base_horn (turning about z), and A and B in the base [m]."""
    legs = []
    for k in range(6):
        sector, side = k // 2, 1.0 if k % 2 else -1.0
        turn = Rotation.from_euler("z", 120.0 * sector, degrees=True)
        # The axis of a horn is tangential, its arm points outwards.
        columns = np.column_stack([turn.apply(v) for v in ([1, 0, 0], [0, 0, 1], [0, -1, 0])])
        T = RigidTransform.from_components(
            turn.apply([0.04, 0.012 * side, 0.05]), Rotation.from_matrix(columns)
        )
        A = T.apply([ARM, 0.0, 0.0])
        B = turn.apply([0.045, 0.026 * side, 0.0])
        B[2] = A[2] + np.sqrt(LENGTH**2 - np.sum((B - A)[:2] ** 2))
        legs.append((T, A, B))
    return legs


def rod_pose(A: np.ndarray, B: np.ndarray) -> RigidTransform:
    """Return the frame of a rod at A with x towards B."""
    x = (B - A) / np.linalg.norm(B - A)
    y = np.cross([0.0, 0.0, 1.0], x) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], x))
    return RigidTransform.from_components(
        A, Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)]))
    )


def write_head_urdf(folder: Path, *, mesh: bool = True) -> Path:
    """Write ``head.urdf`` and the mesh of its rods, and return its path."""
    lines = ['<robot name="head">', '<link name="foot"/>', '<link name="body"/>']
    lines += ['<link name="dummy"><visual><geometry><box size="0 0 0"/></geometry></visual></link>']

    def joint(name: str, kind: str, ends: tuple[str, str], T: RigidTransform, axis: str) -> None:
        limit = '<limit effort="1" velocity="1" lower="-1.2" upper="1.2"/>'
        lines.append(
            f'<joint name="{name}" type="{kind}">{origin(T)}<parent link="{ends[0]}"/>'
            f'<child link="{ends[1]}"/><axis xyz="{axis}"/>{limit}</joint>'
        )

    def ball(name: str, ends: tuple[str, str], T: RigidTransform) -> None:
        links = [ends[0], f"{name}_x_link", f"{name}_y_link", ends[1]]
        lines.extend(f'<link name="{link}"/>' for link in links[1:3])
        for letter, axis, pair in zip(
            "xyz", ("1 0 0", "0 1 0", "0 0 1"), pairwise(links), strict=True
        ):
            joint(f"{name}_{letter}", "revolute", pair, T, axis)
            T = RigidTransform.identity()

    joint("dummy_frame", "fixed", ("body", "dummy"), RigidTransform.identity(), "0 0 0")
    joint("yaw", "revolute", ("foot", "body"), YAW, "0 0 1")
    legs = horns()
    T_base_head = RigidTransform.from_translation(legs[5][2]) * TURNED
    for k, (T_base_horn, A, B) in enumerate(legs, start=1):
        T_base_rod = rod_pose(A, B)
        lines += [f'<link name="horn_{k}"/>', f'<link name="rod_{k}"><visual><geometry><mesh '
                  'filename="package://assets/rod.stl"/></geometry></visual></link>']  # fmt: skip
        joint(f"servo_{k}", "revolute", ("body", f"horn_{k}"), T_base_horn, "0 0 1")
        ball(f"passive_{k}", (f"horn_{k}", f"rod_{k}"), T_base_horn.inv() * T_base_rod)
        if k == 6:
            lines.append('<link name="head"/>')
            ball("passive_7", ("rod_6", "head"), T_base_rod.inv() * T_base_head)
            continue
        for number, (link, T) in enumerate(
            ((f"rod_{k}", T_base_rod), ("head", T_base_head)), start=1
        ):
            frame, at = f"closing_{k}_{number}", RigidTransform.from_translation(B)
            lines.append(f'<link name="{frame}"/>')
            joint(f"{frame}_frame", "fixed", (link, frame), T.inv() * at, "0 0 0")
    lines.append('<link name="feeler"/>')
    joint("antenna", "revolute", ("head", "feeler"), YAW, "1 0 0")
    folder.mkdir(parents=True, exist_ok=True)
    if mesh:
        (folder / "assets").mkdir(exist_ok=True)
        rod().export(folder / "assets" / "rod.stl")
    path = folder / "head.urdf"
    path.write_text("\n".join([*lines, "</robot>"]))
    return path


def write_head_mjcf(folder: Path) -> Path:
    """Write the same as ``head.xml``."""
    legs = horns()
    T_base_head = RigidTransform.from_translation(legs[5][2]) * TURNED

    def place(T: RigidTransform) -> str:
        quat = np.roll(T.rotation.as_quat(), 1)
        return f'pos="{numbers(T.translation)}" quat="{numbers(quat)}"'

    bodies, ties = [], []
    for k, (T_base_horn, A, B) in enumerate(legs, start=1):
        T_base_rod = rod_pose(A, B)
        head = ""
        if k == 6:
            sites = "".join(
                f'<site name="seat_{j}" pos="{numbers(T_base_head.inv().apply(legs[j - 1][2]))}"/>'
                for j in range(1, 6)
            )
            head = (
                f'<body name="head" {place(T_base_rod.inv() * T_base_head)}><joint type="ball"/>'
                f'{sites}<body name="feeler" pos="0 0 0.03"><joint name="antenna" axis="1 0 0"/>'
                "</body></body>"
            )
        else:
            ties.append(f'<connect site1="end_{k}" site2="seat_{k}"/>')
        bodies.append(
            f'<body name="horn_{k}" {place(T_base_horn)}><joint name="servo_{k}" axis="0 0 1" '
            f'range="-1.2 1.2"/><body name="rod_{k}" {place(T_base_horn.inv() * T_base_rod)}>'
            f'<joint type="ball"/><geom type="mesh" mesh="rod" group="2"/>'
            f'<site name="end_{k}" pos="{numbers([LENGTH, 0.0, 0.0])}"/>{head}</body></body>'
        )
    motors = "".join(
        f'<position joint="{name}"/>'
        for name in ("yaw", *(f"servo_{k}" for k in range(1, 7)), "antenna")
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "assets").mkdir(exist_ok=True)
    rod().export(folder / "assets" / "rod.stl")
    path = folder / "head.xml"
    path.write_text(
        '<mujoco model="head"><compiler angle="radian" meshdir="assets"/>'
        '<asset><mesh file="rod.stl"/></asset><worldbody><body name="foot"><body name="body" '
        f'pos="0 0 0.03"><joint name="yaw" axis="0 0 1"/>{"".join(bodies)}</body></body>'
        f"</worldbody><equality>{''.join(ties)}</equality><actuator>{motors}</actuator></mujoco>"
    )
    return path


# An ankle of a humanoid: a foot on a universal joint, moved by two cranks and rods (2-RSS + U)

ROD = 0.18
CRANK = 0.04  # from the axis of its motor to the ball [m]
PIN = np.array([-0.045, 0.03, 0.0])  # ball of the left rod on the foot, behind the joint [m]
# Each crank turns about the y axis of the shin, above the ball on the foot, and points backwards.
MOTOR = np.array([PIN[0] + CRANK, 0.03, ROD])


def write_ankle(folder: Path) -> Path:
    """Write ``ankle.urdf`` with the loops of an export, and return its path."""
    limit = '<limit effort="1" velocity="1" lower="{}" upper="{}"/>'
    lines = ['<robot name="ankle">', '<link name="pelvis"/><link name="shin"/>']

    def joint(name: str, kind: str, ends: str, at: np.ndarray, axis: str, reach: float) -> None:
        parent, child = ends.split()
        lines.append(
            f'<link name="{child}"/>'
            * (child != "shin")
            + f'<joint name="{name}" type="{kind}"><origin xyz="{numbers(at)}" rpy="0 0 0"/>'
            f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
            f"{limit.format(-reach, reach)}</joint>"
        )

    zero = np.zeros(3)
    joint("knee", "revolute", "pelvis shin", np.array([0.0, 0.0, 0.6]), "0 1 0", 1.0)
    joint("pitch", "revolute", "shin cross", zero, "0 1 0", 0.6)
    joint("roll", "revolute", "cross foot", zero, "1 0 0", 0.4)
    for name, side in (("left", 1.0), ("right", -1.0)):
        mirror = np.array([1.0, side, 1.0])
        joint(f"{name}_motor", "revolute", f"shin {name}_crank", MOTOR * mirror, "0 1 0", 0.8)
        at = np.array([-CRANK, 0.0, 0.0])
        for axis, links in zip(
            ("1 0 0", "0 1 0", "0 0 1"),
            (f"{name}_crank {name}_1", f"{name}_1 {name}_2", f"{name}_2 {name}_rod"),
            strict=True,
        ):
            joint(f"{name}_ball_{axis.index('1') // 2}", "revolute", links, at, axis, 3.0)
            at = zero
        lines[-1] = lines[-1].replace(
            f'<link name="{name}_rod"/>',
            f'<link name="{name}_rod"><visual><origin xyz="0 0 {-ROD / 2}"/><geometry><cylinder '
            f'radius="0.004" length="{0.8 * ROD}"/></geometry></visual></link>',
        )
        end = np.array([0.0, 0.0, -ROD])
        joint(f"{name}_end", "fixed", f"{name}_rod closing_{name}_1", end, "0 0 1", 0.0)
        joint(f"{name}_seat", "fixed", f"foot closing_{name}_2", PIN * mirror, "0 0 1", 0.0)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "ankle.urdf"
    path.write_text("\n".join([*lines, "</robot>"]))
    return path
