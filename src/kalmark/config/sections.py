"""The pieces that configuration sections are made of: strictness, numbers, and the choice of a section by its `type`.

The sections of models are made from their declarations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, ValidationInfo, create_model, model_validator
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from kalmark.declare import (
    Number,
    Parameter,
    Within,
    classes,
    classes_of,
    has_one_model,
    load_plugin,
    missing_models,
    parameters,
    plugin_of,
    summary,
    world_of_class,
)
from kalmark.errors import EventError, ModelError
from kalmark.events import Id, checked_id
from kalmark.plugins import entry_points_of, load
from kalmark.slam.description import model_described
from kalmark.slam.sources import finds

USUAL = {
    "landmark": "point", "association": "identity", "estimator": "invariant", "initialization": "immediate"
}  # fmt: skip
"""The type of a section that names none, by role."""


class Section(BaseModel):
    """A frozen mapping of keys, each with its default; unknown keys and loosely typed values are refused.

    `elsewhere` explains the keys that another section of this kind has.
    """

    # what a command does not read is not built: a third of the time to import the configuration
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)
    elsewhere: ClassVar[dict[str, str]] = {}

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: Any) -> Any:
        if isinstance(value, dict):
            for key in value:
                if key not in cls.model_fields:
                    raise unknown_key(key, cls.elsewhere.get(key, "an unknown key"), [*cls.model_fields])
        return value


def unknown_key(key: str, what: str, keys: list[str]) -> PydanticCustomError:
    """Return the error of a key that a section with these keys does not have."""
    return PydanticCustomError("unknown_key", "unknown key", {"key": key, "what": what, "keys": keys})


def unexpected_value(what: str, *below: str) -> PydanticCustomError:
    """Return the error of a value that should have been `what`; `below` leads from the section to that value."""
    return PydanticCustomError("expected", "{what}", {"what": what, "below": below})


def _sigmas(value: Any, info: ValidationInfo) -> float | tuple[float, ...]:
    several = isinstance(value, list | tuple)
    three = value if several else [value] * 3
    own = Parameter(info.field_name or "", float, None, False, (), Within(ge=0), "")
    wanted = next(filter(None, map(own.refused, three)), "" if len(three) == 3 else own.wanted)
    if wanted:
        raise unexpected_value(f"{wanted}, or a list of three: one for each axis")
    return tuple(map(float, three)) if several else float(value)


Sigmas = Annotated[float | tuple[float, ...], PlainValidator(_sigmas)]


def _robot(value: Any) -> int | str:
    if isinstance(value, str) or (isinstance(value, int) and not isinstance(value, bool)):
        return value
    raise unexpected_value("a robot's name or number")


RobotName = Annotated[int | str, PlainValidator(_robot)]


def _id(value: Any) -> Id:
    try:
        return checked_id(value, "id")
    except EventError as error:
        raise unexpected_value(str(error).rpartition("expected ")[2]) from None


LandmarkId = Annotated[Id, PlainValidator(_id)]

Numbers = Annotated[tuple[Number, ...], Field(strict=False)]

BASES: dict[tuple[str, str], type[Section]] = {}  # by role and world: what all sections of that choice have


class ModelSection(Section):
    """A section that describes a model: its keys are the model's parameters."""

    of_role: ClassVar[str] = ""
    of_name: ClassVar[str] = ""
    of_world: ClassVar[str] = ""

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Return how a worker makes it again: the class is made there, of the declarations."""
        models = classes_of(self.of_role, self.of_name, self.of_world)
        return _unpickled, (self.of_role, self.of_name, self.of_world, plugin_of(models[0])), self.__getstate__()


class Choice:
    """The section of one model of a role, by its `type`; where a role has one model, there is no type.

    With `sensor`, a class, it is that of a detector for it.
    """

    def __init__(self, role: str, world: str = "", sensor: Any = None) -> None:
        self.role, self.world, self.sensor = role, world, sensor
        self.typed, self.default = not has_one_model(role), USUAL.get(role)

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        """Return how pydantic validates it: at the time, as a plugin may have added models since."""
        return core_schema.no_info_plain_validator_function(self.validated)

    def names(self) -> list[str]:
        """Return the types there are."""
        found = classes(self.role, self.world)
        return [name for name, models in found.items() if self.sensor is None or finds(models[0], self.sensor)]

    def has(self, name: str) -> bool:
        """Return whether there is a type, or a plugin that makes it."""
        try:
            models = classes_of(self.role, name, self.world)
        except KeyError:
            return False
        return bool(models) and (self.sensor is None or finds(models[0], self.sensor))

    def made(self, name: str, value: Any) -> Section:
        """Return the section of a mapping, if its model takes it."""
        section = section_of(self.role, name, self.world).model_validate(value)
        try:
            model_of(section, self.world)
        except ModelError as error:
            if error.key:
                raise unexpected_value(error.wanted, error.key) from None
        return section

    def validated(self, value: Any) -> Section:
        """Return the section of a mapping.  Raises the errors of pydantic."""
        if isinstance(value, Section):
            return value
        if not self.typed:
            return self.made(self.role, value)
        if isinstance(value, str):
            value = {"type": value}
        name: Any = value.get("type", self.default) if isinstance(value, dict) else None
        if isinstance(name, str) and self.has(name):
            return self.made(name, value)
        missing = "".join(f"; {error}" for error in missing_models())
        if not self.names():
            raise unexpected_value(f"nothing: no detector finds what this sensor measures{missing}")
        if name is None:
            raise PydanticCustomError("union_tag_not_found", "no type", {"types": self.names()})
        raise PydanticCustomError("union_tag_invalid", "unknown type", {"types": self.names(), "missing": missing})


class OneOf(Choice):
    """One of some sections, by their `type`, or of a `group` of entry points."""

    def __init__(self, *sections: type[Section], group: str = "") -> None:
        self.typed, self.default, self.group = True, None, group
        self.sections: dict[str, type[Section]] = {str(s.model_fields["type"].default): s for s in sections}

    def names(self) -> list[str]:
        """Return the types there are."""
        return [*self.sections, *entry_points_of(self.group)]

    def has(self, name: str) -> bool:
        """Return whether there is a type."""
        return name in self.names()

    def made(self, name: str, value: Any) -> Section:
        """Return the section of a mapping."""
        section: type[Section] = self.sections.get(name) or load(self.group, name)
        return section.model_validate(value)


def section_of(role: str, name: str, world: str = "") -> type[Section]:
    """Return the section of a model; it has `type` where a role has several models."""
    return _section(role, name, world, tuple(classes_of(role, name, world)))


@cache
def _section(role: str, name: str, world: str, models: tuple[type, ...]) -> type[Section]:
    fields: dict[str, Any] = {} if name == role else {"type": (str, name)}
    if role == "sensor":
        fields |= {key: (str | None, None) for key in entry_points_of("keys")}  # which their plug-ins check
        fields["detector"] = (Annotated[Any, Choice("detector", sensor=models[0])] | None, None)
    base = BASES.get((role, world), ModelSection)
    for parameter in parameters(models[0]):
        if parameter.name in vars(base):  # it is another key of the section
            continue
        others = [own for model in models[1:] for own in parameters(model) if own.name == parameter.name]
        fields[parameter.name] = _field(parameter, others, models)
    text = "  ".join(dict.fromkeys(map(summary, models)))
    made: Any = create_model(name, __base__=base, __doc__=text, **fields)
    made.of_role, made.of_name, made.of_world = role, name, world
    return made


def _field(parameter: Parameter, others: list[Parameter], models: tuple[type, ...]) -> tuple[Any, Any]:
    """Return a parameter as a field; where the plane and space have different defaults, it has none."""
    default, text = parameter.default, parameter.text
    if any(other.default != default for other in others):
        places = ["the plane" if world_of_class(model) == "plane" else "space" for model in models]
        worlds = [f"{own.default:g} in {place}" for own, place in zip([parameter, *others], places, strict=True)]
        default, text = None, f"{text[:-1]}; if absent {', '.join(worlds)}."
        parameter = replace(parameter, optional=True)
    return annotation(parameter), Field(default=default, description=text or None)


def options_section(
    declared: Iterable[Parameter],
    base: type[Section] = Section,
    kinds: Mapping[str, Any] | None = None,
    **defaults: Any,
) -> Any:
    """Return a section of options as they are declared, in the place of some other `kinds` and `defaults`.

    The default of a model is the name of its type.
    """
    fields: dict[str, Any] = {}
    for each in declared:
        default, kind = defaults.get(each.name, each.default), annotation(replace(each, optional=False))
        kind = (kinds or {}).get(each.name, kind if default is not None else kind | None)
        default = section_of(each.role, default)() if each.role and default is not None else default
        fields[each.name] = kind, Field(default=default, description=each.text)
    return create_model("Options", __base__=base, **fields)


def annotation(parameter: Parameter) -> Any:
    """Return what pydantic validates a parameter by: its declaration."""
    if parameter.role:
        choice = Annotated[Any, Choice(parameter.role)]
        return choice | None if parameter.optional else choice
    if parameter.values is not None:
        role = parameter.values.role
        kind = dict[str, Annotated[Any, Choice(role)] if role else str]  # type: ignore[misc, valid-type]
        return kind | None if parameter.optional else kind
    return Annotated[Any, PlainValidator(parameter.validated)]


def model_of(section: Any, world: str = "plane") -> Any:
    """Return the model that a section describes, of the plane or of space where its type leaves that open.

    Raises ModelError if the model refuses its parameters.
    """
    if section is None:
        return None
    return model_described(section.of_role, plain_section(section), section.of_world or world)


def plain_section(value: Any) -> Any:
    """Return sections as mappings; a key without value only where the user wrote it, to undo what the log describes."""
    if isinstance(value, BaseModel):
        return {n: plain_section(v) for n, v in value if v is not None or n in value.model_fields_set}
    if isinstance(value, dict):
        return {key: plain_section(item) for key, item in value.items()}
    return [plain_section(item) for item in value] if isinstance(value, tuple) else value


def _unpickled(role: str, name: str, world: str, plugin: Path | None) -> Section:
    if plugin is not None:
        load_plugin(plugin)
    section = section_of(role, name, world)
    return section.__new__(section)
