"""Suggestions for typing errors in commands, options and choices, before the parser sees them.

The parser would report them in boxes of many lines, for every command at once.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import tyro

from bigs.checks import InputError, check_choice, expected_among, meant, nearest

_HELP = ("--help", "-h")
# Two dashes and a name, or one dash and a letter; negative numbers are no options.
_OPTION = re.compile(r"--\w|-[A-Za-z]$")


class Word(typing.NamedTuple):
    """What a command takes: an option or a positional word."""

    name: str  # with its dashes, or as shown in the help
    kind: Any  # its type without the parser's annotations
    most: float  # number of words that it takes
    required: bool

    @property
    def choices(self) -> tuple[str, ...]:
        """The accepted words, if they can be listed."""
        return _choices(self.kind)


def check_words(commands: Mapping[str, Any], arguments: Sequence[str]) -> None:
    """Refuse an unknown command, option or choice and suggest the nearest one.

    Args:
        commands: name -> function, or a group's dictionary of these.
        arguments: all words after the program's name.

    Raises:
        InputError: one sentence.
    """
    words, path, node = list(arguments), "", commands
    while not callable(node):
        word = words.pop(0) if words else None
        if word in _HELP:
            return
        if word is None:
            raise InputError(f"{path}expected a command ({', '.join(node)}), found none")
        if word not in node:
            raise InputError(f"{path}{expected_among(word, node, 'commands')}")
        path, node = f"{path.removesuffix(': ')} {word}: ".lstrip(), node[word]
    if not set(words) & set(_HELP):
        options, places = words_of(node)
        _check_options(path, options, places, words)


def words_of(command: Callable[..., Any]) -> tuple[list[Word], list[Word]]:
    """The options of a command from its signature, flags with their opposite, and its positional words."""
    options: list[Word] = []
    places: list[Word] = []
    hints = typing.get_type_hints(command, include_extras=True)
    for parameter in inspect.signature(command).parameters.values():
        said, kind = _plain(hints[parameter.name])
        required = parameter.default is inspect.Parameter.empty
        if dataclasses.is_dataclass(kind):
            options += words_of(typing.cast("Callable[..., Any]", kind))[0]
        elif tyro.conf.Positional in said:
            called = next((name for name in (getattr(s, "metavar", None) for s in said) if name), None)
            places.append(Word(called or parameter.name.upper(), kind, _most(kind), required))
        else:
            name = parameter.name.replace("_", "-")
            most = 1 if tyro.conf.UseAppendAction in said else _most(kind)
            options.append(Word(f"--{name}", kind, most, required))
            if kind is bool and tyro.conf.FlagCreatePairsOff not in said:
                options.append(Word(f"--no-{name}", kind, most, False))
    return options, places


def _plain(kind: Any) -> tuple[list[Any], Any]:
    """The parser's annotations of a type, and the type itself."""
    said: list[Any] = []
    while typing.get_origin(kind) is typing.Annotated:
        kind, *more = typing.get_args(kind)
        said += more
    return said, kind


def _alternatives(kind: Any) -> tuple[Any, ...]:
    """The alternatives of a type, except None."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return (kind,)
    return tuple(part for part in typing.get_args(kind) if part is not type(None))


def _most(kind: Any) -> float:
    """Number of words that a value of a type takes."""
    (kind, *_) = _alternatives(kind)
    if kind is bool:
        return 0
    if typing.get_origin(kind) is not tuple:
        return 1
    parts = typing.get_args(kind)
    return math.inf if parts[-1] is ... else len(parts)


def _choices(kind: Any) -> tuple[str, ...]:
    """The words of a type, or of a list of such words."""
    (kind, *_) = _alternatives(kind)
    if typing.get_origin(kind) is typing.Literal:
        return tuple(map(str, typing.get_args(kind)))
    return _choices(typing.get_args(kind)[0]) if typing.get_origin(kind) is tuple else ()


def _check_options(path: str, options: Sequence[Word], places: Sequence[Word], words: Sequence[str]) -> None:
    known = {option.name: option for option in options}
    see = f" (see bigs {path.removesuffix(': ')} --help)"
    current, left = None, 0.0  # the option that the next words may belong to, and how many
    given, placed = set(), []
    for word in words:
        if _OPTION.match(word):
            name, equals, value = word.partition("=")
            name = name.replace("_", "-")
            if name not in known:
                near = nearest(name, known)
                raise InputError(
                    f"{path}expected an option of this command, found {name}{meant(near) if near else see}"
                )
            _check_none_lacks(current, left)
            given.add(name)
            current, left = known[name], known[name].most
            if equals:
                _check_value(current, value)
                left = 0
        elif current is not None and left:
            _check_value(current, word)
            left -= 1
        else:
            placed.append(word)
    _check_none_lacks(current, left)
    missing = [option.name for option in options if option.required and option.name not in given]
    missing[:0] = [place.name for place in places if place.required and place.most == 1][len(placed) :]
    if missing:
        raise InputError(f"{path}expected {' and '.join(missing)}, found none{see}")
    if len(placed) > sum(place.most for place in places):
        spare = placed[int(sum(place.most for place in places))]
        wanted = " ".join(["nothing but", *(place.name for place in places), *(["and"] if places else [])])
        near = next((f"{option.name} {spare}" for option in options if spare in option.choices), None)
        raise InputError(f"{path}expected {wanted} options, found {spare!r}{meant(near) if near else see}")


def _check_none_lacks(option: Word | None, left: float) -> None:
    """Refuse an option without its words, unless it takes any number."""
    if option is not None and left == option.most and 0 < left < math.inf:
        raise InputError(f"{option.name}: expected a value, found none")


def _check_value(option: Word, value: str) -> None:
    if option.choices:
        check_choice(option.name, value, option.choices)
    elif option.kind in (int, float):
        try:
            option.kind(value)
        except ValueError:
            expected = "a whole number" if option.kind is int else "a number"
            raise InputError(f"{option.name}: expected {expected}, found {value!r}") from None
