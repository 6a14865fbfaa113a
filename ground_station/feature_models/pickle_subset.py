"""The part of Python's pickle format that tensors are described in, as data: it can call nothing.

Python's own unpickler can be told which names to refuse, but memory is not bounded by its input (a
`LONG_BINPUT` of few bytes claims gigabytes for the memo). This is a machine of its own for the
opcodes of protocols 2 to 5 that weights need (pickletools describes them); a name in the file is
looked up in the caller's table and nowhere else, and every other opcode is refused.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

MOST_BYTES: Final = 1 << 20
"""Of one pickle. It bounds time and memory: an opcode has at least a byte and makes one object."""
_LONGEST_INTEGER = 16
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
    machine = _Machine(data[at : at + MOST_BYTES], names, persistent)
    value = machine.run()
    return value, at + machine.at


def shown(value: object) -> str:
    """A value from a file, fit for a line of text."""
    if not isinstance(value, str):
        # Never a container's repr: one that holds itself many times over has no end.
        value = str(value) if isinstance(value, bool | int | float) else type(value).__name__
    text = "".join(c if c.isprintable() else "?" for c in value[: _LONGEST_SHOWN + 1])
    return text if len(text) <= _LONGEST_SHOWN else text[: _LONGEST_SHOWN - 1] + "…"


class _Machine:
    def __init__(
        self, data: bytes | memoryview, names: Names, persistent: Callable[[Any], Any] | None
    ) -> None:
        self._data, self._names, self._persistent = bytes(data), names, persistent
        self.at = 0
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self) -> Any:
        """The object; afterwards `at` is behind it."""
        while True:
            code = self._bytes(1)
            if code == b".":
                return self._pop()
            step = _STEPS.get(code)
            if step is None:
                raise PickleError(f"opcode {code!r} has no place in a file of tensors")
            step(self)

    def _bytes(self, size: int) -> bytes:
        piece = self._data[self.at : self.at + size]
        if len(piece) < size:
            limit = len(self._data) == MOST_BYTES
            raise PickleError(
                f"it describes its tensors in more than {MOST_BYTES} bytes"
                if limit
                else "it is cut"
            )
        self.at += size
        return piece

    def _number(self, form: str) -> int:
        value = struct.unpack("<" + form, self._bytes(struct.calcsize("<" + form)))[0]
        return int(value)

    def _line(self) -> str:
        end = self._data.find(b"\n", self.at)
        if end < 0:
            raise PickleError("it is cut")
        return _text(self._bytes(end - self.at + 1)[:-1])

    def _pop(self) -> Any:
        if not self._stack or self._stack[-1] is _MARK:
            raise PickleError("it takes more from the stack than is there")
        return self._stack.pop()

    def _pop_to_mark(self) -> list[Any]:
        for place in range(len(self._stack) - 1, -1, -1):
            if self._stack[place] is _MARK:
                items = self._stack[place + 1 :]
                del self._stack[place:]
                return items
        raise PickleError("it takes more from the stack than is there")

    def _top(self, kind: type) -> Any:
        value = self._stack[-1] if self._stack else None
        if not isinstance(value, kind):
            raise PickleError(f"what should be a {kind.__name__} is none")
        return value

    # What each opcode does.

    def _protocol(self) -> None:
        version = self._number("B")
        if not 2 <= version <= 5:
            raise PickleError(f"its pickle protocol is {version}; known are 2 to 5")

    def _frame(self) -> None:
        self._bytes(8)  # a hint how much to read at once, which changes nothing here

    def _long(self) -> None:
        size = self._number("B")
        if size > _LONGEST_INTEGER:
            raise PickleError(f"it has an integer of {size} bytes; at most {_LONGEST_INTEGER}")
        self._stack.append(int.from_bytes(self._bytes(size), "little", signed=True))

    def _float(self) -> None:
        self._stack.append(struct.unpack(">d", self._bytes(8))[0])

    def _put(self, place: int) -> None:
        value = self._pop()
        self._stack.append(value)
        self._memo[place] = value

    def _get(self, place: int) -> None:
        if place not in self._memo:
            raise PickleError(f"it asks for object {place} that it never kept")
        self._stack.append(self._memo[place])

    def _tuple(self, size: int) -> None:
        items = [self._pop() for _ in range(size)]
        self._stack.append(tuple(reversed(items)))

    def _set(self, pairs: list[Any]) -> None:
        target = self._top(dict)
        if len(pairs) % 2:
            raise PickleError("a key has no value")
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            set_item(target, key, value)

    def _set_one(self) -> None:
        value, key = self._pop(), self._pop()
        self._set([key, value])

    def _append(self) -> None:
        value = self._pop()
        self._top(list).append(value)

    def _extend(self) -> None:
        values = self._pop_to_mark()
        self._top(list).extend(values)

    def _make_dictionary(self) -> None:
        pairs = self._pop_to_mark()
        self._stack.append({})
        self._set(pairs)

    def _global(self, module: Any, name: Any) -> None:
        if not isinstance(module, str) or not isinstance(name, str):
            raise PickleError("a name in it is no text")
        found = self._names.get((module, name))
        if found is None:
            raise PickleError(f"it names {shown(f'{module}.{name}')}, which no tensor needs")
        self._stack.append(found)

    def _stack_global(self) -> None:
        name, module = self._pop(), self._pop()
        self._global(module, name)

    def _reduce(self) -> None:
        arguments, function = self._pop(), self._pop()
        if not isinstance(arguments, tuple) or not isinstance(function, Name):
            raise PickleError("it calls what is no function")
        if not callable(function.meaning):
            raise PickleError("it calls what is no function")
        self._stack.append(function.meaning(*arguments))

    def _build(self) -> None:
        """Attributes of an object, as a state dictionary's `_metadata`: nothing that is needed."""
        self._pop()
        self._top(dict)

    def _persistent_id(self) -> None:
        identity = self._pop()
        if self._persistent is None:
            raise PickleError("it points outside where nothing is")
        self._stack.append(self._persistent(identity))


def set_item(target: dict[Any, Any], key: Any, value: Any) -> None:
    """Sets a key that is text or an integer; nested tuples could take for ever to hash."""
    if not isinstance(key, str | int):
        raise PickleError("a key in it is neither text nor a number")
    target[key] = value


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        raise PickleError("a text in it is not UTF-8") from None


def _push(value: Any) -> Callable[[_Machine], None]:
    return lambda m: m._stack.append(value)


def _sized(form: str) -> Callable[[_Machine], None]:
    return lambda m: m._stack.append(_text(m._bytes(m._number(form))))


_STEPS: dict[bytes, Callable[[_Machine], None]] = {
    b"\x80": _Machine._protocol,
    b"\x95": _Machine._frame,
    b"(": _push(_MARK),
    b"N": _push(None),
    b"\x88": _push(True),
    b"\x89": _push(False),
    b")": _push(()),
    b"]": lambda m: m._stack.append([]),
    b"}": lambda m: m._stack.append({}),
    b"J": lambda m: m._stack.append(m._number("i")),
    b"K": lambda m: m._stack.append(m._number("B")),
    b"M": lambda m: m._stack.append(m._number("H")),
    b"\x8a": _Machine._long,
    b"G": _Machine._float,
    # Text of Python 3, and of Python 2, whose own strings held names, too.
    b"X": _sized("I"),
    b"\x8c": _sized("B"),
    b"\x8d": _sized("Q"),
    b"T": _sized("I"),
    b"U": _sized("B"),
    b"q": lambda m: m._put(m._number("B")),
    b"r": lambda m: m._put(m._number("I")),
    b"\x94": lambda m: m._put(len(m._memo)),
    b"h": lambda m: m._get(m._number("B")),
    b"j": lambda m: m._get(m._number("I")),
    b"t": lambda m: m._stack.append(tuple(m._pop_to_mark())),
    b"\x85": lambda m: m._tuple(1),
    b"\x86": lambda m: m._tuple(2),
    b"\x87": lambda m: m._tuple(3),
    b"s": _Machine._set_one,
    b"u": lambda m: m._set(m._pop_to_mark()),
    b"a": _Machine._append,
    b"e": _Machine._extend,
    b"d": _Machine._make_dictionary,
    b"l": lambda m: m._stack.append(m._pop_to_mark()),
    b"c": lambda m: m._global(m._line(), m._line()),
    b"\x93": _Machine._stack_global,
    b"R": _Machine._reduce,
    b"b": _Machine._build,
    b"Q": _Machine._persistent_id,
}
