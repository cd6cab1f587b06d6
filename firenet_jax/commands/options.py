"""Arguments of a command line -> its settings, a dataclass whose fields are the options; and back.

tyro reads the arguments and writes the help. By itself it puts the options of settings within
settings last and breaks sentences where the source does; so it gets a copy of the dataclass,
in the order of its fields, with the text below each field as one line and plain words for types.
"""

import dataclasses
import shlex
import types
import typing
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import docstring_parser
import tyro

from firenet_jax.errors import SettingsError

METAVARS = {Path: "PATH", str: "TEXT", int: "NUMBER", float: "NUMBER", ...: "..."}
POSITIONAL = typing.get_args(tyro.conf.Positional[int])[1]
FURTHER = "further"  # options whose fields come after settings within the settings


def parse(settings: type, arguments: list[str], prog: str, description: str) -> Any:
    """The settings that the arguments say.

    Ends the program with exit code 2 where tyro cannot read them, and with 0 after the help. Raises
    SettingsError for words that stand apart from others of their kind, and what the settings raise.
    """
    read_by = partial(
        tyro.cli, _copy(settings, None), prog=prog, description=description, args=arguments,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )  # fmt: skip
    read, unknown = read_by(return_unknown_args=True)
    if unknown and not any(word.startswith("-") for word in unknown) and _takes_many(settings):
        raise SettingsError(
            f"{unknown[0]} stands apart from those before: name them all side by side, with the "
            "options before or after them"
        )
    return _original(settings, read_by() if unknown else read)


def _takes_many(settings: type) -> bool:
    """Whether words without an option are any number of one kind."""
    hints = typing.get_type_hints(settings, include_extras=True).values()
    kinds = [typing.get_args(hint)[0] for hint in hints if POSITIONAL in typing.get_args(hint)]
    return any(typing.get_origin(kind) is tuple for kind in kinds)


def _copy(settings: type, default: Any, text: str | None = None) -> type:
    """A dataclass of the same fields for tyro.

    default: settings of this type, whose values are the defaults; None: the fields' own.
    text: what they are about; None: as their docstring begins.
    """
    texts = {
        entry.arg_name: " ".join((entry.description or "").split())
        for entry in docstring_parser.parse_from_object(settings).params
    }
    hints = typing.get_type_hints(settings, include_extras=True)
    first, rest, nested = [], [], False
    for field in dataclasses.fields(settings):
        value = field.default if default is None else getattr(default, field.name)
        if dataclasses.is_dataclass(hints[field.name]):
            inner = _copy(hints[field.name], value, texts.get(field.name))
            first.append((field.name, inner, dataclasses.field(default_factory=inner)))
            nested = True
            continue
        required = value is dataclasses.MISSING
        hint = _plain(hints[field.name], texts.get(field.name, ""), required)
        (rest if nested else first).append((field.name, hint, dataclasses.field(default=value)))
    if rest:
        further = _made("Further", rest, "")
        first.append((FURTHER, further, dataclasses.field(default_factory=further)))
    text = text or docstring_parser.parse(settings.__doc__).description
    return _made(settings.__name__, first, text)


def _made(name: str, fields: list, text: str | None) -> type:
    made = dataclasses.make_dataclass(name, fields, kw_only=True, frozen=True)
    made.__doc__ = text or " "  # empty, dataclass and tyro would write one
    return made


def _plain(hint: Any, text: str, required: bool) -> Any:
    """The same type, shown as PATH and not as {None}|PATH, its default only where it tells much."""
    kind, *extras = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint,)
    said: dict[str, Any] = {"help": text}
    if not required:  # tyro's place for the default: an empty one after a text can make a line
        said = {"help_behavior_hint": lambda default: text + _in_words(default)}
    if not required and POSITIONAL in extras:  # without a text, tyro takes the name for one
        said = {"help": text, "help_behavior_hint": ""}
    whole = kind
    if types.NoneType in typing.get_args(kind):
        kind = next(part for part in typing.get_args(kind) if part is not types.NoneType)
    parts = typing.get_args(kind) if typing.get_origin(kind) is tuple else (kind,)
    if all(part in METAVARS for part in parts):
        said["metavar"] = " ".join(METAVARS[part] for part in parts).replace(" ...", "...")
    if typing.get_origin(kind) is typing.Literal:
        parts = typing.get_args(kind)
        said["metavar"] = f"{{{','.join(parts)}}}"
    elif not set(parts) <= {int, float}:
        return Annotated[whole, tyro.conf.arg(**said), *extras]
    return Annotated[Any, tyro.conf.arg(**said), _read_as(said["metavar"], parts), *extras]


def _read_as(metavar: str, parts: tuple) -> tyro.constructors.PrimitiveConstructorSpec:
    """How the words after an option are read: one of some words, or as many numbers as there are
    types. tyro's own way names classes of Python where a word is none of these."""

    def numbers(words: list[str]) -> Any:
        try:
            values = tuple(part(word) for part, word in zip(parts, words, strict=True))
        except ValueError as error:
            whole = "a whole number" if set(parts) == {int} else "a number"
            expected = whole if len(parts) == 1 else f"{len(parts)} numbers"
            raise ValueError(f"expected {expected}, not {' '.join(words)!r}") from error
        return values if len(parts) > 1 else values[0]

    def choice(words: list[str]) -> str:
        if words[0] not in parts:
            raise ValueError(f"expected {' or '.join(parts)}, not {words[0]!r}")
        return words[0]

    def back(value: Any) -> list[str]:
        return [str(part) for part in (value if isinstance(value, tuple) else [value])]

    of_words = all(isinstance(part, str) for part in parts)
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1 if of_words else len(parts), metavar=metavar,
        instance_from_str=choice if of_words else numbers,
        is_instance=lambda value: True, str_from_instance=back,
    )  # fmt: skip


def _in_words(default: str) -> str:
    return "" if default in ("", "None", "False", "True") else f" (default: {default})"


def _original(settings: type, read: Any) -> Any:
    """A copy with its values -> the settings."""
    values = {field.name: getattr(read, field.name) for field in dataclasses.fields(read)}
    if FURTHER in values:
        values |= vars(values.pop(FURTHER))
    hints = typing.get_type_hints(settings)
    inner = {name for name in values if dataclasses.is_dataclass(hints[name])}
    return settings(**{k: _original(hints[k], v) if k in inner else v for k, v in values.items()})


def command_line(command: str, settings: Any) -> str:
    """What to type for these settings; options that have their default are left out."""
    return shlex.join(["firenet", command, *_words(settings, None)])


def _words(settings: Any, default: Any) -> list[str]:
    hints = typing.get_type_hints(type(settings), include_extras=True)
    first, rest = [], []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        usual = field.default if default is None else getattr(default, field.name)
        option = field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            rest += _words(value, usual)
        elif POSITIONAL in typing.get_args(hints[field.name]):
            first += map(str, value if isinstance(value, tuple) else [value])
        elif value == usual:
            continue
        elif isinstance(value, bool):
            rest.append(f"--{option}" if value else f"--no-{option}")
        else:
            rest += [f"--{option}", *map(str, value if isinstance(value, tuple) else [value])]
    return [*first, *rest]
