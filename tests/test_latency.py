"""Latency of the camera: the solver on made-up sweeps and blinks, and the twin's own, found again."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanmap import config as configuration
from scanmap import session
from scanmap.calibration import Calibration
from scanmap.errors import CalibrationError, ConfigError
from scanmap.session import latency as measuring
from scanmap.session.latency import laser_contrast, latency_by_blinks, latency_by_sweeps
from scanmap.session.rigs import OpenRig, open_twin
from scanmap.solvers.latency import Blink, Latency, Pass, latency_of_blinks, latency_of_sweeps, shift_between

F64 = np.ndarray


def room(bearing: F64, rows: int = 40) -> F64:
    """Columns (B, H) a head sees: walls that come and go, a depth edge, rows without a line."""
    row = np.arange(rows)
    smooth = 300 + 60 * np.sin(3 * bearing)[:, None] + 25 * np.sin(7 * bearing[:, None] + 0.05 * row)
    edge = 80.0 * (bearing[:, None] > 0.6 + 0.002 * row)
    columns = smooth + edge
    columns[:, row % 11 == 3] = np.nan
    return columns


def two_passes(speed: float, latency: float, backlash: float, rng: np.random.Generator) -> tuple[float, Pass, Pass]:
    """Sweeps at 30 pictures a second, 2 ms rms of jitter, whose stamps nobody corrected."""
    there = np.arange(0.1, 1.1, speed / 30)
    passes = []
    for direction in (1, -1):
        true = there[::direction]
        late = latency + rng.normal(0, 0.002, len(true))
        reported = true + direction * (speed * late + backlash / 2)
        passes.append(Pass(reported, room(true) + rng.normal(0, 0.1, (len(true), 40))))
    return speed, passes[0], passes[1]


@settings(max_examples=6)
@given(latency=st.floats(-0.05, 0.4), seed=st.integers(0, 1000))
def test_latency_from_two_directions(latency: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = latency_of_sweeps([two_passes(math.radians(6), latency, 0.0, rng)])
    assert found.latency_s == pytest.approx(latency, abs=5 * max(found.sigma_s, 2e-4))
    assert found.sigma_s < 0.003


def test_two_speeds_tell_latency_from_backlash() -> None:
    rng = np.random.default_rng(4)
    slow, fast = (two_passes(math.radians(speed), 0.08, math.radians(0.3), rng) for speed in (3, 6))
    both = latency_of_sweeps([slow, fast])
    assert both.latency_s == pytest.approx(0.08, abs=0.003)
    assert both.backlash_deg == pytest.approx(0.3, abs=0.02)
    # One speed cannot: the play is taken for latency.
    assert latency_of_sweeps([fast]).latency_s == pytest.approx(0.08 + 0.3 / 2 / 6, abs=0.003)


def test_sweeps_that_show_nothing_are_refused() -> None:
    bearings = np.linspace(0, 1, 50)
    nothing = Pass(bearings, np.full((50, 40), np.nan))
    with pytest.raises(CalibrationError, match="too few rows"):
        shift_between(nothing, nothing, 0.2)


@pytest.mark.parametrize("exposure_s", [0.001, 0.02])
def test_latency_from_blinks_at_even_phases(exposure_s: float) -> None:
    rng = np.random.default_rng(8)
    blinks = []
    for number in range(48):
        switched = 10 * number + 0.618 * number * 0.0333 % 0.0333
        exposed = 10 * number + np.arange(-4, 14) * 0.0333  # middles
        lit = np.clip((exposed - switched) / exposure_s + 0.5, 0, 1)
        levels = lit if number % 2 == 0 else 1 - lit
        blinks.append(Blink(switched, exposed + 0.12 + rng.normal(0, 0.002, 18), levels + rng.normal(0, 0.02, 18)))
    found = latency_of_blinks(blinks)
    assert found.latency_s == pytest.approx(0.12, abs=0.0015)
    assert found.sigma_s < 0.002
    with pytest.raises(CalibrationError, match="blinks of the laser are seen"):
        latency_of_blinks([blink._replace(levels=np.zeros(18)) for blink in blinks])


SMALL = ("calibration.image.width=320", "calibration.image.height=240", "twin.latency_s=0.08", "twin.jitter_s=0.002",
         "twin.rate_hz=12", "sweep.start_deg=30", "sweep.end_deg=50", "sweep.speed_deg_s=6")  # fmt: skip


@pytest.fixture
def twin() -> OpenRig:
    config = configuration.load("twin-room", SMALL)
    return open_twin(config, config.head())


def test_the_twins_latency_is_found_by_sweeps(twin: OpenRig) -> None:
    config = configuration.load("twin-room", SMALL)
    said: list[str] = []
    found = latency_by_sweeps(twin, config, config.head(), (6.0,), said.append)
    twin.close()
    assert found.latency_s == pytest.approx(0.08, abs=0.003)
    assert said[0] == "sweeping 30 to 50 deg and back at 6 deg/s"
    assert all(re.fullmatch(r"at -?\d+ deg, \d+ pictures", line) for line in said[1:])


def test_a_sweep_for_the_latency_is_short_and_two_speeds_lie_far_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """The default twin's pictures are drawn small: nobody waits for ten thousand large ones."""
    seen: list[tuple[float, ...]] = []

    def swept(opened: OpenRig, config: configuration.Config, head: Calibration, speeds: tuple[float, ...],
              progress: object, span_deg: float | None) -> Latency:  # fmt: skip
        seen.append((opened.rig.camera.width, opened.rig.camera.height, *speeds))
        return Latency(0.08, 0.001, 1)

    monkeypatch.setattr(measuring, "latency_by_sweeps", swept)
    for settings_ in ((), ("stage.speed_deg_s=8",), ("calibration.image.width=320", "calibration.image.height=240")):
        session.measure_latency(session.Choice("twin-room", settings_), "sweep", (), lambda _: None)
    assert seen == [(640, 480, 6.0, 18.0), (640, 480, 6.0, 3.0), (320, 240, 6.0, 18.0)]


@pytest.mark.parametrize(
    ("bearings", "span", "speed", "said"),
    [
        (("0", "180"), None, 6.0, "78 to 102"),
        (("180", "0"), None, 1.0, "95 to 85"),
        (("0", "180"), 60.0, 6.0, "60 to 120"),
        (("30", "50"), 60.0, 6.0, "30 to 50"),
    ],
)
def test_a_pass_is_about_the_middle_of_the_sweep(
    bearings: tuple[str, str], span: float | None, speed: float, said: str
) -> None:
    config = configuration.load("twin-room", (f"sweep.start_deg={bearings[0]}", f"sweep.end_deg={bearings[1]}"))

    class ToldError(Exception):
        pass

    def tell(line: str) -> None:
        raise ToldError(line)

    opened = open_twin(configuration.load("twin-room", SMALL), configuration.load("twin-room", SMALL).head())
    with pytest.raises(ToldError, match=f"sweeping {said} deg and back at {speed:g} deg/s"):
        latency_by_sweeps(opened, config, config.head(), (speed,), tell, span)
    opened.close()


@pytest.mark.slow  # the quick suite blinks in `doctor`
def test_the_twins_latency_is_found_by_blinking_and_the_laser_is_off_afterwards(twin: OpenRig) -> None:
    found, contrast = latency_by_blinks(twin, lambda _: None)
    assert found.latency_s == pytest.approx(0.08, abs=0.004)
    assert contrast.level_dn > 50 and contrast.lit_px > 100
    twin.rig.stage.laser(False)
    assert contrast.on > contrast.off + 40
    assert laser_contrast(twin.rig).lit_px > 100
    twin.close()


def test_what_cannot_be_measured_is_said() -> None:
    choice = session.Choice("twin-room", (*SMALL, "stage.laser=always-on"))
    with pytest.raises(ConfigError, match="cannot blink"):
        session.measure_latency(choice, "blink", (), lambda _: None)


def flatness(*more: str) -> float:
    """Median distance of a scan's points from the walls they lie on [m]."""
    size = ("calibration.image.width=640", "calibration.image.height=480", "sweep.start_deg=20", "sweep.end_deg=60")
    choice = session.Choice("twin-room", (*size, "sweep.step_deg=0.5", *more))
    with session.prepare_scan(choice, session.Outputs(), view=False) as job:
        result = job.run(lambda _: None, lambda: False)
    assert result.truth is not None
    return result.truth.median_m


@pytest.mark.slow
def test_a_continuous_sweep_with_its_latency_measured_is_as_flat_as_one_in_steps() -> None:
    moving = ("sweep.mode=continuous", "sweep.speed_deg_s=6", "twin.latency_s=0.08", "twin.jitter_s=0.002")
    choice = session.Choice("twin-room", (*SMALL[:2], *moving, "sweep.start_deg=20", "sweep.end_deg=60"))
    lines = session.measure_latency(choice, "sweep", (6.0,), lambda _: None)
    measured = lines[-1].rpartition("=")[2]
    steps = flatness()
    assert flatness(*moving, f"camera.latency_s={measured}") < 1.2 * steps
    assert flatness(*moving) > 1.5 * steps  # what it is for
