"""`kalmark check`: the Jacobians of a user's own model against differences."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from kalmark.cli.shared import print_table
from kalmark.errors import KalmarkError, ModelError


def check(
    model: Annotated[str, typer.Argument(metavar="module:Class", help="Also file.py:Class, an object or a function.")],
) -> None:
    """Check a model of your own: shapes, and Jacobians against differences."""
    import numpy as np

    from kalmark.declare import line_of_error
    from kalmark.models.model_check import check_model

    found = _model(model)
    try:
        findings = check_model(found, np.random.default_rng(0))
    except ModelError as error:
        raise ModelError(f"{model}: {error}") from None
    except Exception as error:
        raise ModelError(f"{model}: raised {type(error).__name__}: {error}{line_of_error(error)}") from None
    rows = [(f.what, f"{f.error:.1e}", "" if f.ok else f"wrong at {f.where}") for f in findings]
    print_table(model, ("check", "difference", ""), rows, align="<><")
    wrong = [f for f in findings if not f.ok]
    if wrong:
        worst = max(wrong, key=lambda f: f.error)
        raise ModelError(f"{model}: {worst.what} differs by {worst.error:.2g} at {worst.where}, expected 0")


def _model(name: str) -> Any:
    from kalmark.declare import line_of_error, load_plugin

    place, _, attribute = name.partition(":")
    if not place or not attribute:
        raise KalmarkError(f"{name}: expected module:Class or file.py:Class")
    if place.endswith(".py"):
        module = load_plugin(Path(place))
    else:
        try:
            sys.path.insert(0, str(Path.cwd()))
            module = import_module(place)
        except Exception as error:
            what = f"{type(error).__name__}: {error}{line_of_error(error)}"
            raise KalmarkError(f"{name}: {place} cannot be imported: {what}") from None
    if attribute not in vars(module):
        raise KalmarkError(f"{name}: {place} has no {attribute}, expected a class, an object or a function")
    model = vars(module)[attribute]
    if not isinstance(model, type):
        return model
    try:
        return model()
    except TypeError as error:
        raise KalmarkError(f"{name}: {error}; expected a model whose every parameter has a default") from None
