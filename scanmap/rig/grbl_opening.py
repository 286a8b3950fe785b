"""Finding a GRBL board on a port: its greeting, its dialect, and the stage on it."""

from __future__ import annotations

import contextlib

from scanmap.errors import StageError
from scanmap.rig import grbl_protocol as protocol
from scanmap.rig.grbl import GrblStage
from scanmap.rig.grbl_link import GrblLink
from scanmap.rig.grbl_protocol import Dialect
from scanmap.rig.serial_port import open_serial, serial_devices
from scanmap.rig.stage import StageParams
from scanmap.rig.watchdog import Watchdog

BOOT_S = 2.5  # an Uno restarts when its port opens; its boot loader takes 1.6 s
GREETING_S = 0.3  # a board behind a network says its banner at once, if at all


def open_grbl(params: StageParams) -> GrblStage:
    """Open the board on `params.port`; `auto` takes the first port where one answers.

    Raises:
        StageError: no port, or none where a GRBL board answers.
    """
    if params.port != "auto":
        return _open_port(params.port, params)
    faults = []
    for device in serial_devices():
        try:
            return _open_port(device, params)
        except StageError as error:
            faults.append(f"{device}: {error}")
    raise StageError(
        "no GRBL board found ("
        + ("; ".join(faults) or "no serial port on this machine")
        + "): plug it in, or set stage.port; `scanmap doctor` lists what answers"
    )


def identify(url: str, params: StageParams) -> str:
    """Firmware and version of the board on a port; changes no setting, though opening may reset the board.

    Raises:
        StageError: the port cannot be opened, or nothing there answers like a GRBL board.
    """
    link = GrblLink(open_serial(url, params.baud), params.timeout_s)
    try:
        banner = link.await_banner(BOOT_S if "://" not in url else GREETING_S) or link.reset()
        dialect = _dialect(link, banner.dialect)
        return f"{dialect.value} {banner.version}"
    finally:
        if link.lit_by_startup:
            with contextlib.suppress(StageError):
                link.command("M5", despite_fault=True)
        link.close()


def _open_port(url: str, params: StageParams) -> GrblStage:
    port = open_serial(url, params.baud)
    link = GrblLink(port, params.timeout_s)
    try:
        banner = link.await_banner(BOOT_S if "://" not in url else GREETING_S) or link.reset()
        if banner.dialect is Dialect.GRBL and banner.version.startswith("0."):
            raise StageError(f"{url} runs grbl {banner.version}: flash grbl 1.1 or newer")
        dialect = _dialect(link, banner.dialect)
        stage = GrblStage(link, dialect, params)
        if params.watchdog and stage.laser_switchable and not url.startswith("twin://"):
            stage.watch_over(Watchdog(url, params.baud, stage.last_words))
        return stage
    except BaseException:
        with contextlib.suppress(StageError):
            link.leave()  # it may be homing
        link.close()
        raise


def _dialect(link: GrblLink, told_by_banner: Dialect) -> Dialect:
    build_info = link.command("$I", despite_fault=True)
    link.real_time = protocol.real_time_of_build_info(build_info)
    return protocol.dialect_of_build_info(build_info, told_by_banner)
