"""Straight edges of the bodies of legs: in the joint fit, in files, in photographs, in identify."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from fit_sessions import MachineSession, body_edges, machine_session
from machines import copied_model
from simulated import settings, small_camera, standing

from legcal import calibrate, load_dataset, load_mechanism, simulate
from legcal.calibration.identify.identifiability import Analysis, identifiability_of_dataset
from legcal.calibration.identify.session import planned_session
from legcal.calibration.joint_fit.outline_errors import NoiseModel, possible_biases
from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.joint_fit.predicted import DEFAULT_NOISE, Predictor, fitted_covariance
from legcal.calibration.joint_fit.problem import build_fit
from legcal.calibration.joint_fit.variables import Start
from legcal.calibration.ordered_dataset import nominal_poses
from legcal.calibration.tuning import EDGE_SHARE
from legcal.data.reasons import Reason
from legcal.estimation.problem import Frames, linearize
from legcal.estimation.solver import information
from legcal.estimation.uncertainty import response
from legcal.machine.inspection import machine_document
from legcal.machine.parameters import geometries
from legcal.machine.shapes import SECTIONS, PlacedOccluders, bodies_of
from legcal.perception.body_edges import bodies_in_view, edges_of_body
from legcal.perception.photographs import nominal_placement
from legcal.simulation.settings import Level

BODY = (
    '<visual><origin xyz="0.004 -0.003 -0.255" rpy="0 0 0"/>'
    '<geometry><box size="0.03 0.03 0.11"/></geometry></visual>'
)


def without_leg(session: MachineSession, leg: int) -> MachineSession:
    return replace(session, outlines=session.outlines.choose(session.outlines.leg != leg))


def test_a_leg_with_a_body_and_no_round_part_is_found_exactly() -> None:
    session = machine_session("3-rps")
    assert session.off(session.start.legs) > 1e-3
    found = without_leg(session, 0).fit(edges=body_edges(session))
    assert session.off(found.legs) < 1e-7


def test_edges_make_a_machine_more_certain_and_know_their_noise() -> None:
    """The first two legs are seen in one of four images."""
    session = machine_session("hexapod")
    noisy, edges = session.noisy(1), body_edges(session, 0.1, seed=2)
    o = noisy.outlines
    few = replace(noisy, outlines=o.choose((o.leg > 1) | (o.row % 4 == 0)))
    claimed = replace(edges, covariance=0.25 * edges.covariance)  # half of the true noise
    with_edges, rods = few.fit(edges=claimed), few.fit()
    problem = with_edges.posterior.problem
    whitening = np.asarray(problem.factor("edges").whitening)
    scale = 1.0 / (problem.edges.sigma * whitening[:, 0, 0])
    np.testing.assert_allclose(scale, 2.0, rtol=0.15)
    names = rods.estimates.names
    assert names == with_edges.estimates.names
    assert np.all(with_edges.estimates.sigma < rods.estimates.sigma)


def test_edges_in_photographs_keep_errors_in_a_view() -> None:
    """A leg that has edges alone is known less well by photographs than by as many edges apart."""
    session = machine_session("3-rps")
    others, edges = without_leg(session, 0), body_edges(session, 0.1, seed=3)
    sigmas = []
    for of_photographs in (True, False):
        choices = Choices(of_photographs=of_photographs)
        estimates = others.fit(edges=edges, choices=choices).estimates
        of_leg = [name.startswith("leg1.") for name in estimates.names]
        sigmas.append(np.asarray(estimates.sigma)[of_leg])
    assert np.all(sigmas[0] > 1.1 * sigmas[1])


def test_edges_that_add_little_are_left_out() -> None:
    session = machine_session("hexapod")
    noisy = session.noisy(1)
    with_edges, rods = noisy.fit(edges=body_edges(session, 2.0, seed=2)), noisy.fit()
    assert with_edges.edges is not None
    assert np.all(with_edges.edges.rejected_for(Reason.LITTLE_GAIN))
    np.testing.assert_array_equal(with_edges.estimates.sigma, rods.estimates.sigma)


def test_wrong_edges_are_rejected_and_bodies_may_lean() -> None:
    session = machine_session("hexapod")
    edges = body_edges(session, 0.1, seed=3)
    wrong = np.arange(0, len(edges), 9)
    ends = edges.ends.copy()
    ends[wrong, 1] += 6.0
    solution = without_leg(session, 0).fit(edges=replace(edges, ends=ends))
    assert solution.edges is not None
    rejected = np.flatnonzero(solution.edges.rejected_for(Reason.DISAGREES))
    assert set(wrong) - set(rejected) == set()
    assert len(rejected) < len(wrong) + 0.02 * len(edges)
    estimates, truth = solution.estimates, session.true_values
    off = [estimates.values[name] - truth[name] for name in estimates.names if name in truth]
    sigma = [s for name, s in zip(estimates.names, estimates.sigma, strict=True) if name in truth]
    assert np.abs(np.divide(off, sigma)).max() < 4.0
    assert np.median(np.abs(off)) < 2e-4
    assert np.abs(off).max() < 1e-3  # leg 1 shows nothing but edges


@pytest.fixture(scope="module")
def with_bodies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a hexapod whose legs have square bodies, the second one nothing else."""

    def with_boxes(text: str) -> str:
        text = re.sub(r'(<link name="leg2_[^"]*">)<visual>.*?</visual>(</link>)', r"\1\2", text)
        return re.sub(r'<link name="leg\d_tube">', rf"\g<0>{BODY}", text)

    return copied_model(tmp_path_factory.mktemp("bodies"), "hexapod", with_boxes)


def test_the_part_of_a_mesh_that_has_one_section_is_a_body(with_bodies: Path) -> None:
    """An extrusion with a groove, an end plate and a motor beside is the body that a box is."""
    parts = [
        trimesh.creation.box(size).apply_translation(at)
        for size, at in (
            ((0.026, 0.030, 0.110), (-0.002, 0.0, 0.0)),
            ((0.004, 0.012, 0.110), (0.013, 0.009, 0.0)),
            ((0.004, 0.012, 0.110), (0.013, -0.009, 0.0)),
            ((0.036, 0.036, 0.004), (0.0, 0.0, 0.053)),
        )
    ]
    parts.append(trimesh.creation.cylinder(0.012, 0.02).apply_translation((0.03, 0.0, -0.045)))
    mesh: Any = trimesh.util.concatenate(parts)
    mesh.export(with_bodies.parent / "body.stl")
    drawn = (with_bodies.parent.parent / "urdf/hexapod.urdf").read_text()
    first, others = drawn.split('<link name="leg2_', 1)
    first = first.replace('<box size="0.03 0.03 0.11"/>', '<mesh filename="body.stl"/>')
    (with_bodies.parent / "mesh.urdf").write_text(f'{first}<link name="leg2_{others}')
    text = with_bodies.read_text().replace("../urdf/hexapod.urdf", "mesh.urdf")
    (with_bodies.parent / "mesh.yaml").write_text(text)
    legs = machine_document(load_mechanism(with_bodies.parent / "mesh.yaml"))["legs"]
    lengths = [[body["length"] for body in leg["bodies"]] for leg in legs]
    assert lengths[0] == [pytest.approx(0.11 - 0.004 - 0.02, abs=2 * 0.11 / SECTIONS)]
    assert lengths[1:] == [[pytest.approx(0.11)]] * 5
    machine = load_mechanism(with_bodies.parent / "mesh.yaml")
    (body,), (box,) = bodies_of(machine.occluders, 6)[:2]
    assert body.radius == pytest.approx(box.radius, rel=1e-3)


def _plates(*places: float) -> Any:
    plate = trimesh.creation.box((0.004, 0.030, 0.110))
    return trimesh.util.concatenate([plate.copy().apply_translation((x, 0, 0)) for x in places])


@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(_plates(-0.013, 0.013), id="the two plates of a fork"),
        pytest.param(trimesh.creation.cylinder(0.015, 0.110, sections=13), id="13 sides"),
    ],
)
def test_what_is_open_or_round_is_no_body(mesh: Any, tmp_path: Path) -> None:
    """A camera sees the rod between the plates, and facets of a round mesh are no edges."""
    file = f"body{len(mesh.faces)}.stl"
    drawn = BODY.replace('<box size="0.03 0.03 0.11"/>', f'<mesh filename="{file}"/>')
    drawn = drawn.replace("0.004 -0.003", "0 0")
    model = copied_model(
        tmp_path, "hexapod", lambda text: re.sub('<link name="leg1_tube">', rf"\g<0>{drawn}", text)
    )
    mesh.export(model.parent.parent / "urdf" / file)
    machine = load_mechanism(model)
    assert len(machine.occluders) == 1
    assert not any(bodies_of(machine.occluders, 6))
    assert all(bool(rod.covers) == mesh.is_convex for rod in machine.legs[0].cylinders)


def test_a_leg_with_a_body_alone_is_identified_and_calibrated(
    with_bodies: Path, tmp_path: Path
) -> None:
    made = simulate(with_bodies, tmp_path / "set", settings(views=standing("hexapod"), poses=8))
    dataset = load_dataset(made.folder)
    assert dataset.observations is not None
    assert dataset.body_edges is not None
    assert 1 not in dataset.observations.leg
    assert set(dataset.body_edges.edge.tolist()) == {3, 4}
    assert identifiability_of_dataset(dataset).identifiable
    result = calibrate(dataset, output=tmp_path / "out")
    true = geometries(made.truth)[1]
    found, nominal = result.solution.legs[1], geometries(made.nominal)[1]
    assert np.linalg.norm(found.B - true.B) < 0.3 * np.linalg.norm(nominal.B - true.B)
    written = (tmp_path / "out/observations.csv").read_text()
    assert written.count("leg2_tube") == np.sum(dataset.body_edges.leg == 1)


def test_edges_in_photographs_point_along_their_legs(with_bodies: Path, tmp_path: Path) -> None:
    views = standing("hexapod", 1, small_camera(tmp_path, 1000, 750))
    T, lens = views[0].T_base_camera, views[0].camera
    seen_from = settings(level=Level.PHOTOGRAPHS, views=views, poses=1)
    made = simulate(with_bodies, tmp_path / "set", seen_from)
    dataset, truth = load_dataset(made.folder), made.truth
    m = dataset.measurements
    back = truth.T_platform_Re.inv()
    poses = [truth.T_base_Rb * T_Rb_Re * back for T_Rb_Re in nominal_poses(truth, m)[0]]
    placement = nominal_placement(truth, m, poses)
    grey, ends = dataset.image_reader([0])(0), (placement.A_base[0], placement.B_base[0])
    every, bodies = np.ones(6, dtype=np.bool_), bodies_of(truth.occluders, 6)
    (placed,) = PlacedOccluders.at(truth.occluders, ends[0][None], ends[1][None])
    found = 0
    for body in bodies_in_view(bodies, placed, lens, T, ends, every):
        for edge in edges_of_body(grey, lens, body):
            rays = np.column_stack([lens.undistort(edge.ends), np.ones(2)])
            h = np.cross(rays[0], body.B - body.A)
            off = lens.line_offset(h[None] / np.linalg.norm(h), rays[1:, :2])
            assert abs(float(off[0])) < 0.7
            found += 1
    assert found >= 6


def test_identify_and_plan_count_what_edges_keep_in_a_view(with_bodies: Path) -> None:
    """As the joint fit to the same images does: by its covariance and its response to an error."""
    machine = load_mechanism(with_bodies)
    noise = replace(DEFAULT_NOISE, places_px=(0.0, 0.0), gamma_px=0.0, sigma_px=1.0)
    choices = Choices(fixed=frozenset(f"{name}.twist" for name in machine.leg_names))
    session = planned_session(machine, [range(6)] * 3, 6)
    outlines, edges = session.outlines, session.edges
    problem = build_fit(
        session.fitted,
        session.measurements,
        noise.of(outlines),
        choices=choices,
        edges=noise.of_bodies(edges),
    )
    possible = possible_biases(problem.outlines, machine.leg_names)
    problem = problem.with_biases(possible.of_sizes(np.append(noise.common_px, 0.0)))
    problem, poses = problem.weighted(NoiseModel()), Frames(session.R, session.t).motions
    views = tuple(T.inv() for T in session.places)
    at = problem.begin(Start(session.fitted.nominal, views, poses, "here"))
    normal = information(linearize(problem, at), problem.loss)
    line = 10 * (6 * session.view[edges.row] + edges.leg) + edges.edge
    same = EDGE_SHARE * (line[:, None] == np.unique(line))
    moved, n = response(normal, {"edges": same[:, None]}), problem.n_kinematic
    alone = normal.kept_covariance()
    stated = np.sqrt(np.diagonal(alone + moved @ moved.T)[:n])
    assert np.any(stated > 1.2 * np.sqrt(np.diagonal(alone)[:n]))

    found = Analysis(session, choices, noise).covariance[problem.free][:, problem.free]
    np.testing.assert_allclose(np.sqrt(np.diagonal(found)), stated, rtol=0.01)
    planned = Predictor(machine, session.cameras[0].camera, noise, session.sigma_q, choices)
    parts = []
    for v, T in enumerate(session.places):
        row, alike = np.flatnonzero(session.view == v), np.zeros(6, dtype=np.intp)
        rods, bodies = (
            replace(some, row=np.searchsorted(row, some.row))
            for some in (one.choose(np.isin(one.row, row)) for one in (outlines, edges))
        )
        at_poses, view = [poses[k] for k in row], {"c": machine.T_base_Rb * T}
        parts.append(planned.contributions(view, alike, at_poses, rods, edges=bodies))
    found = fitted_covariance(parts, planned.legs, poses, machine.size)
    found = found[problem.free][:, problem.free]
    np.testing.assert_allclose(np.sqrt(np.diagonal(found)), stated, rtol=0.02)
