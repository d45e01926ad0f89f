"""The studies by their names on the command line."""

from __future__ import annotations

from legcal.errors import UsageError
from legcal.simulation.table_noise import TableNoise
from legcal.studies.paper import PaperStudy
from legcal.studies.study import Study

STUDIES = ("paper",)


def study_named(name: str, *, radians: bool = False) -> Study:
    """Return a study.

    Parameters
    ----------
    name : str
        One of ``STUDIES``.
    radians : bool
        Of ``paper``: read the angles of Table 1 to the letter.

    Raises
    ------
    UsageError
        If there is no such study.
    """
    if name == "paper":
        return PaperStudy(TableNoise.in_radians() if radians else TableNoise())
    raise UsageError(
        f"The study could not be run: found the name '{name}', needed one of "
        f"{', '.join(STUDIES)}; correct it."
    )
