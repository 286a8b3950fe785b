"""Memory that this process and a worker share: what a pipe would copy four times is copied twice, and nobody waits.

A pipe holds less than a message of a dozen pictures, so that whoever reads one waits for whoever writes it, with the
interpreter's lock to be had for every part.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import pickle
from typing import IO, Any

# [bytes] for one message and its answer: a dozen pictures of 600 kB. Memory that nobody writes to costs nothing.
SLOT_BYTES = 8 << 20
_ALIGNED = 64


def shared_file(slots: int) -> int | None:
    """The number of an open file in memory, for so many messages at a time; None where there is no such thing."""
    with contextlib.suppress(AttributeError, OSError):  # another system than Linux; no memory to be had
        number = os.memfd_create("scanmap")
        os.ftruncate(number, slots * SLOT_BYTES)
        return number
    return None


class Shared:
    """Sends values over a pipe, their large parts through shared memory as far as there is room."""

    def __init__(self, file: int | None) -> None:
        """Map a `shared_file`; without one all goes over the pipe."""
        self._memory = None if file is None else memoryview(mmap.mmap(file, 0))

    def dump(self, value: object, pipe: IO[bytes], slot: int) -> None:
        """Send a value; `slot` says where in the memory no other message is on its way.

        Arrays and `pickle.PickleBuffer`s in it are its large parts.

        Raises:
            OSError: the pipe is closed.
        """
        end, stop = slot * SLOT_BYTES, (slot + 1) * SLOT_BYTES
        places: list[tuple[int, int, bool]] = []

        def stays(part: pickle.PickleBuffer) -> bool:
            """Whether a part stays in the message."""
            nonlocal end
            raw = part.raw()
            if self._memory is None or end + raw.nbytes > stop:
                return True
            self._memory[end : end + raw.nbytes] = raw
            places.append((end, raw.nbytes, raw.readonly))
            end += -(-raw.nbytes // _ALIGNED) * _ALIGNED
            return False

        data = pickle.dumps(value, protocol=5, buffer_callback=stays)
        pickle.dump((places, data), pipe, protocol=5)
        pipe.flush()

    def load(self, pipe: IO[bytes]) -> Any:
        """The next value; nothing of it is left in the shared memory.

        Raises:
            EOFError: the pipe is closed.
        """
        places, data = pickle.load(pipe)
        memory = self._memory or memoryview(b"")
        parts = [(bytes if fixed else bytearray)(memory[at : at + size]) for at, size, fixed in places]
        return pickle.loads(data, buffers=parts)
