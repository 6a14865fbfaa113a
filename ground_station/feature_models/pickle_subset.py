"""The part of Python's pickle format that tensors are described in, as data: it can call nothing.

Python's own unpickler can be told which names to refuse, but memory is not bounded by its input (a
`LONG_BINPUT` of few bytes claims gigabytes for the memo). `pickletools` only reads opcodes and what
stands behind them; this is a machine of its own for those of protocols 2 to 5 that weights need. A
name in the file is looked up in the caller's table and nowhere else, and every other opcode is
refused.
"""

from __future__ import annotations

import io
import pickletools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

MOST_BYTES: Final = 1 << 20
"""Of one pickle. It bounds time and memory: an opcode has at least a byte and makes one object."""
_LONGEST_SHOWN = 60


class PickleError(ValueError):
    """What a pickle may not do; the text is a part of a line."""


@dataclass(frozen=True)
class Name:
    """What a name in the file stands for: a function of ours, or a constant that is no function."""

    meaning: Any


Names = Mapping[tuple[str, str], Name]
"""By module and name, as they stand in the file."""


class _Mark:
    """Where a list, tuple or dictionary begins on the stack."""


_MARK = _Mark()


def load(
    data: bytes | memoryview,
    at: int,
    names: Names,
    persistent: Callable[[Any], Any] | None = None,
) -> tuple[Any, int]:
    """The object whose pickle begins at a byte, and where the next byte is.

    `names` says what may be named; a function in it is called with what the file gives and must
    check it. `persistent` is given the identities of what lies outside the pickle. Raises
    `PickleError`.
    """
    file = io.BytesIO(data[at : at + MOST_BYTES])
    machine = _Machine(names, persistent)
    for opcode, value in _opcodes(file):
        machine.step(opcode, value)
    return machine.pop(1)[0], at + file.tell()


def _opcodes(file: io.BytesIO) -> Iterator[tuple[str, Any]]:
    """The name of each opcode, and the number or text behind it, up to the one that ends."""
    try:
        for opcode, value, _ in pickletools.genops(file):
            yield opcode.name, value
    except ValueError as error:  # text that is none, too
        if len(file.getbuffer()) == MOST_BYTES:
            raise PickleError(f"it describes its tensors in more than {MOST_BYTES} bytes") from None
        raise PickleError(f"it is cut or damaged ({shown(str(error))})") from None


def shown(value: object) -> str:
    """A value from a file, fit for a line of text."""
    if not isinstance(value, str):
        # Never a container's repr: one that holds itself many times over has no end.
        value = str(value) if isinstance(value, bool | int | float) else type(value).__name__
    text = "".join(c if c.isprintable() else "?" for c in value[: _LONGEST_SHOWN + 1])
    return text if len(text) <= _LONGEST_SHOWN else text[: _LONGEST_SHOWN - 1] + "…"


class _Machine:
    def __init__(self, names: Names, persistent: Callable[[Any], Any] | None) -> None:
        self._names, self._persistent = names, persistent
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def step(self, opcode: str, value: Any) -> None:
        """What an opcode does with what stands behind it, None where nothing does."""
        push = self._stack.append
        match opcode:
            case "PROTO":
                if not 2 <= value <= 5:
                    raise PickleError(f"its pickle protocol is {value}; known are 2 to 5")
            case "FRAME" | "STOP":
                pass  # a hint how much to read at once, which changes nothing here; and the end
            case "MARK":
                push(_MARK)
            case "NONE" | "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT":
                push(value)
            # Text of Python 3, and of Python 2, whose own strings held names, too.
            case (
                "BINUNICODE" | "SHORT_BINUNICODE" | "BINUNICODE8" | "BINSTRING" | "SHORT_BINSTRING"
            ):
                push(value)
            case "NEWTRUE" | "NEWFALSE":
                push(opcode == "NEWTRUE")
            case "EMPTY_TUPLE":
                push(())
            case "EMPTY_LIST":
                push([])
            case "EMPTY_DICT":
                push({})
            case "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                place = len(self._memo) if value is None else value
                self._memo[place] = self._top(object)
            case "BINGET" | "LONG_BINGET":
                if value not in self._memo:
                    raise PickleError(f"it asks for object {value} that it never kept")
                push(self._memo[value])
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                push(tuple(self.pop(int(opcode[-1]))))
            case "TUPLE":
                push(tuple(self._pop_to_mark()))
            case "LIST":
                push(self._pop_to_mark())
            case "DICT":
                pairs = self._pop_to_mark()
                push({})
                self._set_items(pairs)
            case "SETITEM":
                self._set_items(self.pop(2))
            case "SETITEMS":
                self._set_items(self._pop_to_mark())
            case "APPEND":
                self._extend(self.pop(1))
            case "APPENDS":
                self._extend(self._pop_to_mark())
            case "GLOBAL":
                push(self._named(*value.split(" ", 1)))
            case "STACK_GLOBAL":
                push(self._named(*self.pop(2)))
            case "REDUCE":
                function, arguments = self.pop(2)
                if not isinstance(arguments, tuple) or not isinstance(function, Name):
                    raise PickleError("it calls what is no function")
                if not callable(function.meaning):
                    raise PickleError("it calls what is no function")
                push(function.meaning(*arguments))
            case "BUILD":  # attributes, as a state dictionary's `_metadata`: nothing that is needed
                self.pop(1)
                self._top(dict)
            case "BINPERSID":
                if self._persistent is None:
                    raise PickleError("it points outside where nothing is")
                push(self._persistent(*self.pop(1)))
            case _:
                raise PickleError(f"opcode {opcode} has no place in a file of tensors")

    def pop(self, count: int) -> list[Any]:
        """So many objects from the stack, the last one on it last."""
        items = self._stack[-count:]
        if len(items) < count or any(item is _MARK for item in items):
            raise PickleError("it takes more from the stack than is there")
        del self._stack[-count:]
        return items

    def _pop_to_mark(self) -> list[Any]:
        for place in range(len(self._stack) - 1, -1, -1):
            if self._stack[place] is _MARK:
                items = self._stack[place + 1 :]
                del self._stack[place:]
                return items
        raise PickleError("it takes more from the stack than is there")

    def _top(self, kind: type) -> Any:
        value = self._stack[-1] if self._stack else _MARK
        if value is _MARK or not isinstance(value, kind):
            raise PickleError(f"what should be a {kind.__name__} is none")
        return value

    def _extend(self, values: list[Any]) -> None:
        self._top(list).extend(values)

    def _set_items(self, pairs: list[Any]) -> None:
        target = self._top(dict)
        if len(pairs) % 2:
            raise PickleError("a key has no value")
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            set_item(target, key, value)

    def _named(self, module: Any, name: Any) -> Name:
        if not isinstance(module, str) or not isinstance(name, str):
            raise PickleError("a name in it is no text")
        found = self._names.get((module, name))
        if found is None:
            raise PickleError(f"it names {shown(f'{module}.{name}')}, which no tensor needs")
        return found


def set_item(target: dict[Any, Any], key: Any, value: Any) -> None:
    """Sets a key that is text or an integer; nested tuples could take for ever to hash."""
    if not isinstance(key, str | int):
        raise PickleError("a key in it is neither text nor a number")
    target[key] = value
