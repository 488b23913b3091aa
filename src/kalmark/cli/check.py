"""`kalmark check`: the Jacobians of a user's own model against differences."""

from __future__ import annotations

import sys
from importlib import import_module, util
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kalmark.cli.tables import print_table
from kalmark.errors import KalmarkError, ModelError

if TYPE_CHECKING:
    from kalmark.models.check import Finding


def check_named(name: str) -> list[Finding]:
    """Return what was found about the model ``module:Class``, ``file.py:Class`` or ``module:object``."""
    import numpy as np

    from kalmark.models.check import check_model

    model = _model(name)
    try:
        return check_model(model, np.random.default_rng(0))
    except ModelError as error:
        raise ModelError(f"{name}: {error}") from None
    except Exception as error:
        raise ModelError(f"{name}: raised {type(error).__name__}: {error}{_line_of(error)}") from None


def check(
    model: Annotated[str, typer.Argument(metavar="module:Class", help="The model; also file.py:Class, or an object.")],
) -> None:
    """Check a model of your own: shapes, and Jacobians against differences."""
    findings = check_named(model)
    rows = [(f.what, f"{f.error:.1e}", "" if f.ok else f"wrong at {f.where}") for f in findings]
    print_table(model, ("check", "difference", ""), rows, align="<><")
    wrong = [f for f in findings if not f.ok]
    if wrong:
        worst = max(wrong, key=lambda f: f.error)
        raise ModelError(f"{model}: {worst.what} differs by {worst.error:.2g} at {worst.where}, expected 0")


def _model(name: str) -> Any:
    place, _, attribute = name.partition(":")
    if not place or not attribute:
        raise KalmarkError(f"{name}: expected module:Class or file.py:Class")
    module = _module(place, name)
    try:
        model = getattr(module, attribute)
    except AttributeError:
        raise KalmarkError(f"{name}: {place} has no {attribute}, expected a class or an object") from None
    if not isinstance(model, type):
        return model
    try:
        return model()
    except TypeError as error:
        raise KalmarkError(f"{name}: {error}; expected a model whose every parameter has a default") from None


def _module(place: str, name: str) -> ModuleType:
    try:
        if not place.endswith(".py"):
            sys.path.insert(0, str(Path.cwd()))
            return import_module(place)
        spec = util.spec_from_file_location(Path(place).stem, place)
        if spec is None or spec.loader is None:
            raise KalmarkError(f"{name}: {place} cannot be imported")
        module = util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        return module
    except KalmarkError:
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}{_line_of(error)}"
        raise KalmarkError(f"{name}: {place} cannot be imported: {what}") from None


def _line_of(error: BaseException) -> str:
    """Return where in the user's file an error came from."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return f" ({trace.tb_frame.f_code.co_filename}:{trace.tb_lineno})" if trace is not None else ""
