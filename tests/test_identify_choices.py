"""Parameters that are fixed, or known from elsewhere, are no longer open."""

from functools import cache

import numpy as np
import pytest
from hexapod_example import HEXAPOD

from legcal.calibration.identify.judge import check_identifiable, identifiability_of_dataset
from legcal.calibration.joint_fit.choices import Choices, Prior
from legcal.data.dataset import Dataset, load_dataset
from legcal.data.holdout import dataset_at
from legcal.errors import NotIdentifiable
from legcal.machine import parametrization_of


@cache
def _two_images() -> Dataset:
    return dataset_at(load_dataset(HEXAPOD, check_images=False), np.array([0, 15]))


def _names(ending: str) -> list[str]:
    names = parametrization_of(_two_images().machine).names
    return [name for name in names if name.endswith(ending)]


def test_priors_settle_what_too_few_images_leave_open() -> None:
    with pytest.raises(NotIdentifiable, match="or state what is known of them with --prior"):
        check_identifiable(_two_images())
    priors = {name: Prior(0.3, 1e-4) for name in _names("")}
    notes = check_identifiable(_two_images(), Choices(priors=priors))
    assert all("The four steps alone" in note for note in notes)


def test_fixed_parameters_settle_them_too() -> None:
    found = identifiability_of_dataset(_two_images(), Choices(fixed=frozenset(_names(""))))
    assert found.full.rank == found.full.of == 30


def test_a_choice_settles_no_more_than_it_says() -> None:
    dataset = _two_images()
    open_without = 30 - identifiability_of_dataset(dataset).full.rank
    one = Choices(fixed=frozenset({"leg4.offset"}))
    open_with = 30 - identifiability_of_dataset(dataset, one).full.rank
    assert open_with == open_without - 1
    vague = Choices(priors={name: Prior(0.3, 100.0) for name in _names("")})
    assert identifiability_of_dataset(dataset, vague).full.rank == 30 - open_without
