"""Loading a mechanism: files, tree, closures, legs and home, each checked before the next."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import ModelError
from legcal.mechanism import agreement
from legcal.mechanism.bodies import Bodies, rigid_bodies
from legcal.mechanism.chain import ClosedChain, Closure
from legcal.mechanism.closing import close_at
from legcal.mechanism.cylinders import with_cylinders
from legcal.mechanism.home import find_home, settle_home
from legcal.mechanism.leg import Leg, LegKind
from legcal.mechanism.mobility import mobility
from legcal.mechanism.model import Mechanism
from legcal.mechanism.notes import diagnose
from legcal.mechanism.schema import MechanismFile
from legcal.mechanism.sources.read import read_source
from legcal.mechanism.topology import LegChain, find_chains
from legcal.mechanism.urdf import Urdf


def load_mechanism(model: str | Path) -> Mechanism:
    """Return the mechanism of a file, its legs found from geometry.

    Parameters
    ----------
    model : str or Path
        A mechanism YAML, a URDF with its YAML beside it (or in ``../models``), or the name of
        a shipped model.

    Raises
    ------
    ModelError
        If a file is missing, malformed or contradicts itself; all problems of a file at once.
    OutOfClass
        If the mechanism is not one that the method covers.
    """
    source = read_source(model)
    yaml_path, file, urdf = source.path, source.file, source.urdf
    agreement.check_names(file, urdf, yaml_path)
    agreement.check_class(file, urdf, yaml_path)
    mechanism = _assemble(file, urdf, yaml_path)
    home = mechanism.home if file.legcal.home is not None else find_home(mechanism)
    mechanism = replace(mechanism, home=settle_home(mechanism, home))
    mechanism = replace(mechanism, home_configuration=close_at(mechanism, mechanism.home))
    mechanism = replace(mechanism, mobility=mobility(mechanism))
    agreement.check_length_law(mechanism)
    return replace(
        mechanism, diagnostics=diagnose(mechanism, home_is_given=file.legcal.home is not None)
    )


def _assemble(file: MechanismFile, urdf: Urdf, yaml_path: Path) -> Mechanism:
    """Return the mechanism, its chain not closed yet."""
    block = file.legcal
    pairs = sorted(zip(file.closed_loop, file.type, strict=True))  # sums depend on their order
    closures = [Closure("3d" if kind == "3d" else "6d", one, two) for (one, two), kind in pairs]
    bodies = rigid_bodies(urdf, closures, block.platform_joint)
    chains = agreement.legs_in_order(
        find_chains(bodies, urdf, block.base, block.platform), bodies, urdf, file, yaml_path
    )
    try:
        chain = ClosedChain(urdf.text, closures)
    except ModelError as error:
        raise ModelError([f"{urdf.path}: {problem}" for problem in error.problems]) from error
    home = None if block.home is None else block.home.motion()
    legs = tuple(
        _leg(name, leg_chain, urdf, file, bodies, home)
        for j, (name, leg_chain) in enumerate(zip(block.legs, chains, strict=True))
    )
    frame_legs = tuple(list(block.legs).index(name) for name in block.base_frame)
    agreement.check_frames(legs, frame_legs, yaml_path)
    return Mechanism(
        name=urdf.name,
        yaml_path=yaml_path,
        urdf_path=urdf.path,
        base=block.base,
        platform=block.platform,
        platform_joint=block.platform_joint,
        legs=with_cylinders(legs, urdf, bodies, chains),
        frame_legs=frame_legs,
        spatial=True,
        home=RigidTransform.identity() if home is None else home,
        home_configuration=chain.neutral(),
        chain=chain,
        urdf=urdf,
        leg_chains=tuple(chains),
    )


def _leg(
    name: str,
    chain: LegChain,
    urdf: Urdf,
    file: MechanismFile,
    bodies: Bodies,
    home: RigidTransform | None,
) -> Leg:
    """Return a leg in the links of base and platform."""
    T_base, T_platform = (
        bodies.T_body_link[link] for link in (file.legcal.base, file.legcal.platform)
    )
    A_base = np.asarray(T_base.inv().apply(chain.base.centre_near))
    B_platform = np.asarray(T_platform.inv().apply(chain.platform.centre_far))
    slider = None if chain.slider is None else chain.slider.connection.joint
    sign, travel = 1, (0.0, 0.0)
    kind = LegKind.CONSTANT
    if slider is not None:
        travel = urdf.joints[slider].limits or travel
        length = None if home is None else float(np.linalg.norm(home.apply(B_platform) - A_base))
        sign = _sign(chain.reach, travel, length)
        kind = LegKind.ACTUATED if slider in file.name_mot else LegKind.PASSIVE
    return Leg(
        name=name,
        base_joint=chain.base.letter,
        platform_joint=chain.platform.letter,
        kind=kind,
        prismatic=slider,
        A_base=A_base,
        B_platform=B_platform,
        q0=sign * chain.reach,
        sign=sign,
        travel=travel,
        cylinders=(),
    )


def _sign(reach: float, travel: tuple[float, float], length: float | None) -> int:
    """Return whether a leg grows (+1) or shrinks (-1) with its joint value.

    B stands at reach + q along the slider. Its length at home tells on which side of A, where
    only one of the two is within the travel; else the middle of the travel does.
    """
    if length is not None:
        inside = [travel[0] <= s * length - reach <= travel[1] for s in (1, -1)]
        if inside[0] != inside[1]:
            return 1 if inside[0] else -1
    return 1 if reach + 0.5 * (travel[0] + travel[1]) > 0.0 else -1
