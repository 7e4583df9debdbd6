"""What every section of the settings is made of: its base, the types of its fields, the letters of the sources."""

from collections.abc import Mapping
from typing import Annotated, Literal

from msgspec import Meta

# What the letters at the end of the comments stand for.
SOURCES: Mapping[str, str] = {
    "P": "the paper",
    "M": "MimicKit, the code base that the paper builds on",
    "A": "acme's GAIL",
    "W": "WAIL (arXiv 1906.08113)",
    "L": "PWIL (arXiv 2006.04678)",
    "S": "SMP in MimicKit",
    "J": "mjlab",
    "U": "unitree_rl_lab",
    "H": "HoloSoma",
    "Y": "MuJoCo Playground",
    "D": "decided here, where these are silent",
}

PositiveInt = Annotated[int, Meta(ge=1)]
NonNegativeInt = Annotated[int, Meta(ge=0)]
PositiveFloat = Annotated[float, Meta(gt=0)]
NonNegativeFloat = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(gt=0, le=1)]
Decay = Annotated[float, Meta(ge=0, lt=1)]  # what remains of an average in a step
Widths = tuple[PositiveInt, ...]  # units of the hidden layers
Optimizer = Literal["sgd", "adam"]


class Section:
    """What every section has."""

    def check(self) -> None:
        """Raise a `UserError` where the section's values do not go together."""
