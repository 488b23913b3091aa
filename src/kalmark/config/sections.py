"""The pieces that configuration sections are made of: strictness, numbers, choices by `type`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, model_validator
from pydantic_core import PydanticCustomError

Number = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

# What the contract names and later versions bring: refused by name, not as a spelling mistake.
LATER: dict[str, tuple[str, ...]] = {
    "motion": ("inertial",),
    "sensor": ("position_fix",),
    "landmark": (),
    "association": (),
    "estimator": (),
    "map": (),
}


class Section(BaseModel):
    """A frozen mapping of keys, each with its default; unknown keys and loosely typed values are refused.

    `elsewhere` says of keys that another section of this kind has what they are here.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
    elsewhere: ClassVar[dict[str, str]] = {}

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: Any) -> Any:
        if isinstance(value, dict):
            for key in value:
                if key not in cls.model_fields:
                    what = cls.elsewhere.get(key, "an unknown key")
                    told = {"key": key, "what": what, "keys": [*cls.model_fields]}
                    raise PydanticCustomError("unknown_key", "unknown key", told)
        return value


def expected(what: str, *below: str) -> PydanticCustomError:
    """Return the error of a value that should have been `what`; `below` leads from the section to that value."""
    return PydanticCustomError("expected", "{what}", {"what": what, "below": below})


def type_or(default: str | None = None) -> Callable[[Any], str | None]:
    """Return the discriminator of a choice by `type`; `default` is the type of a section that names none."""

    def discriminate(value: Any) -> str | None:
        if not isinstance(value, dict):
            return getattr(value, "type", None)
        kind = value.get("type", default)
        return kind if kind is None or isinstance(kind, str) else repr(kind)

    return discriminate


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _sigmas(value: Any) -> float | tuple[float, ...]:
    three = value if isinstance(value, list | tuple) else [value] * 3
    if len(three) == 3 and all(_is_number(v) and 0 <= v < math.inf for v in three):
        return tuple(map(float, three)) if isinstance(value, list | tuple) else float(value)
    raise expected("a number >= 0, or a list of three: one for each axis")


Sigmas = Annotated[float | tuple[float, ...], PlainValidator(_sigmas)]


def _linearity(value: Any) -> float | str:
    if value == "off":
        return "off"
    if _is_number(value) and 0 < value < math.inf:
        return float(value)
    raise expected("a number > 0, or off")


Linearity = Annotated[float | str, PlainValidator(_linearity)]


def _robot(value: Any) -> int | str:
    if isinstance(value, str) or (isinstance(value, int) and not isinstance(value, bool)):
        return value
    raise expected("a robot's name or number")


RobotName = Annotated[int | str, PlainValidator(_robot)]
