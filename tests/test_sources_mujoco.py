"""MJCF means what MuJoCo makes of it: numbers of MuJoCo 4.0.0 for everything at once."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.machine.chain import ClosedChain
from legcal.machine.mjcf import MjcfTree, Values, closing_joints, read_bodies
from legcal.machine.tree import close_loop
from legcal.machine.urdf import Problems, parse_xml

MODEL = """
<mujoco model="feat">
<compiler inertiafromgeom="false" boundmass="1" boundinertia="1" eulerseq="zYx"/>
<default>
<joint pos="0.01 0.02 0.03"/>
<site quat="1 0 1 0"/>
<default class="a">
<joint type="slide" axis="1 2 3" range="-1 1"/>
<geom type="capsule" size="0.02"/>
<default class="b">
<joint ref="0.1" pos="0 0 0"/>
</default>
</default>
</default>
<worldbody>
<body name="b1" pos="0.1 0.2 0.3" euler="10 20 30" childclass="a">
  <joint name="s1"/>
<joint name="s2" class="b" axis="0 1 0"/>
<joint name="h1" type="hinge" axis="0 1 1" ref="25"
  range="-90 90"/>
  <geom name="g" fromto="0 0 0 0.1 0.2 0.3"/>
  <site name="si" pos="0.1 0 0" euler="5 6 7"/>
  <frame pos="0.2 0 0" axisangle="1 1 0 40">
   <body name="b2" childclass="main" xyaxes="1 1 0 -1 1 1">
<joint type="ball" name="ba" range="0 0" pos="0.05 0 0.1"/>
     <body name="b3" zaxis="1 0.2 -1" pos="0 0 1">
<joint name="h2" type="hinge"/>
<joint name="h3" type="hinge" axis="1 0 0" pos="0 0.1 0"/>
     <site name="sj" pos="0.1 0 0.2"/>
</body>
   </body>
  </frame>
</body>
<body name="f" pos="1 2 3" quat="1 2 3 4">
<freejoint name="fr"/>
<body name="g1" pos="0 1 0"/>
</body>
</worldbody>
<equality>
<weld name="w1" body1="b3"
  body2="g1" relpose="0.1 0.2 0.3 0.5 0.5 -0.5 0.5" anchor="0.3 0.1 0"/>
<weld name="w2" body1="b3" body2="g1" anchor="0.3 0.1 0"/>
<weld name="w3" site1="si" site2="sj"/>
<connect name="c1" body1="b3" body2="g1" anchor="0.3 0.1 0"/>
</equality>
<actuator>
<motor joint="s1"/>
</actuator>
</mujoco>
"""
Q = {
    "ba": [0.0718913495685425, -0.367111069122115, 0.247812463896765, 0.893672243903013],
    "fr": [
        -0.218791663932546,
        -1.24591094725307,
        -0.732267354703452,
        -0.465265005373339,
        -0.229163012321728,
        0.0151945675357946,
        -0.854857832435299,
    ],
    "h1": [0.628459108131567],
    "h2": [0.284124288938773],
    "h3": [-0.211120570742098],
    "s1": [0.037719066328018],
    "s2": [0.0603685410126094],
}
BODIES = {
    "b1": (
        [0.119598814798116, 0.168111168144417, 0.310940395320633],
        [0.923937580869504, 0.277550700496139, 0.234227446511457, 0.120176780668455],
    ),
    "b2": (
        [0.41532229195314, 0.345669572706594, 0.18430271017098],
        [-0.0481882363851647, 0.154916571578596, -0.663184401570638, 0.730660796291833],
    ),
    "b3": (
        [0.689465595645473, -0.594154202904379, 0.255888118345184],
        [0.488583467347866, -0.702542307863694, -0.383092160333826, 0.347794332597089],
    ),
    "f": (
        [-0.218791663932546, -1.24591094725307, -0.732267354703452],
        [-0.465265005373339, -0.229163012321728, 0.0151945675357946, -0.854857832435299],
    ),
    "g1": (
        [-1.0212265976703, -1.81250614703776, -0.545002684521855],
        [-0.465265005373339, -0.229163012321728, 0.0151945675357946, -0.854857832435299],
    ),
}  # position, quaternion (w, x, y, z)
SITES = {
    "si": (
        [0.205737823735893, 0.203320335316851, 0.274329117191605],
        [
            0.793371815752673,
            -0.0890908277637136,
            0.602182685219098,
            0.467584845064252,
            0.722597178621344,
            -0.5091342947737,
            -0.389776313589661,
            0.685504297475114,
            0.614945756557116,
        ],
    ),
    "sj": (
        [0.563316403788552, -0.422335890823197, 0.188324451871114],
        [
            0.863025458188714,
            0.198423779002384,
            0.464558997808215,
            -0.42002654901627,
            -0.229053184250198,
            0.878130022779274,
            0.280650595295365,
            -0.952975677922191,
            -0.114335474149973,
        ],
    ),
}  # position, matrix by rows
CLOSURES = [
    [1.75677637794938, 1.20646975356421, 0.374157696340504],
    [-1.13112862569292, 1.87338888662803, -2.95301261548816],
    [-0.357578580052659, 0.625656226140049, 0.0860046653204918],
    [-0.921864108133323, 1.04532912697968, 4.23744819493904],
]  # position of frame 1 less that of frame 2


def _tree() -> tuple[MjcfTree, ClosedChain, list[list[str]], Array]:
    path = Path("machine.xml")
    root = parse_xml(path, MODEL.strip().encode(), "MJCF file")
    problems = Problems(path)
    tree = read_bodies(root, Values(root, problems))
    pairs = [close_loop(loop, tree.text, tree.poses)[0] for loop in closing_joints(root, tree)]
    problems.raise_if_any()
    chain = ClosedChain(tree.text.robot("machine").decode(), [])
    q = chain.neutral()
    for name, values in Q.items():
        if len(values) == 1:
            q[chain.q_index(name)] = values[0]
        elif len(values) == 4:
            angles = Rotation.from_quat(np.roll(values, -1)).as_euler("XYZ")
            for letter, angle in zip("xyz", angles, strict=True):
                q[chain.q_index(f"{name}_{letter}")] = angle
        else:
            T = RigidTransform.from_components(
                values[:3], Rotation.from_quat(np.roll(values[3:], -1))
            )
            moved = tree.poses["f"].inv() * T
            at = chain.q_index(name)
            q[at : at + 7] = [*moved.translation, *moved.rotation.as_quat()]
    return tree, chain, pairs, q


def test_bodies_are_where_mujoco_has_them() -> None:
    _, chain, _, q = _tree()
    for name, (position, quaternion) in BODIES.items():
        T = chain.pose(q, "world", name)
        R = Rotation.from_quat(np.roll(quaternion, -1))
        assert np.abs(T.translation - position).max() < 1e-12
        assert np.abs(T.rotation.as_matrix() - R.as_matrix()).max() < 1e-12


def test_sites_are_where_mujoco_has_them() -> None:
    tree, chain, _, q = _tree()
    for name, (position, matrix) in SITES.items():
        body, T_body_site = tree.sites[name]
        T = chain.pose(q, "world", body) * T_body_site
        assert np.abs(T.translation - position).max() < 1e-12
        assert np.abs(T.rotation.as_matrix().ravel() - matrix).max() < 1e-12


def test_closures_hold_what_mujoco_holds() -> None:
    _, chain, pairs, q = _tree()
    for (one, two), off in zip(pairs, CLOSURES, strict=True):
        T_one, T_two = (chain.pose(q, "world", frame) for frame in (one, two))
        assert np.abs(T_one.translation - T_two.translation - off).max() < 1e-12
