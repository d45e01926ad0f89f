"""Images that were looked at before: their bars are known and not found anew."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from legcal.recognition.bars import Bars
from legcal.recognition.searching import Search


@dataclass(frozen=True, eq=False)
class LookedAt(Search):
    """A search in images of which some were looked at.

    Attributes
    ----------
    known : mapping of Bars
        The bars of some images, by row, as the cameras of their own views have taken them.
    """

    known: Mapping[int, Bars] = field(default_factory=dict)

    def bars(self, row: int, view: int) -> Bars:
        """Return the bars of an image as if the camera of a view had taken it."""
        is_own = view == int(self.measurements.view[row])
        return self.known[row] if is_own and row in self.known else super().bars(row, view)
