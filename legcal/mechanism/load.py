"""Loading a mechanism: files, tree, closures, legs and home, each checked before the next."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import LegcalError, ModelError
from legcal.files.motion import MotionEntry
from legcal.geometry.frames import motion_to_xyz_quat
from legcal.mechanism import agreement, virtual_joint
from legcal.mechanism.bodies import rigid_bodies
from legcal.mechanism.chain import ClosedChain, Closure
from legcal.mechanism.consistency import (
    check_across,
    check_equations,
    check_origins,
    check_spread,
    check_unit,
)
from legcal.mechanism.cylinders import visual_cylinders, with_cylinders
from legcal.mechanism.heights import at_visible_heights
from legcal.mechanism.home import closed_home
from legcal.mechanism.home_travel import check_home_travel
from legcal.mechanism.leg_chain import LegChain
from legcal.mechanism.leg_of_chain import leg_of
from legcal.mechanism.mobility import mobility
from legcal.mechanism.model import Mechanism
from legcal.mechanism.notes import diagnose, proposal_notes
from legcal.mechanism.plane import in_links, normals_of_closures, plane_of_motion
from legcal.mechanism.proposal import propose_block, propose_frame
from legcal.mechanism.schema import LegcalBlock
from legcal.mechanism.sources.read import read_source
from legcal.mechanism.sources.source import Source
from legcal.mechanism.topology import find_chains
from legcal.mechanism.urdf import Urdf


def load_mechanism(model: str | Path) -> Mechanism:
    """Return the mechanism of a file, its legs found from geometry.

    Parameters
    ----------
    model : str or Path
        A mechanism YAML, or a folder with ``robot.yaml``; a URDF with its YAML beside it (or in
        ``../models``) or with loops of its own; an MJCF file; or the name of a shipped model.

    Raises
    ------
    ModelError
        If a file is missing, malformed or contradicts itself; all problems of a file at once.
    OutOfClass
        If the mechanism is not one that the method covers.
    """
    source = read_source(model)
    try:
        return _load(source)
    except LegcalError as error:
        said = [source.in_its_words(problem) for problem in error.problems]
        raise type(error)(said) from error


def _load(source: Source) -> Mechanism:
    """Return the mechanism of a source."""
    file, urdf = source.file, source.urdf
    check_origins(urdf)
    agreement.check_names(file, urdf, source.path)
    pairs = sorted(zip(file.closed_loop, file.type, strict=True))  # sums depend on their order
    closures = [Closure("3d" if kind == "3d" else "6d", one, two) for (one, two), kind in pairs]
    block = file.legcal or propose_block(urdf, closures, file.name_mot, source.path)
    if block.home is None and source.poses is not None:
        T = source.poses[block.base].inv() * source.poses[block.platform]
        drawn = MotionEntry.model_validate(motion_to_xyz_quat(T))
        block = block.model_copy(update={"home": drawn})
    mechanism = _assemble(source, block, closures)
    given = mechanism.home if block.home is not None else None
    if given is None:
        check_spread(mechanism)  # before a home of kilometres is looked for
    else:
        check_unit(mechanism)  # before lengths of hundreds of metres fail to close
    if file.legcal is not None and file.legcal.home is not None:  # a drawing may be anywhere
        check_home_travel(mechanism)
    pose, configuration = closed_home(mechanism, given)
    mechanism = replace(mechanism, home=pose, home_configuration=configuration)
    check_unit(mechanism)
    check_across(mechanism)
    mechanism = replace(mechanism, mobility=mobility(mechanism))
    check_equations(mechanism)
    proposed = proposal_notes(file.legcal, mechanism)
    found = map(source.in_its_words, diagnose(mechanism, home_is_given=block.home is not None))
    return replace(mechanism, diagnostics=(*source.notes, *proposed, *found))


def _assemble(source: Source, block: LegcalBlock, closures: Sequence[Closure]) -> Mechanism:
    """Return the mechanism, its chain not closed yet."""
    file, urdf, yaml_path = source.file, source.urdf, source.path
    virtual_joint.check_type(block, urdf, yaml_path)
    bodies = rigid_bodies(urdf, closures, block.platform_joint)
    chains = agreement.legs_in_order(
        find_chains(bodies, urdf, block.base, block.platform), bodies, urdf, block, yaml_path
    )
    agreement.check_motors(file, chains, urdf, yaml_path)
    virtual_joint.check_bodies(block, bodies, urdf, yaml_path)
    ends = bodies.T_body_link[block.base], bodies.T_body_link[block.platform]
    normals = plane_of_motion(chains)
    agreement.check_count(chains, spatial=normals is None, path=yaml_path)
    if block.platform_joint is not None:
        virtual = urdf.joints[block.platform_joint]
        turn = bodies.T_body_link[virtual.parent].rotation.inv()
        normal = None if normals is None else np.asarray(turn.apply(normals[0]))
        virtual_joint.check_plane(virtual, normal, yaml_path)
    in_plane = None if normals is None else in_links(normals, ends)
    shown = visual_cylinders(urdf)
    if normals is not None:
        chains = at_visible_heights(chains, shown, bodies)
    try:
        chain = ClosedChain(
            urdf.text, closures, normals_of_closures(in_plane, closures, block, urdf)
        )
    except ModelError as error:
        raise ModelError([f"{urdf.path}: {problem}" for problem in error.problems]) from error
    home = None if block.home is None else block.home.motion()
    legs = tuple(
        leg_of(
            name,
            leg_chain,
            ends,
            travel=_travel(leg_chain, urdf),
            actuated=leg_chain.motor in file.name_mot,
            spatial=normals is None,
            home=home,
        )
        for name, leg_chain in zip(block.legs, chains, strict=True)
    )
    names = list(block.legs)
    base_normal, platform_normal = in_plane or (None, None)
    base_frame = block.base_frame or propose_frame(names, chains)
    mechanism = Mechanism(
        name=urdf.name,
        yaml_path=yaml_path,
        urdf_path=urdf.path,
        base=block.base,
        platform=block.platform,
        platform_joint=block.platform_joint,
        legs=with_cylinders(legs, shown, bodies, chains),
        frame_legs=tuple(names.index(name) for name in base_frame),
        spatial=normals is None,
        home=RigidTransform.identity() if home is None else home,
        home_configuration=chain.neutral(),
        chain=chain,
        urdf=urdf,
        leg_chains=tuple(chains),
        base_normal=base_normal,
        platform_normal=platform_normal,
    )
    agreement.check_frames(mechanism)
    return mechanism


def _travel(chain: LegChain, urdf: Urdf) -> tuple[float, float]:
    """Return the limits of a leg's slider [m], zero for a rod."""
    limits = None if chain.motor is None else urdf.joints[chain.motor].limits
    return (0.0, 0.0) if limits is None else limits
