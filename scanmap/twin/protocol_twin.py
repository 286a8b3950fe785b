"""Where pyserial looks for what `twin://` means: it imports this module by its name.

`scanmap.twin.ports.plug` tells pyserial to look in this package.
"""

from __future__ import annotations

from scanmap.twin.ports import TwinPort


def serial_class_for_url(url: str) -> tuple[str, type[TwinPort]]:
    """pyserial's hook: the URL to open and the class to open it with."""
    return url, TwinPort
