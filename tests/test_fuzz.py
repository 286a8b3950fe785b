"""Whatever a wire, a file or a user brings: one of scanmap's own errors or a result, never a crash, never a hang.

`make fuzz` runs 100,000 inputs; an ordinary test run a few. Inputs are damaged copies of good ones, and pure noise.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recorded_shots import CALIBRATION, made_up_shots, record

from scanmap import config as configuration
from scanmap.calibration import Calibration
from scanmap.errors import ScanmapError
from scanmap.recording import describe, open_source, recover
from scanmap.recording.bearings import read_bearings
from scanmap.rig import grbl_protocol as protocol
from scanmap.rig.serial_port import SerialPort

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "60"))

fuzz = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)

Damage = list[tuple[float, int, bytes]]  # where (0 to 1), how many bytes go, what comes instead
damages: st.SearchStrategy[Damage] = st.lists(
    st.tuples(st.floats(0, 1), st.sampled_from((0, 1, 1, 2, 8, 100)), st.binary(max_size=9)), min_size=1, max_size=4
)


def damaged(data: bytes, damage: Damage) -> bytes:
    for where, gone, instead in damage:
        at = round(where * len(data))
        data = data[:at] + instead + data[at + gone :]
    return data


LINES = (
    b"Grbl 1.1h ['$' for help]\r\nok\r\n<Idle|MPos:1.000,0.000,0.000|Bf:15,128|FS:0,0|WCO:0.000,0.000,0.000>\r\n"
    b"error:9\r\nALARM:1\r\n[MSG:'$H'|'$X' to unlock]\r\n$100=80.000\r\n[PRB:-12.500,0.000,0.000:1]\r\n"
    b"GrblHAL 1.1f ['$' or '$HELP' for help]\r\n<Hold:0|WPos:1,2,3|Pn:XYZ>\r\n[VER:1.1f.20240812:]\r\n"
)


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


@fuzz
@given(data=st.one_of(damages.map(lambda damage: damaged(LINES, damage)), st.binary(max_size=300)))
def test_what_comes_over_the_wire(data: bytes) -> None:
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


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


CSV = b'frame,bearing_deg,time_s\n0,0.0,0.0\n1,1.5,0.25\n2,-3e1,0.5\n"3",4,\n'


@fuzz
@given(data=st.one_of(damages.map(lambda damage: damaged(CSV, damage)), st.binary(max_size=200)))
def test_scan_csv(folder: Path, data: bytes) -> None:
    path = folder / "scan.csv"
    path.write_bytes(data)
    survives(lambda: read_bearings(path))


HEAD = CALIBRATION.dumps().encode()


@fuzz
@given(data=damages.map(lambda damage: damaged(HEAD, damage)))
def test_calibration_toml(data: bytes) -> None:
    survives(lambda: Calibration.loads(data.decode("utf-8", "replace"), source="fuzz"))


RIG = configuration.load("twin-room").dumps().encode()


@fuzz
@given(data=damages.map(lambda damage: damaged(RIG, damage)))
def test_rig_toml(data: bytes) -> None:
    survives(lambda: configuration.parse(data.decode("utf-8", "replace"), "fuzz"))


@pytest.fixture(scope="module")
def good(folder: Path) -> bytes:
    return record(folder / "good.mcap", made_up_shots(3, off=True, image_bytes=60)).read_bytes()


@fuzz
@given(damage=damages)
def test_mcap(folder: Path, good: bytes, damage: Damage) -> None:
    path, out = folder / "bad.mcap", folder / "out.mcap"
    path.write_bytes(damaged(good, damage))
    images = {shot.image: shot for shot in made_up_shots(3, off=True, image_bytes=60)}

    def read() -> None:
        for shot in open_source(path).shots():
            assert images[shot.image].background in (shot.background, images[shot.image].background)
            assert images[shot.image].bearing == shot.bearing

    survives(read)
    survives(lambda: describe(path).lines)
    survives(lambda: recover(path, out))
    out.unlink(missing_ok=True)


def survives(action: Callable[[], object]) -> None:
    """One of scanmap's own errors, in one line, is fine; anything else is not."""
    try:
        action()
    except ScanmapError as error:
        assert str(error).strip()
