"""The schema of ``dataset.yaml``."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, Strict, field_validator

from legcal.dataset.wishes import Wish, read_wish
from legcal.files.motion import MotionEntry
from legcal.files.schema import FileSchema, Name, Number, Version
from legcal.files.stated import Stated, read_prior

ENCODER_SIGMAS = (1e-12, 1.0)  # [m]; no encoder is better, none worse
GAMMAS = (0.2, 5.0)  # no camera encodes light more strongly


class ViewEntry(FileSchema):
    """One camera position."""

    camera: str
    gamma: Annotated[Number, Field(ge=GAMMAS[0], le=GAMMAS[1])] | None = None  # not known
    T_base_camera: MotionEntry | None = None
    hand_held: Annotated[bool, Strict()] = False
    legs: Annotated[list[str], Field(min_length=1)] | None = None

    @field_validator("legs")
    @classmethod
    def _names_each_leg_once(cls, legs: list[str] | None) -> list[str] | None:
        twice = sorted({name for name in legs or () if (legs or []).count(name) > 1})
        if twice:
            raise ValueError(f"found {', '.join(twice)} twice, needed each leg once; remove one.")
        return legs


def _can_be_fixed(text: str) -> str:
    """Refuse a value that a parameter cannot be fixed at."""
    read_wish("fixed", text, "")
    return text


class ParametersEntry(FileSchema):
    """What is known of parameters, which are left as they are and which are looked for."""

    priors: dict[Name, Annotated[Stated, BeforeValidator(read_prior)]] = Field(default_factory=dict)
    fixed: list[Annotated[Name, AfterValidator(_can_be_fixed)]] = Field(default_factory=list)
    free: list[Name] = Field(default_factory=list)

    def wishes(self, path: Path) -> tuple[Wish, ...]:
        """Return what the block asks for; ``path`` is that of the file, for messages."""
        block = f"{path}: parameters"
        return (
            *(
                read_wish("prior", name, f"{block}.priors.{name}", stated, in_file=True)
                for name, stated in self.priors.items()
            ),
            *(
                read_wish("fixed", text, f"{block}.fixed '{text}'", in_file=True)
                for text in self.fixed
            ),
            *(
                read_wish("free", text, f"{block}.free '{text}'", in_file=True)
                for text in self.free
            ),
        )


class DatasetEntry(FileSchema):
    """The whole of ``dataset.yaml``."""

    legcal_dataset: Version
    mechanism: str
    measurements: str
    encoder_sigma: Annotated[Number, Field(gt=0.0)]
    views: Annotated[dict[Name, ViewEntry], Field(min_length=1)]
    parameters: ParametersEntry = Field(default_factory=ParametersEntry)
    board: dict[str, Any] | None = None  # read by its kind

    @field_validator("encoder_sigma")
    @classmethod
    def _is_that_of_an_encoder(cls, sigma: float) -> float:
        least, most = ENCODER_SIGMAS
        if not least <= sigma <= most:
            raise ValueError(
                f"found {sigma:g} m, needed {least:g} to {most:g} m; give one standard deviation "
                "of a reading in metres."
            )
        return sigma
