"""A model is declared once: a frozen dataclass whose fields carry bounds and a line of documentation, under a name.

    @register("sensor", "sonar")
    class Sonar:
        sigma_range_m: Annotated[float, Within(gt=0), "Noise of the range."] = 0.1

From that follow the checks when one is made, the section of a configuration and its documentation, and what is saved.
A parameter's unit is the end of its name.  The first paragraph of the class's docstring is its documentation.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import operator
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import util
from numbers import Integral, Real
from pathlib import Path
from types import FunctionType, ModuleType, NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, dataclass_transform, get_args, get_origin, get_type_hints

import numpy as np

from kalmark.errors import KalmarkError, ModelError, PluginError
from kalmark.events import bound, largest_magnitude, short_text
from kalmark.geometry.spaces import Space
from kalmark.plugins import load_all

__all__ = [
    "Count", "Estimated", "Limit", "NotNegative", "Number", "Parameter", "Positive", "Probability", "Role", "Values",
    "Within", "declared", "parameters", "register",
]  # fmt: skip

Class = TypeVar("Class", bound=type)
Function = TypeVar("Function", bound=Callable[..., Any])

UNITS = {
    "_mps2_per_sqrt_s": "m/s^2/sqrt(s)",
    "_mps_per_sqrt_s": "m/s/sqrt(s)",
    "_radps_per_sqrt_s": "rad/s/sqrt(s)",
    "_m_per_sqrt_s": "m/sqrt(s)",
    "_rad_per_sqrt_s": "rad/sqrt(s)",
    "_per_sqrt_s": "1/sqrt(s)",
    "_m_per_sqrt_m": "m/sqrt(m)",
    "_per_m": "1/m",
    "_mps2": "m/s^2",
    "_mps": "m/s",
    "_radps": "rad/s",
    "_rad": "rad",
    "_deg": "deg",
    "_px": "px",
    "_m": "m",
    "_s": "s",
    "r_max": "m",
}


@dataclass(frozen=True)
class Within:
    """The bounds of a number, or of each number of a list; without `infinite` it is finite.

    >>> Within(gt=0).holds(0.0)
    False
    """

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    infinite: bool = False

    @property
    def limits(self) -> dict[str, float]:
        """The bounds that there are, by name."""
        named = {"ge": self.ge, "gt": self.gt, "le": self.le, "lt": self.lt}
        return {name: value for name, value in named.items() if value is not None}

    def holds(self, value: float) -> bool:
        """Return whether a number is within."""
        if math.isnan(value) or (math.isinf(value) and not self.infinite):
            return False
        return all(vars(operator)[name](value, limit) for name, limit in self.limits.items())

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return how pydantic validates a number of a section: as a parameter of a model that has its name."""
        from pydantic_core import core_schema

        own = Parameter(handler.field_name or "", source, None, False, (), self, "")
        return core_schema.no_info_plain_validator_function(lambda value: source(own.validated(value)))

    def words(self, kind: str) -> str:
        """Return what is expected: `kind` is "number" or "whole number"."""
        if self.lt is not None and self.gt is not None:
            what = "probability" if (self.gt, self.lt) == (0, 1) else kind
            return f"a {what} between {self.gt:g} and {self.lt:g}"
        if not self.limits:
            return f"a {kind}" if self.infinite else f"a finite {kind}"
        above = f"a positive {kind}" if self.gt == 0 else f"a {kind}" if self.gt is None else f"a {kind} > {self.gt:g}"
        above += "" if self.ge is None else f" of at least {self.ge:g}"
        below = "" if self.le is None else f" up to {self.le:g}"
        return above + below + ("" if self.lt is None else f" below {self.lt:g}")


Number = Annotated[float, Within()]
"""The type of a parameter: any finite number."""
NotNegative = Annotated[float, Within(ge=0)]
"""The type of a parameter: a number of at least 0."""
Estimated = Annotated[NotNegative, "; above 0 it is in the map and is estimated."]
"""The sigma of what the filter may estimate; its line of documentation ends with this."""
Positive = Annotated[float, Within(gt=0)]
"""The type of a parameter: a number above 0."""
Limit = Annotated[float, Within(gt=0, infinite=True)]
"""The type of a parameter: a number above 0, or infinity for none."""
Probability = Annotated[float, Within(gt=0, lt=1)]
"""The type of a parameter: a probability, neither 0 nor 1."""
Count = Annotated[int, Within(ge=1)]
"""The type of a parameter: a whole number of at least 1."""


@dataclass(frozen=True)
class Values:
    """The values of a mapping: models of a `role`, each with its `type`, or texts.

    A text with this `ending` is a file, which is looked for beside the configuration.

    >>> Values(role="motion"), Values(ending=".csv")
    (Values(role='motion', ending=''), Values(role='', ending='.csv'))
    """

    role: str = ""
    ending: str = ""


@dataclass(frozen=True)
class Role:
    """The value is a model of this role, which its owner checks.

    >>> Role("landmark")
    Role(name='landmark')
    """

    name: str


@dataclass(frozen=True)
class Parameter:
    """A field of a model, or an option: `type` is without None and without the `words` that it may be instead.

    >>> one = parameters(km.sensors.Bearing)[0]
    >>> one.name, one.default, one.unit, one.wanted
    ('sigma_bearing_rad', 0.02, 'rad', 'a positive number')
    """

    name: str
    type: Any
    default: Any
    optional: bool
    words: tuple[str, ...]
    within: Within
    text: str
    values: Values | None = None
    role: str = ""

    @property
    def unit(self) -> str:
        """The unit, by the end of the name."""
        return unit_of(self.name)

    @property
    def wanted(self) -> str:
        """The expected value, in words."""
        if self.values is not None:
            return "a mapping"
        if self.type is None:
            return f"one of {', '.join(self.words)}"
        number = self.within.words("whole number" if self.type is int else "number")
        kinds = [{bool: "True or False", str: "a text"}.get(self.type, number), *self.words]
        return " or ".join(filter(None, [", ".join(kinds[:-1]), kinds[-1]]))

    @property
    def on_a_line(self) -> str:
        """The parameter on a line: name, default, unit, meaning and bounds."""
        default = "" if self.default is None or self.role else f" = {self.default!r}"
        expected = "" if self.type is Any else f"  Expected: {self.wanted}."
        return f"{self.name}{default}{self.unit and f' [{self.unit}]'}: {self.text}{expected}"

    def refused(self, value: Any) -> str:
        """Return what a value is to be instead, nothing if it is that."""
        if (value is None and self.optional) or (isinstance(value, str) and value in self.words):
            return ""
        truth = isinstance(value, bool | np.bool_)
        if self.type in (bool, str):
            return "" if truth == (self.type is bool) and (truth or isinstance(value, str)) else self.wanted
        if self.type in (int, float):
            if truth or not isinstance(value, Integral if self.type is int else Real):
                return self.wanted if self.type is int or self.words else "a number"
            try:
                number = float(value)
            except OverflowError:
                number = -math.inf if operator.lt(value, 0) else math.inf
            if self.within.holds(number):
                return (
                    f"a number of {bound(self.name)}"
                    if largest_magnitude(self.name)[0] < abs(number) < math.inf
                    else ""
                )
            return self.wanted if math.isfinite(number) or self.within.infinite or self.words else "a finite number"
        if get_origin(self.type) is tuple:
            kind, *more = get_args(self.type)
            size = None if more == [...] else 1 + len(more)
            one = Parameter("", kind, None, False, (), self.within, "")
            if isinstance(value, list | tuple) and size in (None, len(value)) and not any(map(one.refused, value)):
                return ""
            if size is None:
                return "a list of texts" if kind is str else "a list of finite numbers"
            return f"{size} numbers, each {one.wanted}"
        if self.values is not None:
            return "" if isinstance(value, Mapping) else self.wanted
        return self.wanted if self.type is None else ""

    def validated(self, value: Any) -> Any:
        """Return a value as a section of a configuration has it.  Raises the error of pydantic."""
        from pydantic_core import PydanticCustomError

        wanted = self.refused(value)
        if wanted and self.type is None:
            raise PydanticCustomError("literal_error", "another word", {"expected": str(self.words)})
        if wanted:
            raise PydanticCustomError("expected", "{what}", {"what": wanted})
        return tuple(value) if isinstance(value, list) else value


def unit_of(name: str) -> str:
    """Return the unit that a name ends in, "" for none."""
    return next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")


def parameters(model: Any) -> tuple[Parameter, ...]:
    """Return the parameters of a model's class: its fields, or those of its constructor; or of a function.

    >>> [one.name for one in parameters(km.sensors.Bearing)][:2]
    ['sigma_bearing_rad', 'range_min_m']
    """
    return _parameters(model)


@cache
def _parameters(model: Any) -> tuple[Parameter, ...]:
    hints = _hints(model)
    named: list[Any] = []
    if dataclasses.is_dataclass(model):
        named = [field for field in dataclasses.fields(model) if field.init]
        named.sort(key=lambda field: bool(field.kw_only))
    elif not isinstance(model, type) or has_constructor(model):
        named = [*inspect.signature(model).parameters.values()]
    return tuple(_parameter(each.name, each.default, hints.get(each.name, Any)) for each in named)


def has_constructor(model: type) -> bool:
    """Return whether a class has a constructor that somebody wrote: it is no dataclass, and is not made one."""
    first = next(each for each in model.__mro__ if "__init__" in vars(each))
    made = vars(first)["__init__"]
    return isinstance(made, FunctionType) and made.__module__ != "typing" and not dataclasses.is_dataclass(first)


def declared_options(of: Any) -> tuple[Parameter, ...]:
    """Return the parameters of a class or a function that have a line of documentation: the options of a robot."""
    return tuple(each for each in parameters(of) if each.text)


def _hints(of: Any, include_extras: bool = True) -> dict[str, Any]:
    try:
        return get_type_hints(of, include_extras=include_extras)
    except (NameError, TypeError):  # of a user: types that only a checker can see, or an object that is called
        return {}


def _parameter(name: str, default: Any, hint: Any) -> Parameter:
    hint, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    words = tuple(word for part in parts if get_origin(part) is Literal for word in get_args(part))
    kinds = [part for part in parts if part is not NoneType and get_origin(part) is not Literal]
    bounds = next((extra for extra in extras if isinstance(extra, Within)), Within(infinite=True))
    role = next((extra.name for extra in extras if isinstance(extra, Role)), "")
    return Parameter(
        name,
        kinds[0] if len(kinds) == 1 and not role else Any if kinds else None,
        None if any(default is none for none in (dataclasses.MISSING, inspect.Parameter.empty)) else default,
        NoneType in parts,
        words,
        bounds,
        "".join(extra for extra in reversed(extras) if isinstance(extra, str)),
        next((extra for extra in extras if isinstance(extra, Values)), None),
        role,
    )


def refuse(model: Any, key: str, wanted: str, what: str | None = None) -> ModelError:
    """Return the error of a model's parameter that is not what is `wanted`, which has `key` and `wanted`, too.

    The message begins with `what`, or with the name of the model's class.
    """
    begin = f"{type(model).__name__}: " if what is None else what
    error = ModelError(f"{begin}{key} is {short_text(vars(model)[key])}, expected {wanted}")
    error.key, error.wanted = key, wanted
    return error


def check_parameters(model: Any, what: str | None = None) -> None:
    """Refuse a model, `what` in the message, with a parameter that is not as declared.  Raises ModelError.

    Numbers of NumPy become Python's: a float32 would be squared in float32, and read from a file it is none.
    """
    for parameter in parameters(type(model)):
        value = vars(model)[parameter.name]
        wanted = parameter.refused(value)
        if wanted:
            raise refuse(model, parameter.name, wanted, what)
        if isinstance(value, np.generic):
            object.__setattr__(model, parameter.name, value.item())


def summary(model: type) -> str:
    """Return the first paragraph of a class's docstring, on one line."""
    return " ".join((inspect.getdoc(model) or "").partition("\n\n")[0].split())


class _Readable:
    """The signature of a declared class, its types without bounds and texts.  It is made when it is read."""

    def __get__(self, instance: Any, model: Any) -> inspect.Signature:
        types, is_class = _hints(model, include_extras=False), dataclasses.is_dataclass(model)
        named = [*inspect.signature(model.__init__ if is_class else model).parameters.values()][is_class:]
        return inspect.Signature(
            [each.replace(annotation=types.get(each.name, each.empty)) for each in named],
            return_annotation=types.get("return", inspect.Signature.empty),
        )


@dataclass(frozen=True)
class _Documented:
    """The docstring of a declared class with its parameters.  It is made when it is read."""

    text: str

    def __get__(self, instance: Any, model: Any) -> str:
        rows = [each.on_a_line for each in declared_options(model)]
        name = registered_name(model)
        named = f"  In a configuration: `type: {name}`." if name else ""
        return "\n    ".join([f"{inspect.cleandoc(self.text)}\n\nParameters.{named}\n", *rows]) if rows else self.text


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def declared(model: Class) -> Class:
    """Make a class a frozen dataclass whose parameters are checked when one is made, and shown by `help`.

    >>> class Budget:
    ...     count: Count = 10
    >>> Budget = declared(Budget)  # or above the class: @declared
    >>> Budget(count=5)
    Budget(count=5)
    """
    if "__dataclass_params__" in vars(model) or has_constructor(model):  # a user's, made in another way
        return model
    after = next((vars(each)["__post_init__"] for each in model.__mro__ if "__post_init__" in vars(each)), None)
    if after not in _CHECKS:

        def __post_init__(self: Any) -> None:
            check_parameters(self)
            if after is not None:
                after(self)

        _CHECKS.add(__post_init__)
        model.__post_init__ = __post_init__  # type: ignore[attr-defined]
    made: Any = dataclass(frozen=True)(model)
    return documented(made)


def documented(of: Function) -> Function:
    """Show the parameters of a dataclass, or of a function, by `help`: their bounds and texts below its docstring."""
    made: Any = of
    signature, doc = _Readable(), _Documented(made.__doc__)
    if dataclasses.is_dataclass(of):
        made.__init__.__annotations__, made.__signature__, made.__doc__ = {}, signature, doc
    else:
        made.__signature__, made.__doc__ = signature.__get__(None, of), doc.__get__(None, of)
    return of


# ------------------------------------------------------------------ names
_CHECKS: set[Any] = set()
_CLASSES: dict[str, dict[str, list[type]]] = {}
_PLUGINS: dict[Path, ModuleType] = {}


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def register(role: str, name: str) -> Callable[[Class], Class]:
    """Make a class a frozen dataclass, checked when one is made, under its name in configurations.

    `role` is "motion", "sensor", "landmark", "association", "estimator", "detector" or "initialization".  A name may
    stand for two classes, one of the plane and one of space.  Raises ModelError if kalmark has that name already.

    >>> class Mine(km.sensors.RangeBearing):
    ...     pass
    >>> Mine = km.register("sensor", "my_lidar")(Mine)  # or above the class: @km.register("sensor", "my_lidar")
    >>> Mine().columns
    ('range_m', 'bearing_rad')
    """

    def registered(model: Class) -> Class:
        model = declared(model)
        others = _CLASSES.setdefault(role, {}).setdefault(name, [])
        if not is_own(model) and any(map(is_own, others)):
            raise ModelError(f"{model.__name__}: {name!r} is a {role} of kalmark, expected another name")
        others[:] = [other for other in others if is_own(other) or world_of_class(other) != world_of_class(model)]
        others.append(model)
        return model

    return registered


def is_own(model: Any) -> bool:
    """Return whether a class or a function is of kalmark itself."""
    return model.__module__.split(".")[0] == "kalmark"


@cache
def world_of_class(model: Any) -> str:
    """Return "plane" or "space", where a model's class lives, "" for either."""
    named = {name: value for each in reversed(model.__mro__) for name, value in vars(each).items()}
    world = named["space"].world if isinstance(named.get("space"), Space) else named.get("world", "")
    return world if isinstance(world, str) else ""


def classes(role: str, world: str = "") -> dict[str, list[type]]:
    """Return the classes of a role by name, of a world or, for "", of all: those of space last."""
    missing_models()
    fitting = {name: classes_of(role, name, world) for name in _CLASSES.get(role, {})}
    found = [(name, models) for name, models in fitting.items() if models]
    return dict(sorted(found, key=lambda each: world_of_class(each[1][0]) == "space"))


def roles() -> list[str]:
    """Return the roles that have models."""
    return [*_CLASSES]


def built_in(role: str) -> tuple[Any, ...]:
    """Return the classes of a role that are kalmark's own."""
    return tuple(model for models in _CLASSES.get(role, {}).values() for model in models if is_own(model))


def has_one_model(role: str) -> bool:
    """Return whether a role has one model, which has its name: its section has no `type`."""
    return role in _CLASSES.get(role, {})


def class_of(role: str, name: str, world: str = "") -> type:
    """Return the class of a name, of a world where the name stands for two.  Raises KeyError."""
    models = classes_of(role, name)
    return next((model for model in models if world in ("", world_of_class(model))), models[0])


def classes_of(role: str, name: str, world: str = "") -> list[type]:
    """Return the classes of a name, of a world or, for "", of all; plug-ins are loaded if the core has none.

    file.py:Class, which a plugin of the user's has, is registered under this name.

    Raises KeyError if no class has this name.
    """
    if not _fitting(role, name, world):
        missing_models()
    if name not in _CLASSES.get(role, {}):
        if (model := class_of_file(name)) is None:
            raise KeyError(name)
        register(role, name)(model)
    return _fitting(role, name, world)


def _fitting(role: str, name: str, world: str) -> list[type]:
    models = _CLASSES.get(role, {}).get(name, ())
    return [model for model in models if world in ("", world_of_class(model)) or not world_of_class(model)]


@cache
def missing_models() -> tuple[PluginError, ...]:
    """Load the models of all plug-ins, and return the errors of those that cannot be loaded."""
    return tuple(load_all("models")[1].values())


def registered_name(model: type) -> str | None:
    """Return the name of a class in configurations, None if it has none."""
    named = (name for by_name in _CLASSES.values() for name, models in by_name.items() if model in models)
    return next(named, None)


def own_name(model: type) -> str:
    """Return how a user's class or function without a name is called: file.py:Class, or module:Class without a file."""
    file = _file_of(sys.modules.get(model.__module__))
    return f"{model.__module__ if file is None else file.name}:{model.__qualname__}"


# ------------------------------------------------------------------ a user's own files
def load_plugin(file: Path) -> ModuleType:
    """Run a Python file of the user's, unless it is imported already, and return it.

    Models that it registers are known from then on.  Raises KalmarkError if it cannot be run.
    """
    file = file.resolve()
    if file not in _PLUGINS:
        imported = (module for module in [*sys.modules.values()] if _file_of(module, file.name) == file)
        _PLUGINS[file] = next(imported, None) or _run(file)
    return _PLUGINS[file]


def _run(file: Path) -> ModuleType:
    name = f"plugin_{file.stem}"
    spec = util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None or not file.is_file():
        raise KalmarkError(f"{file}: no such file, expected Python code")
    module = sys.modules[name] = util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise KalmarkError(f"{file} cannot be run: {type(error).__name__}: {error}{line_of_error(error)}") from None
    return module


def _file_of(module: Any, ending: str = "") -> Path | None:
    """Return the file of a module if it has one, with this ending of its name."""
    file = vars(module).get("__file__") if isinstance(module, ModuleType) else None
    return Path(file).resolve() if isinstance(file, str) and file.endswith(ending) else None


def plugin_of(model: Any) -> Path | None:
    """Return the file of a user's class or function, None of kalmark's own and where there is no file."""
    return None if is_own(model) else _file_of(sys.modules.get(model.__module__))


def class_of_file(name: str) -> type | None:
    """Return the class that a plugin has of the name file.py:NAME, None if none has it.

    Of an object of that name, such as a sensor of `km.pointwise`, it is a class that makes this object.
    """
    place, _, attribute = name.rpartition(":")
    for file, module in _PLUGINS.items():
        if place in (file.stem, file.name, str(file)) and (model := vars(module).get(attribute)) is not None:
            made = {"__module__": module.__name__, "__new__": lambda cls: model}
            return model if isinstance(model, type) else type(attribute, (), made)
    return None


def place_of_object(value: Any) -> tuple[Path, str] | None:
    """Return the user's file that has a class or another object, and the name it has there; None if none has it."""
    own = sys.modules.get(getattr(value, "__module__", ""))  # is looked at first
    homes = ((_file_of(module, ".py"), module) for module in (own, *sys.modules.values()) if module)
    named = ((file, home, name) for file, home in homes if file for name, one in vars(home).items() if one is value)
    return next(((file, name) for file, home, name in named if home.__name__.partition(".")[0] != "kalmark"), None)


def line_of_error(error: BaseException) -> str:
    """Return where in the user's file an error came from."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return f" ({trace.tb_frame.f_code.co_filename}:{trace.tb_lineno})" if trace is not None else ""
