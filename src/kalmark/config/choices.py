"""The sections that the declarations of models make, and the choice of one by its `type`."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin

from pydantic import Field, PlainValidator, create_model
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

import kalmark.association
import kalmark.detect
import kalmark.filter.estimators
import kalmark.management.attention
import kalmark.management.initialization
import kalmark.management.upkeep
import kalmark.models.landmarks
import kalmark.models.motion
import kalmark.models.sensors  # noqa: F401 - all of these register their models
from kalmark.config.sections import Section, expected
from kalmark.declare import (
    Parameter,
    class_of,
    classes,
    is_own,
    load_plugin,
    parameters,
    plugin_of,
    register_by_file,
    summary,
    world_of_class,
)
from kalmark.errors import ModelError

BASES: dict[tuple[str, str], type[Section]] = {}  # by role and world: what all sections of that choice have


class ModelSection(Section):
    """A section that describes a model: its keys are the model's parameters."""

    of_role: ClassVar[str] = ""
    of_name: ClassVar[str] = ""
    of_world: ClassVar[str] = ""

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Return how a worker makes it again: the class is made there, of the declarations."""
        models = classes(self.of_role, self.of_world)[self.of_name]
        return _unpickled, (self.of_role, self.of_name, self.of_world, plugin_of(models[0])), self.__getstate__()


class Choice:
    """The section of one model of a role, by its `type`; without `typed` there is one model, and no type.

    With `sensor`, a class, it is that of a detector for it.
    """

    def __init__(
        self, role: str, world: str = "", default: str | None = None, *, typed: bool = True, sensor: Any = None
    ) -> None:
        self.role, self.world, self.default, self.typed, self.sensor = role, world, default, typed, sensor

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        """Return how pydantic validates it: at the time, as a plugin may have added models since."""
        return core_schema.no_info_plain_validator_function(self.validated)

    def names(self) -> list[str]:
        """Return the types there are."""
        found = classes(self.role, self.world)
        return [name for name, models in found.items() if self.sensor is None or finds(models[0], self.sensor)]

    def validated(self, value: Any) -> Section:
        """Return the section of a mapping.  Raises the errors of pydantic."""
        if isinstance(value, ModelSection):
            return value
        name: Any = self.role
        if self.typed:
            if not self.names():
                raise expected("nothing: no detector finds what this sensor measures")
            name = value.get("type", self.default) if isinstance(value, dict) else None
            if name is None:
                raise PydanticCustomError("union_tag_not_found", "no type", {"types": self.names()})
            if name not in self.names() and not (isinstance(name, str) and register_by_file(self.role, name)):
                raise PydanticCustomError("union_tag_invalid", "unknown type", {"types": self.names()})
        section = section_of(self.role, name, self.world).model_validate(value)
        try:
            model_of(section, self.world)
        except ModelError as error:
            if error.key:
                raise expected(error.wanted, error.key) from None
        return section


def finds(detector: Any, sensor: Any) -> bool:
    """Return whether a detector's class may find what a sensor's measures: if both are kalmark's, by their columns."""
    return not (is_own(detector) and is_own(sensor)) or detector.columns[:2] == sensor.columns[:2]


def section_of(role: str, name: str, world: str = "") -> type[Section]:
    """Return the section of a model; it has `type` where a role has several models."""
    return _section(role, name, world, tuple(classes(role, world)[name]))


@cache
def _section(role: str, name: str, world: str, models: tuple[type, ...]) -> type[Section]:
    fields: dict[str, Any] = {} if name == role else {"type": (str, name)}
    if role == "sensor":
        fields["detector"] = (Annotated[Any, Choice("detector", sensor=models[0])] | None, None)
    for parameter in parameters(models[0]):
        others = [own for model in models[1:] for own in parameters(model) if own.name == parameter.name]
        fields[parameter.name] = _field(parameter, others, models)
    base = BASES.get((role, world), ModelSection)
    text = "  ".join(dict.fromkeys(map(summary, models)))
    made: Any = create_model(name, __base__=base, __doc__=text, **fields)
    made.of_role, made.of_name, made.of_world = role, name, world
    return made


def _field(parameter: Parameter, others: list[Parameter], models: tuple[type, ...]) -> tuple[Any, Any]:
    """Return a parameter as a field; where the plane and space have different defaults, it has none."""
    kind, default, text = _annotation(parameter), parameter.default, parameter.text
    if any(other.default != default for other in others):
        worlds = [f"{own.default:g} in {_in(model)}" for own, model in zip([parameter, *others], models, strict=True)]
        kind, default, text = kind | None, None, f"{text[:-1]}; if absent {', '.join(worlds)}."
    return kind, Field(default=default, description=text or None)


def _in(model: type) -> str:
    return "the plane" if world_of_class(model) == "plane" else "space"


def _annotation(parameter: Parameter) -> Any:
    """Return what pydantic validates a parameter by."""
    kind: Any = parameter.type
    if kind is None:
        kind = Literal[parameter.words]
    elif parameter.words:
        kind = Annotated[Any, PlainValidator(_refusing(parameter))]
    elif get_origin(kind) is tuple:
        items = tuple(item if item is ... else _number(item, parameter) for item in get_args(kind))
        kind = Annotated[tuple[items], Field(strict=False)]  # type: ignore[valid-type]
    elif kind in (int, float):
        kind = _number(kind, parameter)
    return kind | None if parameter.optional else kind


def _number(kind: Any, parameter: Parameter) -> Any:
    bounds: dict[str, Any] = dict(parameter.within.limits)
    return Annotated[kind, Field(**bounds, allow_inf_nan=None if kind is int else parameter.within.infinite)]


def _refusing(parameter: Parameter) -> Any:
    def validated(value: Any) -> Any:
        if parameter.refused(value):
            raise expected(parameter.wanted)
        return value

    return validated


def model_of(section: Any, world: str = "plane") -> Any:
    """Return the model that a section describes, of the plane or of space where its type leaves that open.

    Raises ModelError if the model refuses its parameters.
    """
    model = class_of(section.of_role, section.of_name, world)
    given = {own.name: value for own in parameters(model) if (value := getattr(section, own.name)) is not None}
    return model(**given)


def _unpickled(role: str, name: str, world: str, plugin: Path | None) -> Section:
    if plugin is not None:
        load_plugin(plugin)
    section = section_of(role, name, world)
    return section.__new__(section)
