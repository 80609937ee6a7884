"""Pydantic models of settings that are frozen dataclasses elsewhere: nothing is said twice."""

from __future__ import annotations

import functools
import inspect
import math
import operator
from collections.abc import Container, Iterable
from dataclasses import MISSING, asdict, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ValidationError,
    create_model,
)
from pydantic_core import CoreSchema, core_schema

from terrasim.scenario.descriptions import descriptions

MOST_TOLD = 4
"""Errors of one file that are told in one line."""


class Settings(BaseModel):
    """A table of a scenario file: no key it does not know, no NaN, nothing infinite."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class AsDataclass:
    """Marks a field whose type is a dataclass: it is read and checked like a table.

    Used as ``Annotated[ImportOptions, AsDataclass()]``.
    """

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Validate as the model of the dataclass, then make the dataclass."""
        return core_schema.no_info_after_validator_function(
            lambda model: source(**given(model)),
            handler.generate_schema(model_of(source)),
            serialization=core_schema.plain_serializer_function_ser_schema(asdict),
        )


class OneOf:
    """Marks a field that takes one of several tables, told apart by their ``kind``.

    Used as ``Annotated[Base, OneOf(models)]`` where the models come from a registry.
    """

    def __init__(self, models: Iterable[type[Settings]]) -> None:
        """Take the models, each with a literal ``kind``."""
        self._models = tuple(models)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Validate as the model whose kind is named."""
        del source
        # An alternative for each entry of a registry.
        union: Any = functools.reduce(operator.or_, self._models)
        return handler.generate_schema(Annotated[union, Field(discriminator="kind")])


def kind_field(name: str) -> Any:
    """Definition of a field ``kind`` whose only value is a name of a registry."""
    return Literal[name], Field(description="Tells it from the other kinds.")


def given(table: BaseModel, names: Container[str] | None = None) -> dict[str, Any]:
    """Fields of a table that are not None, as the dataclass behind it takes them."""
    return {
        name: value
        for name, value in table
        if value is not None and (names is None or name in names)
    }


def names_of(kind: Any) -> frozenset[str]:
    """Names of a dataclass's fields."""
    return frozenset(one.name for one in fields(kind))


@cache
def model_of(kind: type) -> type[Settings]:
    """The model of a dataclass: its fields with their types, defaults and descriptions."""
    return create_model(
        kind.__name__, __base__=Settings, __doc__=inspect.getdoc(kind), **fields_of(kind)
    )


def fields_of(kind: type, skip: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Field definitions of a dataclass as pydantic's ``create_model`` takes them."""
    if not is_dataclass(kind):
        raise TypeError(f"{kind} is no dataclass")
    types, lines = get_type_hints(kind), descriptions(kind)
    found = {}
    for one in fields(kind):
        if one.name in skip or not one.init:
            continue
        default: Any = ... if one.default is MISSING else one.default
        taken: Any = types[one.name]
        if isinstance(default, float) and not math.isfinite(default):
            # JSON has no infinity: what is left out is none.
            taken, default = taken | None, None
        found[one.name] = (taken, Field(default, description=lines.get(one.name)))
    return found


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """All that is wrong with a file, in one line: each path, rule and value, and the remedy."""
    found = [_explain_one(one, model) for one in error.errors(include_url=False)]
    rest = len(found) - MOST_TOLD
    return "; ".join(found[:MOST_TOLD]) + (f"; and {rest} more" if rest > 0 else "")


_TABLES = frozenset({"model_type", "model_attributes_type", "dict_type", "dataclass_type"})


def _explain_one(error: Any, model: type[BaseModel]) -> str:
    where, kind = error["loc"], error["type"]
    if kind == "extra_forbidden":
        (table, place), key = _at(model, where[:-1]), where[-1]
        full = f"{place}.{key}" if place else str(key)
        allowed = ", ".join(sorted(table.get("properties", {})))
        return f"{full} is unknown: {place or 'a scenario'} takes {allowed}"
    table, place = _at(model, where)
    kinds = ", ".join(table.get("discriminator", {}).get("mapping", {}))
    if kind == "missing":
        return f"{place} is missing: add it"
    if kind == "union_tag_not_found":
        return f"{place}.kind is missing: it must be one of {kinds}"
    if kind == "union_tag_invalid":
        return f"{place}.kind must be one of {kinds}, got {error['ctx']['tag']!r}"
    if kind == "value_error":
        return f"{place}: {error['ctx']['error']}" if place else str(error["ctx"]["error"])
    rule = error["msg"].removeprefix("Input should ").removeprefix("be ")
    if kind in _TABLES:
        rule = "a table"
    return f"{place} must be {rule[0].lower() + rule[1:]}, got {_shown(error['input'])}"


def _shown(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def _at(model: type[BaseModel], where: tuple[int | str, ...]) -> tuple[dict[str, Any], str]:
    """Schema of a part of a file, and its path as the author would write it.

    Entries are counted from 1. Where a union is entered its kind stands in ``where``: the author
    knows it only as the value of a key.
    """
    whole = model.model_json_schema(by_alias=True)
    node, path = _resolved(whole, whole), ""
    for part in where:
        kinds = node.get("discriminator", {}).get("mapping", {})
        if isinstance(part, int):
            node, path = node.get("items", {}), f"{path}[{part + 1}]"
        elif part in kinds:
            node = {"$ref": kinds[part]}
        else:
            node, path = node.get("properties", {}).get(part, {}), f"{path}.{part}"
        node = _resolved(whole, node)
    return node, path.removeprefix(".")


def _resolved(whole: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """A schema with its reference followed, and the table among its alternatives taken."""
    while True:
        if "$ref" in node:
            node = whole["$defs"][node["$ref"].rsplit("/", 1)[1]]
        elif "anyOf" in node:
            tables = [one for one in node["anyOf"] if one.get("type") != "null"]
            node = tables[0] if len(tables) == 1 else {}
        else:
            return node
