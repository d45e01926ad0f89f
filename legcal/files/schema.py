"""Files that people write: read up to a size, YAML safely, errors of a schema in sentences."""

import difflib
import errno
import json
import os
import re
import reprlib
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, Self, TypeVar

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    Strict,
    ValidationError,
    model_serializer,
)
from pydantic_core import ErrorDetails

from legcal.brief import brief
from legcal.errors import BadValue, Cause, Code, DatasetError, LegcalError, Problem

MAX_TEXT = 16_000_000  # bytes of a table, YAML or URDF: enough for the largest table of outlines
MAX_DOCUMENT = 32_000_000  # bytes of a JSON document from legcal
MAX_IMAGE = 256_000_000
# Endings of photographs: read, read with pi-heif, and of other formats
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
HEIC_SUFFIXES = (".heic", ".heif", ".hif")
FOREIGN_SUFFIXES = (".heic", ".heif", ".hif", ".avif", ".webp", ".gif", ".bmp", ".jp2", ".jxl",
                    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")  # fmt: skip
MAX_NAMED = 5  # maximum number of names in one sentence
_MOST_NAMES = 30  # maximum number of names in a hint that lists all
_NEAREST_NAMES = 10  # in a hint that does not
_LONGEST_WORD = 100  # maximum length of words for the search of a similar one
_NUMBERS = re.compile(r"(\d+)", re.ASCII)
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")

_NEEDED = {
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping of names to values",
    "model_type": "a mapping of names to values",
    "model_attributes_type": "a mapping of names to values",
    "greater_than": "a number greater than {gt:g}",
    "less_than": "a number less than {lt:g}",
    "greater_than_equal": "{ge:g} or more",
    "less_than_equal": "{le:g} or less",
    "literal_error": "{expected}",
    "too_short": "at least {min_length} entries",
    "too_long": "at most {max_length} entries",
}
NAME_NEEDED = "printable characters without spaces at the ends, the first none of = + - @"


class TooLarge(OSError):
    """A file of more bytes than its kind can have."""


def read_bytes(path: Path, most: int) -> bytes:
    """Return the bytes of a file; OSError where it cannot be read or has more than *most*."""
    n_bytes = os.path.getsize(path)
    if n_bytes > most:
        raise TooLarge(errno.EFBIG, f"{n_bytes} bytes", str(path))
    return path.read_bytes()


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; OSError or ValueError where there is none."""
    try:
        return json.loads(read_bytes(path, MAX_DOCUMENT))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def is_name(name: str) -> bool:
    """Return whether tables and messages can show a name verbatim.

    Programs that open tables run a cell that begins like a formula.
    """
    return (
        bool(name)
        and name.isprintable()
        and name == name.strip()
        and not name.startswith(("=", "+", "-", "@"))
    )


def _one_plain_line(name: str) -> str:
    """Refuse a name that tables and messages cannot show verbatim."""
    if not is_name(name):
        raise BadValue(f"the name {describe(name)}", NAME_NEEDED, "rename it")
    return name


def is_plain_name(name: object) -> bool:
    """Return whether a name can be part of a file name, of joint names and of a comma list."""
    return isinstance(name, str) and _PLAIN.fullmatch(name) is not None


def plain_name(name: object) -> object:
    """Refuse a name that is not plain, see :func:`is_plain_name`."""
    if not is_plain_name(name):
        needed = (
            "letters, digits, '-', '_' and '.', the first a letter or digit, at most 100 of them"
        )
        raise BadValue(describe(name), needed, "rename it")
    return name


_THIS_VERSION = "version 1"


def _version(value: object) -> object:
    """Refuse ``true``, which equals 1 in Python, and the formats of other versions."""
    if isinstance(value, bool):
        raise BadValue(str(value).lower(), "1", "correct the value")
    if isinstance(value, int | str) and str(value) != "1":
        remedy = "use the legcal that wrote it, or write the file as version 1"
        raise BadValue(describe(value), _THIS_VERSION, remedy)
    return value


Version = Annotated[Literal[1], BeforeValidator(_version)]
Name = Annotated[str, AfterValidator(_one_plain_line)]
PlainName = Annotated[str, BeforeValidator(plain_name)]
Number = Annotated[float, Strict()]  # neither true nor text is a number
Metres = Annotated[Number, Field(gt=-1e6, lt=1e6)]  # squares of far larger numbers overflow
Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]

_Schema = TypeVar("_Schema", bound=BaseModel)
_FROZEN = ConfigDict(frozen=True, allow_inf_nan=False, defer_build=True)


class FileSchema(BaseModel):
    """A block of a file: no unknown keys, no NaN, and it does not change once read."""

    model_config = ConfigDict(extra="forbid", coerce_numbers_to_str=True, **_FROZEN)


@brief
class Document(BaseModel):
    """A JSON document that is written: its fields are the keys, in their order."""

    model_config = ConfigDict(from_attributes=True, **_FROZEN)

    @classmethod
    def describing(cls, source: object, **others: Any) -> Self:
        """Return the document of an object: its attributes, and other fields that are stated."""
        same = {name: getattr(source, name) for name in cls.model_fields if name not in others}
        return cls(**same, **others)

    def document(self) -> dict[str, Any]:
        """Return the document for ``--json``."""
        return self.model_dump()


class SparseDocument(Document):
    """A document without the null keys of absent parts of a machine or session."""

    @model_serializer(mode="wrap")
    def _without_none(self, whole: SerializerFunctionWrapHandler) -> dict[str, Any]:
        absent = {
            key
            for key, field in type(self).model_fields.items()
            if not field.is_required() and field.default is None and getattr(self, key) is None
        }
        return {key: value for key, value in whole(self).items() if key not in absent}


class _Loader(yaml.SafeLoader):
    """Safe YAML: keys are text, repeated keys are refused, 2e-6 is a number and 6:25 is not."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        keys: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _at(key, "a key that is not a single word")
            if key.value in keys:
                raise _at(key, f"the key '{key.value}' twice")
            keys.add(key.value)
            if key.tag != "tag:yaml.org,2002:merge":
                key.tag = "tag:yaml.org,2002:str"
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        is_number = node.tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
        if is_number and ":" in node.value:  # YAML 1.1 takes it for 385, to the base 60
            node.tag = "tag:yaml.org,2002:str"
        try:
            return super().construct_object(node, deep)
        except (ValueError, LookupError, AttributeError, TypeError) as error:
            kind = node.tag.rsplit(":", 1)[-1]
            raise _at(node, f"{describe(node.value)}, which is no {kind}") from error


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def _at(node: yaml.Node, actual: str) -> yaml.MarkedYAMLError:
    """Return a YAML error at the place of a node."""
    return yaml.MarkedYAMLError(problem=actual, problem_mark=node.start_mark)


def content_of(path: Path, noun: str, kind: type[LegcalError] = DatasetError) -> bytes:
    """Return the bytes of a file, or refuse it in a sentence, by an error of a kind."""
    unread = Problem(
        f"the {noun} could not be read",
        remedy=f"check the path of the {noun}",
        file=str(path),
        code=Code.UNREADABLE_FILE,
    )
    if not os.path.isfile(path):  # unlike that of a Path, False where a name is too long
        actual = "a folder" if os.path.isdir(path) else "no such file"
        raise kind(replace(unread, found=actual, needed="a file", code=Code.MISSING_FILE))
    try:
        return read_bytes(path, MAX_TEXT)
    except TooLarge as error:
        bad = replace(unread, found=str(error.strerror), needed=f"at most {MAX_TEXT}")
        raise kind(bad) from error
    except OSError as error:
        remedy = f"{unread.remedy} and its permissions"
        bad = replace(unread, found=f"'{error.strerror}'", needed="a readable file", remedy=remedy)
        raise kind(bad) from error


def read_yaml(path: Path, noun: str, kind: type[LegcalError] = DatasetError) -> dict[str, Any]:
    """Return the mapping that a YAML file holds, with its keys as text."""
    return parse_yaml(content_of(path, noun, kind), path, noun, kind)


def parse_yaml(
    content: bytes, path: Path, noun: str, kind: type[LegcalError] = DatasetError
) -> dict[str, Any]:
    """Return the mapping that the bytes of a YAML file hold, with its keys as text."""
    unread = Problem(f"the {noun} could not be read", file=str(path), code=Code.BAD_SYNTAX)
    try:
        document = yaml.load(content, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        bad = replace(unread, found=str(error.problem), needed="YAML", remedy="mend that line")
        if mark := error.problem_mark:
            bad = replace(bad, line=mark.line + 1, columns=(str(mark.column + 1),))
        raise kind(bad) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        lines = str(error).strip().splitlines()
        actual = f"'{lines[0]}'" if lines else "text nested too deeply"
        needed = "YAML text in UTF-8"
    else:
        if isinstance(document, dict):
            return typing.cast("dict[str, Any]", document)
        # The kind of content of a foreign file, without showing any of it
        kinds = {str: "text", list: "a list", bool: "true or false", type(None): "nothing"}
        actual, needed = kinds.get(type(document), "a number or date"), "'key: value' lines"
    raise kind(replace(unread, found=actual, needed=needed, remedy="write the file again"))


def validate(
    schema: type[_Schema],
    document: Mapping[str, Any],
    path: Path,
    prefix: str = "",
    kind: type[LegcalError] = DatasetError,
) -> _Schema:
    """Validate a mapping by its schema; ``prefix`` is its key in the file."""
    try:
        return schema.model_validate(dict(document))
    except ValidationError as error:
        problems = [_problem(schema, e, path, prefix) for e in error.errors(include_url=False)]
        if any(problem.needed == _THIS_VERSION for problem in problems):  # has keys of its own
            problems = [p for p in problems if p.code is not Code.UNKNOWN_KEY]
        raise kind(problems) from error


def few(names: Sequence[str], most: int = MAX_NAMED) -> str:
    """Return a list of at most a few names: ``c1, c2 and 3 more``."""
    more = len(names) - most
    return ", ".join(names[:most]) + f" and {more} more" * (more > 0)


def natural_key(name: str) -> tuple[object, ...]:
    """Return a key of natural order, numbers in names by their size: ``img2`` before ``img10``."""
    parts = PurePosixPath(name.casefold()).parts
    split = [_NUMBERS.split(part) for part in parts]
    keys = [tuple((int(x), "") if x.isdecimal() else (-1, x) for x in words) for words in split]
    return (len(parts), *keys, name)


class _Short(reprlib.Repr):
    """Short representations with the YAML forms of values."""

    def repr_NoneType(self, value: None, level: int) -> str:
        return "null"

    def repr_date(self, value: object, level: int) -> str:
        return str(value)

    repr_datetime = repr_date


def describe(value: object) -> str:
    """Return a value in the form for messages, on one short line."""
    short = _Short()
    short.maxstring = short.maxother = 60
    return "nothing" if value is None else short.repr(value)


def closest(word: str, candidates: Iterable[str], where: str = "") -> str:
    """Return a hint at the name most similar to a word, or the names that there are.

    Of more than a sentence holds, the nearest stand there, and ``where`` says what lists all.
    """
    names = list(candidates)
    near = nearest(word, names)
    if near:
        return f"did you mean '{near}'?"
    if not names:
        return "there are none: remove it, or add what it names"
    if len(names) <= _MOST_NAMES:
        return f"known are: {', '.join(names)}"
    kept = difflib.get_close_matches(word[:_LONGEST_WORD], names, n=_NEAREST_NAMES, cutoff=0.0)
    return f"the nearest of {len(names)} are: {', '.join(kept)}{where and f'; {where}'}"


def nearest(word: str, names: Iterable[str]) -> str:
    """Return the name most similar to a word, "" if none is similar."""
    near = difflib.get_close_matches(word, names, n=1) if len(word) <= _LONGEST_WORD else []
    return near[0] if near else ""


def _problem(schema: type[BaseModel], error: ErrorDetails, path: Path, prefix: str) -> Problem:
    """Return an error of pydantic as a problem."""
    loc = [step for step in error["loc"] if not str(step).startswith("[")]  # key, or kind of value
    is_short = error["type"] == "missing" and isinstance(loc[-1], int)
    steps = loc[:-1] if is_short else loc
    place = ".".join([*[prefix] * bool(prefix), *map(str, steps)]) or "the file"
    context = error.get("ctx", {})

    def refused(
        found: str | Cause,
        needed: str,
        remedy: str,
        done: str = "read",
        code: Code = Code.BAD_VALUE,
    ) -> Problem:
        sentence = f"{place} could not be {done}"
        return Problem(sentence, found, needed, remedy, str(path), name=place, code=code)

    match error["type"]:
        case "extra_forbidden":
            block = _annotation_at(schema, loc[:-1])
            fields = getattr(block, "model_fields", {}).items()
            remedy = closest(str(loc[-1]), [field.alias or name for name, field in fields])
            return refused("an unknown key", "", remedy, "used", Code.UNKNOWN_KEY)
        case "missing" if is_short:
            return refused(f"{loc[-1]} numbers", "more", "add what is missing")
        case "missing":
            annotation = _annotation_at(schema, loc)
            words = typing.get_args(annotation) if typing.get_origin(annotation) is Literal else ()
            value = " or ".join(map(str, words))
            remedy = f"add '{loc[-1]}: {value or '...'}' to the file"
            return refused("no such key", value or "it", remedy, code=Code.MISSING_KEY)
        case "value_error":
            bad = context["error"]
            if isinstance(bad, BadValue):
                return refused(bad.found, bad.needed, bad.remedy, "used")
            sentence = f"{place} could not be used: {bad}"
            return Problem(sentence, file=str(path), name=place, code=Code.BAD_VALUE)
    template = _NEEDED.get(error["type"])
    needed = error["msg"] if template is None else template.format(**context)
    return refused(describe(error["input"]), needed, "correct the value")


def _annotation_at(schema: type[BaseModel], loc: Iterable[int | str]) -> Any:
    """Return the type in a schema at a location; among several, the first one with keys."""
    annotation: Any = schema
    for step in loc:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            field = annotation.model_fields.get(str(step))
            annotation = field.annotation if field else None
        else:
            annotation = typing.get_args(annotation)[-1] if typing.get_args(annotation) else None
        options = [annotation, *typing.get_args(annotation)]
        models = [o for o in options if isinstance(o, type) and issubclass(o, BaseModel)]
        is_container = typing.get_origin(annotation) in (dict, list, tuple)
        annotation = annotation if is_container or not models else models[0]
    return annotation
