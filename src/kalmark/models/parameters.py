"""The check that a model's parameters are numbers it can work with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

from kalmark.errors import ModelError

PRIORS = ("sigma_scale", "sigma_bias_m")  # of what may be known exactly
NEVER_NEGATIVE = ("sigma", "range", "fov", "wheelbase", "min_length")


def check_parameters(model: Any, *, noise: str = "", positive: tuple[str, ...] = ()) -> None:
    """Refuse a model with a parameter that is not finite, a negative sigma, or a `noise` sigma or `positive` of zero.

    Limits of sight (`..._max_m`) may be infinite.
    """
    name = type(model).__name__
    for key, value in vars(model).items():
        if key in ("lens", "extend"):
            continue
        if isinstance(value, Sequence) and not isinstance(value, str):
            refuse_odd_numbers(f"{name}: {key}", value)
            continue
        if not isinstance(value, Real) or isinstance(value, bool):
            raise ModelError(f"{name}: {key} is {value!r}, expected a number")
        number = float(value)
        if math.isnan(number) or (math.isinf(number) and not key.endswith("_max_m")):
            raise ModelError(f"{name}: {key} is {value}, expected a finite number")
        above = key in positive or (noise and key.startswith(noise) and not key.endswith("_rel") and key not in PRIORS)
        if key == "sigma_range_m" and getattr(model, "sigma_range_rel", 0.0) > 0:
            above = False  # the noise may be all relative
        if above and number <= 0:
            raise ModelError(f"{name}: {key} is {value}, expected a positive number")
        if number < 0 and key.startswith(NEVER_NEGATIVE):
            raise ModelError(f"{name}: {key} is {value}, expected a number of at least 0")


def refuse_odd_numbers(what: str, values: Sequence[Any]) -> None:
    """Refuse a list in which anything is not a finite number."""
    for value in values:
        if not isinstance(value, Real) or isinstance(value, bool) or not math.isfinite(value):
            raise ModelError(f"{what} holds {value!r}, expected finite numbers")
