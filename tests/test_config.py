"""Configuration: strict, every fault at once, and true to its file."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanmap.calibration import CalibrationFile
from scanmap.config import Config, load, parse, preset_names
from scanmap.errors import CalibrationError, ConfigError


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_loads_and_has_a_head(name: str) -> None:
    config = load(name)
    assert config.head().baseline_m > 0.01
    assert config.description


def test_presets_named_by_the_issue_are_there() -> None:
    assert {"twin-room", "thesis", "thesis-beta0", "wide", "srv-turntable"} <= set(preset_names())


@pytest.mark.parametrize("name", preset_names())
def test_round_trip_through_toml(name: str) -> None:
    config = load(name)
    assert parse(config.dumps(), "again") == config


@pytest.mark.parametrize("name", preset_names())
def test_explained_is_the_same_configuration(name: str) -> None:
    config = load(name)
    assert parse(config.explained(), "explained") == config


def test_explained_gives_every_plain_key_its_meaning() -> None:
    for line in load(None).explained().splitlines():
        if line and not line.startswith(("[", "#")):
            assert "  # " in line, line


def test_set_changes_single_keys() -> None:
    config = load("twin-room", ["sweep.step_deg=0.5", 'triangulation.model="ratio"', "laserline.method=cog"])
    assert config.sweep.step_deg == 0.5
    assert config.triangulation.model == "ratio"
    assert config.laserline.method == "cog"


def test_every_fault_is_named_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        parse(
            "[sweep]\nstep_dge = 1.0\nstep_deg = 'x'\n[triangulation]\nrange_max_m = -1.0\nmodel = 'plain'\n",
            "rig.toml",
        )
    text = str(caught.value)
    assert "sweep.step_dge is no key here" in text and "step_deg" in text.split("valid:")[1]
    assert "sweep.step_deg = 'x'" in text
    assert "triangulation.range_max_m = -1.0" in text
    assert "'plain'" in text and "pixel_angle" in text
    assert "\n" not in text


def test_text_is_never_taken_for_a_number() -> None:
    with pytest.raises(ConfigError, match="step_deg"):
        parse('[sweep]\nstep_deg = "0.5"\n', "rig.toml")


def test_unknown_section_names_the_valid_ones() -> None:
    with pytest.raises(ConfigError, match=r"sweeep is no key here; valid: .*sweep"):
        parse("[sweeep]\nstep_deg = 1.0\n", "rig.toml")


@pytest.mark.parametrize("setting", ["sweep.step_deg", "=1", "sweep..step_deg=1", "description.x=1"])
def test_malformed_setting_is_one_clear_line(setting: str) -> None:
    with pytest.raises(ConfigError, match=r"--set|description"):
        load(None, ["description=room", setting])


def test_missing_configuration_names_the_presets() -> None:
    with pytest.raises(ConfigError, match="twin-room"):
        load("no-such-rig.toml")


def test_broken_toml_names_the_line() -> None:
    with pytest.raises(ConfigError, match="line 2"):
        parse("[sweep]\nstep_deg = = 1\n", "rig.toml")


def test_calibration_path_counts_from_the_file(tmp_path, monkeypatch) -> None:
    (tmp_path / "rigs").mkdir()
    rig = tmp_path / "rigs" / "mine.toml"
    rig.write_text('calibration = "head.toml"\n')
    load("twin-room").head().save(tmp_path / "rigs" / "head.toml")
    monkeypatch.chdir(tmp_path)
    assert load(str(rig)).head().baseline_m == load("twin-room").head().baseline_m


def test_faults_inside_an_inline_calibration_are_named_by_path() -> None:
    with pytest.raises(ConfigError, match=r"calibration\.image\.width"):
        parse("[calibration.image]\nwidth = -5\nheight = 4\n[calibration.head]\nbaseline_m = 0.1\n", "rig.toml")


def test_no_calibration_is_said() -> None:
    with pytest.raises(CalibrationError, match="--calibration"):
        parse("", "empty").head()


@given(st.floats(0.01, 90, allow_nan=False), st.floats(0.1, 50), st.text(st.characters(codec="utf-8"), max_size=20))
def test_any_value_survives_the_file(step: float, reach: float, text: str) -> None:
    document = {
        "description": text,
        "sweep": {"step_deg": step},
        "triangulation": {"range_max_m": reach},
    }
    config = Config.model_validate(document)
    assert parse(config.dumps(), "again") == config
    assert tomllib.loads(config.dumps())["sweep"]["step_deg"] == step


def test_inline_calibration_is_the_file_form() -> None:
    assert isinstance(load("wide").calibration, CalibrationFile)
