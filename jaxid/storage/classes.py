"""Names of classes in files, and objects rebuilt from their fields."""

import dataclasses
import enum
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

# A class by the package it comes from ("" for jaxid itself) and its name.
Registry = Mapping[tuple[str, str], type]


def origin(cls: type) -> tuple[str, str]:
    """The name of a class in a file: package and name; for a user's class, module and name."""
    package = cls.__module__.partition(".")[0]
    where = {"jaxid": "", "diffrax": "diffrax"}.get(package, cls.__module__)
    return where, cls.__name__


def registered(classes: Iterable[type]) -> dict[tuple[str, str], type]:
    """Classes by their names in files."""
    return {origin(cls): cls for cls in classes}


def classes_of(tree: Any) -> set[type]:
    """The classes of all modules in a tree, which restoring it requires."""
    found: set[type] = set()
    waiting = [tree]
    while waiting:
        value = waiting.pop()
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            found.add(type(value))
            waiting += [getattr(value, field.name) for field in dataclasses.fields(value)]
        elif isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, (tuple, list)):
            waiting += value
        elif isinstance(value, enum.Enum):
            found.add(type(value))
    return found


def rebuilt(cls: type, given: Mapping[str, Any]) -> Any:
    """An object from its saved fields, without converters but with the checks after them.

    A field that an older file does not contain gets its default.
    """
    made = object.__new__(cls)
    for field in dataclasses.fields(cls):
        if field.name in given:
            value = _or_default(given[field.name], field.default)
        elif field.default is not dataclasses.MISSING:
            value = field.metadata.get("converter", lambda x: x)(field.default)
        elif field.default_factory is not dataclasses.MISSING:
            value = field.default_factory()
        else:
            raise ValueError(f"{cls.__name__} needs a value for {field.name}")
        object.__setattr__(made, field.name, value)
    for base in cls.__mro__:
        if "__check_init__" in vars(base):
            base.__check_init__(made)  # type: ignore[attr-defined]
    return made


def _or_default(value: Any, default: Any) -> Any:
    """The default object itself if the value is equal: equinox hides fields by identity."""
    if type(value) is not type(default):
        return value
    if isinstance(value, (str, int, float)):
        return default if repr(value) == repr(default) else value
    same = isinstance(value, eqx.Module) and eqx.tree_equal(value, default) is True
    return default if same else value


def hints(cls: type) -> dict[str, Any]:
    """The annotations of a class; empty if one of them cannot be resolved."""
    import pandas as pd

    try:
        # jaxid's own classes import pandas for type checkers only.
        return typing.get_type_hints(cls, localns={"pd": pd})
    except Exception:  # annotations of a user's class may have names for type checkers only
        return {}


def agrees(value: Any, hint: Any) -> bool:
    """Whether a value fits a field's annotation; True if the annotation is not known."""
    if hint in (Any, None) or isinstance(hint, (str, typing.TypeVar)):
        return hint is not None or value is None
    made_of, of = typing.get_origin(hint), typing.get_args(hint)
    if made_of in (typing.Union, types.UnionType):
        return any(agrees(value, one) for one in of)
    if made_of is typing.Literal:
        return value in of
    if made_of is tuple:
        if not isinstance(value, tuple):
            return False
        if len(of) == 2 and of[1] is Ellipsis:
            return all(agrees(one, of[0]) for one in value)
        return len(of) == len(value) and all(map(agrees, value, of))
    plain = made_of or hint
    if plain in (int, float) or hasattr(plain, "array_type"):
        # Under `vmap` numbers become arrays, and arrays get further axes.
        numbers = (int, float, np.ndarray, jax.Array)
        return isinstance(value, numbers) and not isinstance(value, bool)
    if isinstance(plain, type):
        return isinstance(value, plain)
    return True
