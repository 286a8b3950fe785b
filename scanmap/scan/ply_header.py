"""The header of a PLY file: its format, comments and the fields of its vertices."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

_NUMPY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
# The names every reader knows, by numpy's type.
PLY_TYPES = {"<f4": "float", "<i4": "int", "|u1": "uchar"}
_ORDER = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
# Ten times the header of a scan of 20,000 bearings; what has none by then is no PLY.
_LONGEST = 1 << 23


class Header(NamedTuple):
    """What a PLY file says of itself."""

    form: str  # ascii, binary_little_endian or binary_big_endian
    comments: list[str]
    vertices: int  # how many
    fields: list[tuple[str, str]]  # name and numpy type
    size: int  # [bytes] of the header

    @property
    def record(self) -> np.dtype[Any]:
        """One vertex as it stands in the file."""
        return np.dtype([(name, _ORDER[self.form] + kind) for name, kind in self.fields])


def parse_header(data: bytes) -> Header:
    """The header at the beginning of `data`.

    Raises:
        ValueError: not a PLY, or its vertices are not the first element or hold lists.
    """
    # Only as a line of its own: a comment may hold the word too.
    end = re.search(rb"\nend_header[ \t]*\r?\n", data[:_LONGEST])
    if not data.startswith(b"ply") or end is None:
        raise ValueError("it does not begin with ply and a header")
    form, count, comments, fields, elements = "", 0, list[str](), list[tuple[str, str]](), list[str]()
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        word, _, rest = line.partition(" ")
        words = rest.split()
        if word == "comment":
            comments.append(rest)
        elif word == "format":
            form = words[0] if words else ""
        elif word == "element":
            elements.append(words[0] if words else "")
            count = _count(line, words) if elements == ["vertex"] else count
        elif word == "property" and elements == ["vertex"]:
            if len(words) != 2 or words[0] not in _NUMPY_TYPES:
                raise ValueError(f"its vertices have a property scanmap does not read: {line[:80]}")
            fields.append((words[1], _NUMPY_TYPES[words[0]]))
    if form not in _ORDER:
        raise ValueError(f"its format is {form or 'missing'}; valid: {', '.join(_ORDER)}")
    if elements[:1] != ["vertex"]:
        raise ValueError(f"its first element is {elements[0] if elements else 'missing'}, not vertex")
    return Header(form, comments, count, fields, end.end())


def _count(line: str, words: list[str]) -> int:
    if len(words) != 2 or not words[1].isdecimal():
        raise ValueError(f"it does not say how many vertices it has: {line[:80]}")
    return int(words[1])
