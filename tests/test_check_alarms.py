"""False alarms of ``check``: on machines of several classes, white errors and shared ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machine_session import machine_session
from simulated import settings

from legcal import calibrate, check
from legcal.calibration.joint_fit.fit import refine
from legcal.data.dataset import Dataset, load_dataset
from legcal.data.measurements import Measurements
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.simulation.dataset import simulate
from legcal.simulation.observe import OutlineNoise, shifted_outlines

EXACT = 1e-4  # [px]: errors of the outlines on which others are put
NOISE = OutlineNoise(0.1, 150)


def _simulated(model: str, folder: Path, poses: int, views: int, *, images: int = 1) -> Dataset:
    """Return almost exact outlines of the same true machine, whatever the poses."""
    chosen = settings(poses=poses, views=views, images=images, sigma_px=EXACT)
    return load_dataset(simulate(model, folder, chosen).folder)


def _with_errors(dataset: Dataset, rng: np.random.Generator, shared: float = 0.0) -> Dataset:
    """Return a dataset whose outlines have errors, some of them shared [px].

    Shared ones are constant for every edge of a leg in a view.
    """
    o, m = dataset.observations, dataset.measurements
    assert o is not None
    offsets = rng.multivariate_normal(np.zeros(2), NOISE.covariance(0.0), size=len(o))
    shift = shared * rng.standard_normal((len(m.views), 1 + o.leg.max(), 2))
    offsets += shift[m.view[o.row], o.leg, o.edge - 1][:, None]
    h, ends = _moved(m, o.row, o.h, o.ends, offsets)
    covariance = np.tile(NOISE.covariance(0.0), (len(o), 1, 1))
    return replace(dataset, observations=replace(o, h=h, ends=ends, covariance=covariance))


def _moved(
    m: Measurements, row: IntArray, h: Array, ends: Array, offsets: Array
) -> tuple[Array, Array]:
    h, ends = h.copy(), ends.copy()
    for v in range(len(m.views)):
        here = m.view[row] == v
        found = shifted_outlines(m.views[v].camera, h[here], ends[here], offsets[here])
        h[here], ends[here] = found
    return h, ends


@pytest.mark.parametrize(
    ("model", "known"),
    [
        pytest.param("3-upu", 1e-3, marks=pytest.mark.slow),
        pytest.param("3-upu-tilted", 2e-3, marks=pytest.mark.slow),
        ("tricept", 2e-3),
    ],
)
def test_a_calibrated_machine_of_any_class_has_not_moved(
    model: str, known: float, tmp_path: Path
) -> None:
    rng = np.random.default_rng(8)
    images = _with_errors(_simulated(model, tmp_path / "set", 8, 3), rng)
    calibrate(images, output=tmp_path / "result")
    found = check(_with_errors(_simulated(model, tmp_path / "new", 4, 2), rng), tmp_path / "result")
    assert not found.movement.moved
    assert found.movement.dof >= 15
    assert 1e-5 < found.at_platform.expected_displacement < known


@pytest.mark.slow
def test_errors_that_outlines_share_do_not_look_like_a_movement(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    images = _with_errors(_simulated("hexapod", tmp_path / "set", 15, 3), rng, shared=0.05)
    earlier = calibrate(images, output=tmp_path / "result")
    assert max(earlier.solution.shared_px.values()) > 0.02
    exact = _simulated("hexapod", tmp_path / "new", 8, 1)
    found = [check(_with_errors(exact, rng, shared=0.05), tmp_path / "result") for _ in range(3)]
    assert min(each.movement.p_value for each in found) > 1e-3
    for each in found:
        for kind, size in earlier.solution.shared_px.items():
            assert each.solution.shared_px[kind] >= size


@pytest.fixture(scope="module")
def planar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of a calibration of a planar machine."""
    folder = tmp_path_factory.mktemp("planar")
    calibrate(_simulated("3-rpr", folder / "set", 8, 2), output=folder / "result")
    return folder / "result"


def _of_one_leg(dataset: Dataset) -> Dataset:
    assert dataset.observations is not None
    shown = dataset.observations.choose(dataset.observations.leg == 0)
    return replace(dataset, observations=shown)


def test_an_image_that_cannot_tell_is_refused_in_one_sentence(planar: Path, tmp_path: Path) -> None:
    image = _of_one_leg(_simulated("3-rpr", tmp_path / "new", 1, 1))
    with pytest.raises(NotIdentifiable, match="The fit is not determined") as told:
        check(image, planar)
    assert len(told.value.problems) == 1


def test_images_of_one_leg_tell_little_and_raise_no_alarm(planar: Path, tmp_path: Path) -> None:
    images = _of_one_leg(_simulated("3-rpr", tmp_path / "new", 2, 1))
    found = check(images, planar)
    assert not found.movement.moved
    assert found.movement.dof <= 4


def test_intrinsics_are_taken_over_for_the_whole_camera_only(tmp_path: Path) -> None:
    images = _with_errors(_simulated("3-rpr", tmp_path / "set", 8, 2), np.random.default_rng(10))
    fx = float(images.measurements.views[0].camera.K[0, 0])
    found = calibrate(images, output=tmp_path / "result", priors={"c1.fx": (fx, 1.0)})
    assert "c1.fx" in found.solution.names
    new = _simulated("3-rpr", tmp_path / "new", 4, 1)
    assert "c1.fx" in check(new, tmp_path / "result").solution.names
    view = new.measurements.views[0]
    larger = replace(view, camera=replace(view.camera, height=view.camera.height + 1))
    other = replace(new, measurements=replace(new.measurements, views=(larger,)))
    assert "c1.fx" not in check(other, tmp_path / "result").solution.values


@pytest.mark.parametrize("model", ["3-upu", "hexapod"])
def test_what_is_known_of_parameters_is_told_apart_from_what_is_held(model: str) -> None:
    session = machine_session(model)
    found = refine(session.legs, *session.noisy(3), session.start)
    names = found.parametrization.names
    both = [name for name in found.names if name in names]
    here, there = ([all_.index(n) for n in both] for all_ in (names, found.names))
    np.testing.assert_allclose(
        found.value_covariance[np.ix_(here, here)], found.covariance[np.ix_(there, there)]
    )
    assert len(found.held_basis) == len(found.held)
    assert bool(len(found.held)) == (model == "3-upu")
    # In metres, nothing is estimated along what is held.
    length = np.mean([np.linalg.norm(found.T_Rb_Re[0].apply(leg.B) - leg.A) for leg in found.legs])
    metre = np.where(np.array(found.parametrization.units) == "m", 1.0, 1.0 / length)
    held = found.held_basis / metre
    np.testing.assert_allclose(held @ held.T, np.eye(len(held)), atol=0.1)
    scaled = found.value_covariance / np.outer(metre, metre)
    along = np.diagonal(held @ scaled @ held.T)
    assert np.all(along < 0.01 * np.linalg.eigvalsh(scaled)[-1])


@pytest.mark.slow
def test_alarms_of_the_whole_check_are_as_rare_as_stated(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    first = _simulated("3-rpr", tmp_path / "set", 8, 2)
    new = _simulated("3-rpr", tmp_path / "new", 3, 1)
    p_values = []
    for _ in range(20):
        calibrate(_with_errors(first, rng), output=tmp_path / "result")
        p_values += [
            check(_with_errors(new, rng), tmp_path / "result").movement.p_value for _ in range(2)
        ]
    assert np.mean(np.array(p_values) < 0.05) < 0.2
    assert 0.3 < np.mean(p_values) < 0.7
