"""What is fuzzed: each target takes bytes and lets nothing through but scanmap's own errors."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from recorded_shots import CALIBRATION, made_up_shots, record

from scanmap import config as configuration
from scanmap.calibration import Calibration
from scanmap.errors import ScanmapError
from scanmap.recording import describe, open_source, recover
from scanmap.recording.bearings import read_bearings
from scanmap.rig import grbl_protocol as protocol
from scanmap.rig.serial_port import SerialPort

Damage = list[tuple[float, int, bytes]]  # where (0 to 1), how many bytes go, what comes instead


def damaged(data: bytes, damage: Damage) -> bytes:
    for where, gone, instead in damage:
        at = round(where * len(data))
        data = data[:at] + instead + data[at + gone :]
    return data


def survives(action: Callable[[], object]) -> None:
    """One of scanmap's own errors, in one line, is fine; anything else is not."""
    try:
        action()
    except ScanmapError as error:
        assert str(error).strip()


class Wire:
    """A pyserial port on which these bytes arrive."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    @property
    def in_waiting(self) -> int:
        return len(self.data)

    def read(self, size: int) -> bytes:
        chunk, self.data = self.data[:size], self.data[size:]
        return chunk


def wire(data: bytes, _: Path) -> None:
    port = SerialPort(Wire(data), "wire")
    lines = port.drain()
    while (line := port.read_line(0.0)) is not None:
        lines.append(line)
    for line in lines:
        protocol.parse_banner(line)
        protocol.parse_setting(line)
        protocol.parse_probe(line)
        code = protocol.parse_code(line)
        assert code is None or protocol.explain(*code)
        status = protocol.parse_status(line)
        assert status is None or status.position
    protocol.dialect_of_build_info(lines, protocol.Dialect.GRBL)


def scan_csv(data: bytes, folder: Path) -> None:
    path = folder / "scan.csv"
    path.write_bytes(data)
    survives(lambda: read_bearings(path))


def calibration_toml(data: bytes, _: Path) -> None:
    survives(lambda: Calibration.loads(data.decode("utf-8", "replace"), source="fuzz"))


def rig_toml(data: bytes, _: Path) -> None:
    survives(lambda: configuration.parse(data.decode("utf-8", "replace"), "fuzz"))


SHOTS = made_up_shots(3, off=True, image_bytes=60)
IMAGES = {shot.image: shot for shot in SHOTS}


def mcap(data: bytes, folder: Path) -> None:
    path, out = folder / "bad.mcap", folder / "out.mcap"
    path.write_bytes(data)

    def read() -> None:
        for shot in open_source(path).shots():
            assert IMAGES[shot.image].background in (shot.background, IMAGES[shot.image].background)
            assert IMAGES[shot.image].bearing == shot.bearing

    survives(read)
    survives(lambda: describe(path).lines)
    survives(lambda: recover(path, out))
    out.unlink(missing_ok=True)


def _good_mcap() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return record(Path(folder) / "good.mcap", SHOTS).read_bytes()


class Target(NamedTuple):
    """Something that reads, and a good input of it."""

    read: Callable[[bytes, Path], None]
    good: bytes


TARGETS = {
    "wire": Target(
        wire,
        b"Grbl 1.1h ['$' for help]\r\nok\r\n<Idle|MPos:1.000,0.000,0.000|Bf:15,128|FS:0,0|WCO:0.000,0.000,0.000>\r\n"
        b"error:9\r\nALARM:1\r\n[MSG:'$H'|'$X' to unlock]\r\n$100=80.000\r\n[PRB:-12.500,0.000,0.000:1]\r\n"
        b"GrblHAL 1.1f ['$' or '$HELP' for help]\r\n<Hold:0|WPos:1,2,3|Pn:XYZ>\r\n[VER:1.1f.20240812:]\r\n",
    ),
    "scan.csv": Target(scan_csv, b'frame,bearing_deg,time_s\n0,0.0,0.0\n1,1.5,0.25\n2,-3e1,0.5\n"3",4,0.75\n'),
    "calibration TOML": Target(calibration_toml, CALIBRATION.dumps().encode()),
    "rig TOML": Target(rig_toml, configuration.load("twin-room").dumps().encode()),
    "MCAP": Target(mcap, _good_mcap()),
}
