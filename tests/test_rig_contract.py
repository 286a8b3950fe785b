"""What every rig must do, one suite for three: the twin, a webcam and a board behind a pty, and a real head.

The real one needs a person beside it: `SCANMAP_RIG=my-rig.toml make test-hardware`. It turns by 10 deg at most, upward
from where a scan with that file begins, and its laser shines.
"""

# ruff: noqa: F401 (fixtures of other test files)
from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from test_hardware_scan import HARDWARE, Head, head

from scanmap import config as configuration
from scanmap import session
from scanmap.errors import StageError
from scanmap.recording import open_source
from scanmap.rig import Rig
from scanmap.session.rigs import open_rig
from scanmap.shot import decode_image
from scanmap.twin.ports import pty_port

SMALL = ("calibration.image.width=320", "calibration.image.height=240", "sweep.settle_s=0.0")
REACH_DEG = 10.0
POINTING_DEG = (
    0.1  # how near to where it was sent a head must report to be: a full step of 1.8 deg, geared or in 16 parts
)


@pytest.fixture(params=["twin", "pty", pytest.param("real", marks=pytest.mark.hardware)])
def choice(request: pytest.FixtureRequest, baked_once: None) -> Iterator[session.Choice]:
    if request.param == "twin":
        yield session.Choice("twin-room", SMALL)
    elif request.param == "pty":
        if os.name != "posix":
            pytest.skip("a pty needs POSIX")
        with pty_port(request.getfixturevalue("head").board) as url:
            yield session.Choice("twin-room", (*HARDWARE, f"stage.port={url}"))
    elif "SCANMAP_RIG" not in os.environ:
        pytest.skip("which head? SCANMAP_RIG=my-rig.toml names its configuration")
    else:
        yield session.Choice(os.environ["SCANMAP_RIG"])


@pytest.fixture
def config(choice: session.Choice) -> configuration.Config:
    return configuration.load(choice.config, choice.settings)


@pytest.fixture
def rig(config: configuration.Config) -> Iterator[Rig]:
    opened = open_rig(config, config.head())
    yield opened.rig
    opened.close()


def test_the_head_reports_where_it_was_sent(rig: Rig, config: configuration.Config) -> None:
    start = config.sweep.start_deg
    for deg in (0.0, 2.0, REACH_DEG, 5.0, 5.0, 0.0):
        reported = rig.stage.move_to(math.radians(start + deg))
        assert math.degrees(reported) == pytest.approx(start + deg, abs=POINTING_DEG)
        assert rig.stage.where() == pytest.approx(reported, abs=1e-6)


def test_a_place_has_one_bearing_from_wherever_the_head_comes(rig: Rig, config: configuration.Config) -> None:
    there = math.radians(config.sweep.start_deg + 5.0)
    reported = []
    for deg in (0.0, REACH_DEG, 4.0):
        rig.stage.move_to(math.radians(config.sweep.start_deg + deg))
        reported.append(rig.stage.move_to(there))
    assert np.ptp(reported) < math.radians(0.01)


def test_beyond_its_limits_it_goes_nowhere(rig: Rig, config: configuration.Config) -> None:
    before = rig.stage.where()
    for deg in (config.stage.min_deg - 1.0, config.stage.max_deg + 1.0, math.nan):
        with pytest.raises(StageError, match="outside"):
            rig.stage.move_to(math.radians(deg))
    assert rig.stage.where() == before


def test_the_laser_is_seen_when_on_and_gone_when_off(rig: Rig) -> None:
    if not rig.stage.laser_switchable:
        pytest.skip("the laser of this rig is always on")
    seen = []
    for on in (False, True, False):
        rig.stage.laser(on)
        seen.append(decode_image(rig.camera.grab().image).image.astype(float))
    # A line in half the rows, twice as bright as what else changes.
    half = len(seen[0]) // 2
    lit, noise = (np.partition((picture - seen[0]).ravel(), -half)[-half] for picture in seen[1:])
    assert lit > 3.0 + 2.0 * noise


def test_after_its_end_it_obeys_no_more(rig: Rig) -> None:
    rig.stage.laser(True)
    rig.close()
    rig.close()
    with pytest.raises(StageError):
        rig.stage.move_to(0.0)


def test_a_short_scan_records_every_bearing_and_measures(choice: session.Choice, tmp_path: Path) -> None:
    config = configuration.load(choice.config, choice.settings)
    end, step = config.sweep.start_deg + REACH_DEG, REACH_DEG / 4
    sweep = ("sweep.mode='step'", f"sweep.end_deg={end}", f"sweep.step_deg={step}", "sweep.passes='forward'")
    outputs = session.Outputs((tmp_path / "a.ply",), record=tmp_path / "a.mcap")
    again = session.Choice(choice.config, (*choice.settings, *sweep))
    with session.prepare_scan(again, outputs, view=False) as job:
        result = job.run(lambda _: None, lambda: False)
    assert result.ended == "finished" and result.summary.points > 0
    bearings = [math.degrees(shot.bearing) for shot in open_source(tmp_path / "a.mcap").shots()]
    assert bearings == pytest.approx(config.sweep.start_deg + step * np.arange(5), abs=POINTING_DEG)
