"""The choices of the fit of everything."""

from dataclasses import dataclass


@dataclass(frozen=True)
class RefinementSettings:
    """Choices of the fit.

    Attributes
    ----------
    radius_sigma : float
        Standard deviation of the prior on radii, as a part of the radius.
    board_scale_sigma : float
        Standard deviation of the dimensions of a calibration board, as a part of them: what
        printers and paper do.
    loss_width : float
        Whitened distance at which the loss of an outline turns from quadratic to linear.
    rejection : float
        Whitened distance beyond which an outline is rejected; a right one in 25,000 is, at 4.5.
    rejection_rounds : int
        Rounds, at most, until the rejected outlines stay the same.
    noise_rounds : int
        Rounds, at most, in which the errors of outlines are estimated after that.
    settled : float
        Relative change of these below which the rounds end.
    axis_disagreement : float
        Whitened distance of an axis beyond which it disagrees; a fit in which most do is
        refused. Sigmas that are too small by less are told by chi2 alone.
    largest_rms_px : float
        Root mean square of the offsets of accepted outlines beyond which a fit is refused [px].
    max_iterations : int
        Steps to try in each solve, at most.
    """

    radius_sigma: float = 0.02
    board_scale_sigma: float = 0.001
    loss_width: float = 3.0
    rejection: float = 4.5
    rejection_rounds: int = 6
    noise_rounds: int = 10
    settled: float = 0.02
    axis_disagreement: float = 20.0
    largest_rms_px: float = 3.0
    max_iterations: int = 200


DEFAULT_SETTINGS = RefinementSettings()
