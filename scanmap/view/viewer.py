"""Start the viewer's own program, on this machine only, and without its usage statistics."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from scanmap.errors import ConfigError

LOOPBACK = "127.0.0.1"


def viewer_binary() -> Path:
    """The viewer's program; not its Python wrapper, which leaves the program behind when it is ended.

    Raises:
        ConfigError: not installed.
    """
    package = importlib.util.find_spec("rerun_cli")
    folder = Path(package.origin).parent if package and package.origin else None
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    if folder is None or not (folder / name).exists():
        raise ConfigError("the viewer is not installed; install it with `pip install rerun-sdk`")
    return folder / name


def viewer_environment() -> dict[str, str]:
    """This process's environment for the viewer, with usage statistics off.

    The viewer counts its use unless it runs in continuous integration, or the user's own settings say so.
    Those settings are the user's; the environment is ours.
    """
    environment = {name: value for name, value in os.environ.items() if name != "FORCE_RERUN_ANALYTICS"}
    return environment | {"CI": "true"}


def live_address(port: int) -> str:
    """The address of a live view on this machine."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def check_port(port: int) -> None:
    """Raise ConfigError unless a live view can listen on `port`."""
    if not 1 <= port <= 65535:
        raise ConfigError(f"port {port} for the live view: it must be 1 to 65535, for example --live 9876")
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        if sys.platform != "win32":  # elsewhere it would allow a port that is taken
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise ConfigError(
                f"port {port} for the live view cannot be used ({error.strerror}); "
                f"close the other viewer or choose another, for example --set view.live_port={free_port()}"
            ) from error


def free_port() -> int:
    """A port that nobody listens on now."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
        return port


def show(source: Path | str | int, *, start_s: float = 1.5) -> subprocess.Popen[bytes]:
    """Open the viewer's window on a recording, or on a live view.

    Args:
        source: path of an .rrd or .mcap file, or the port of a live view on this machine.
        start_s: watch the viewer this long for an early end [s].

    Returns:
        The viewer's process; it goes on by itself.

    Raises:
        ConfigError: no such file, no display, viewer not installed, or it ended at once.
    """
    if isinstance(source, int):
        what = ["--connect", live_address(source)]
        hint = f"from a machine with one, `ssh -L {source}:{LOOPBACK}:{source}` here and `rerun --connect` there"
    else:
        if not Path(source).is_file():
            raise ConfigError(
                f"{source} is not a file; give an .rrd, or make one with `scanmap view SOURCE --save F.rrd`"
            )
        what = [str(source)]
        hint = "write a file with --save F.rrd and open it with `rerun F.rrd` where there is one"
    if not has_display():
        raise ConfigError(f"no display to open the viewer on (DISPLAY and WAYLAND_DISPLAY are not set); {hint}")
    return start_viewer([*what, "--port", "auto"], start_s=start_s)


def start_viewer(arguments: list[str], *, start_s: float = 1.5) -> subprocess.Popen[bytes]:
    """Start the viewer's program with `arguments`, bound to this machine; see `show`."""
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [str(viewer_binary()), "--bind", LOOPBACK, *arguments],
            env=viewer_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
        )
        until = time.monotonic() + start_s
        while time.monotonic() < until and process.poll() is None:
            time.sleep(0.05)
        if process.poll() not in (None, 0):
            errors.seek(0)
            lines = errors.read().decode(errors="replace").strip().splitlines() or ["no message"]
            raise ConfigError(
                f"the viewer ended at once (code {process.returncode}): {lines[-1]}; "
                "write a file with --save F.rrd and open it on another machine"
            )
    return process


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
