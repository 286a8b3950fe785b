"""What arrives at the twin's board and waits for its main loop: a buffer of bytes, made into lines."""

from __future__ import annotations

from collections import deque

from scanmap.twin.board import DialectName

RX_BYTES = {"grbl": 128, "grblHAL": 1023, "FluidNC": 256}
LINE_CHARACTERS = {"grbl": 79, "grblHAL": 255, "FluidNC": 255}
UART_BYTES = 2  # what the serial port itself holds while the processor does not look


_LEGACY = {ord("?"): 0x80, ord("~"): 0x81, ord("!"): 0x82}  # real-time commands and grblHAL's other names of them


def real_time(byte: int, dialect: DialectName, *, in_text: bool) -> int:
    """The real-time command that a byte is, by grblHAL's names; 0xFF for one that this board does not know.

    Args:
        in_text: it belongs to a `$` line of a grblHAL that takes no legacy commands there.
    """
    if dialect == "grblHAL":
        return byte if in_text else _LEGACY.get(byte, byte)
    return _LEGACY.get(byte, 0xFF if byte in _LEGACY.values() else byte)


class Receiver:
    """Bytes from the host; those that are real-time commands never come here."""

    def __init__(self, dialect: DialectName) -> None:
        self._dialect = dialect
        self._bytes: deque[int] = deque()
        self._line = self._comment = self._line_end = ""
        self.keeps_text = False  # a line that begins with `$` has come and is not done yet

    @property
    def free(self) -> int:
        """Bytes that still fit."""
        return RX_BYTES[self._dialect] - len(self._bytes)

    def add(self, byte: int) -> None:
        """Take a byte in while there is room; what does not fit is lost."""
        if byte == ord("$") and not self._line and not self._bytes:
            self.keeps_text = True
        if self.free > 0:
            self._bytes.append(byte)

    def take_line(self) -> str | None:
        """The next whole line, in upper case, without blanks and comments; None if there is none."""
        while self._bytes:
            character = chr(self._bytes.popleft())
            if character in "\r\n":
                second = self._dialect == "grblHAL" and not self._line and self._line_end not in ("", character)
                self._line_end = "" if second else character
                if second:
                    continue  # of a pair: grblHAL answers it once, grbl twice
                line, self._line, self._comment = self._line, "", ""
                return line
            if self._comment:
                self._comment = "" if (self._comment, character) == ("(", ")") else self._comment
            elif character in "(;":
                self._comment = character
            elif character > " " and (character != "/" or self._dialect == "FluidNC"):
                fits = len(self._line) <= LINE_CHARACTERS[self._dialect]
                self._line += character.upper() if fits else ""
        return None

    def is_too_long(self, line: str) -> bool:
        """Whether a line exceeds the board's line buffer."""
        return len(line) > LINE_CHARACTERS[self._dialect]
