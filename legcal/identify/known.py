"""What is known of parameters before any image is looked at: those that are fixed, and priors."""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array
from legcal.identify.full import SIGMA_EXACT
from legcal.identify.session import Session
from legcal.refinement.choices import Choices


def known_rows(session: Session, choices: Choices) -> Array:
    """Return what is known of the parameters as whitened rows, (p, p) [1/m].

    Parameters
    ----------
    session : Session
        The observations; its parameters are counted in metres.
    choices : Choices
        Parameters that are fixed, and those of which something is known.
    """
    known = np.zeros(len(session.unit))
    for i, name in enumerate(session.parametrization.names):
        if name in choices.priors:
            known[i] = session.unit[i] / choices.priors[name].sigma
        elif choices.holds(name, by_default=name.endswith(".twist")):
            known[i] = 1.0 / SIGMA_EXACT
    return np.diag(known)
