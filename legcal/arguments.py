"""Calls of the public functions with arguments that they do not take, in words.

Annotations say what a function takes; what works is never refused. A call that fails with an error
of Python is looked at again: arguments that do not fit their annotations are its likely cause.
"""

from __future__ import annotations

import inspect
import numbers
import os
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from decimal import Decimal
from functools import wraps
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from legcal.errors import LegcalError, UsageError

_UNIONS = (Union, types.UnionType)
_SEVERAL = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_WORDS: dict[object, tuple[Any, str]] = {  # what may stand for a type, and what it is called
    float: ((numbers.Real, Decimal), "a number"),
    int: (numbers.Integral, "a whole number"),
    bool: (bool, "True or False"),
    str: (str, "a text"),
    Path: (os.PathLike, "a path"),
    type(None): (type(None), "None"),
    Sequence: ((Sequence, np.ndarray), "a list"),
    np.ndarray: ((Sequence, np.ndarray), "an array"),
    Mapping: (Mapping, "a mapping"),
    Callable: (Callable, "a function"),
}


def with_arguments_in_words(function: Callable[..., Any], public: str) -> Callable[..., Any]:
    """Return a function of the module *public* that raises UsageError for wrong arguments."""

    @wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except LegcalError:
            raise
        except (TypeError, ValueError, AttributeError) as error:
            try:
                bound = inspect.signature(function).bind(*args, **kwargs)
            except TypeError:  # names the argument that is missing or not known
                raise error from None
            kinds = bound.signature.parameters
            given = {k: v for k, v in bound.arguments.items() if kinds[k].kind not in _SEVERAL}
            annotations = _annotations(function, public)
            for argument in list(given):
                _add_options(argument, annotations, given, public)
            check_arguments(f"{public}.{function.__name__}", annotations, given)
            raise

    called.__module__ = public  # where processes that are handed it find it
    return called


def check_arguments(name: str, annotations: Mapping[str, Any], given: Mapping[str, object]) -> None:
    """Raise UsageError with all arguments that do not fit their annotations."""
    wrong = list[str]()
    for argument, value in given.items():
        if argument not in annotations or fits(value, annotations[argument]):
            continue
        needed, remedy = dict.fromkeys(in_words(annotations[argument])), "correct it"
        if "Machine" in needed and "machine" in dir(value):  # a calibration, or a dataset
            folder = ", or the folder that calibrate wrote" * ("a path" in needed)
            remedy = f"give its .machine{folder}"
        elif "Machine" in needed and isinstance(value, str | os.PathLike):
            remedy = "load it with legcal.load_mechanism"
        wrong.append(
            f"{name} could not be run: found {value!r:.60} ({type(value).__name__}) as {argument}, "
            f"needed {' or '.join(needed)}; {remedy}."
        )
    if wrong:
        raise UsageError(wrong)


def _add_options(
    argument: str, annotations: dict[str, Any], given: dict[str, Any], public: str
) -> None:
    """Add what an argument holds to the arguments: a dataclass whose fields have defaults."""
    value = given[argument]
    if is_dataclass(value) and not any(
        one.default is one.default_factory is MISSING for one in fields(value)
    ):
        for name, annotation in _annotations(type(value), public).items():
            field = f"{name} of {argument}"
            annotations[field], given[field] = annotation, getattr(value, name)
            _add_options(field, annotations, given, public)


def _annotations(function: Callable[..., Any], public: str) -> dict[str, Any]:
    """Return the types of a function or class, also those that its module does not import."""

    class Names(dict[str, Any]):
        def __missing__(self, name: str) -> Any:
            try:
                return getattr(sys.modules[public], name)
            except AttributeError:
                raise KeyError(name) from None

    return get_type_hints(function, localns=Names())


def fits(value: object, annotation: Any) -> bool:
    """Return whether a value may be of a type; whatever is not known fits."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if origin in _UNIONS:
        return any(fits(value, part) for part in parts)
    if origin is Literal:
        return value in parts
    sought = origin or annotation
    if not isinstance(sought, type) or getattr(sought, "_is_protocol", False):
        return True
    if sought is Sequence and isinstance(value, Sequence):
        return not isinstance(value, str) and all(
            fits(one, part) for part in parts for one in value
        )
    return isinstance(value, _WORDS.get(sought, (sought, ""))[0])


def in_words(annotation: Any) -> list[str]:
    """Return the types that fit in words."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin in _UNIONS:
        return [word for part in parts for word in in_words(part)]
    if origin is Literal:
        return [str(part) for part in parts]
    sought = origin or annotation
    if sought is Sequence and parts and isinstance(parts[0], type) and parts[0] not in _WORDS:
        return [f"{parts[0].__name__}s"]
    return [_WORDS[sought][1] if sought in _WORDS else getattr(sought, "__name__", str(sought))]
