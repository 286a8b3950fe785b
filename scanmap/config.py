"""`Config`: everything a user can set, as TOML; strict, frozen, every fault reported at once.

Each room of the house brings its own `...Params`; a section here is only its name. `--set key=value`
changes single keys; a configuration is a preset's name, a path, or nothing for the defaults.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from scanmap.calibration import Calibration, CalibrationFile
from scanmap.errors import CalibrationError, ConfigError, in_words
from scanmap.grid import GridParams
from scanmap.laserline import LaserLineParams
from scanmap.recording import RecordingParams
from scanmap.rig.camera import CameraParams
from scanmap.rig.stage import StageParams
from scanmap.scan import ScanParams
from scanmap.sweep import SweepParams
from scanmap.triangulation import TriangulationParams
from scanmap.twin import TwinParams
from scanmap.view import ViewParams

DEFAULT_PRESET = "twin-room"
POOL_ROWS = 9  # a scan pools along the line; find_laser_line alone does not


class Config(BaseModel, frozen=True, extra="forbid"):
    """One rig and how it scans; the whole of a rig's TOML."""

    description: str = Field("", description="what this rig is, for people")
    rig: Literal["twin", "hardware", "replay-only"] = Field(
        "twin",
        description="twin: the digital twin; hardware: [camera] and [stage]; replay-only: for recordings of a head "
        "that is not here",
    )
    calibration: str | CalibrationFile | None = Field(
        None, description="path of a calibration.toml, or its tables inline; left out: the recording's own"
    )
    sweep: SweepParams = SweepParams()
    laserline: LaserLineParams = LaserLineParams(pool_rows=POOL_ROWS)
    triangulation: TriangulationParams = TriangulationParams()
    scan: ScanParams = ScanParams()
    grid: GridParams = GridParams()
    recording: RecordingParams = RecordingParams()
    view: ViewParams = ViewParams()
    camera: CameraParams = CameraParams()
    stage: StageParams = StageParams()
    twin: TwinParams = TwinParams()

    def head(self) -> Calibration:
        """The calibration this configuration names.

        Raises:
            CalibrationError: it names none, or the file is damaged.
        """
        if self.calibration is None:
            raise CalibrationError(
                "no calibration: give --calibration calibration.toml, or set calibration in the configuration"
            )
        if isinstance(self.calibration, CalibrationFile):
            return self.calibration.build()
        return Calibration.load(self.calibration)

    def dumps(self) -> str:
        """This configuration as TOML; `parse` gives the same configuration back."""
        import tomli_w

        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))

    def explained(self, keys: tuple[str, ...] | None = None) -> str:
        """This configuration as TOML in which every key says its meaning, unit and limits; only `keys`, if given."""
        return "\n".join(_explain(self, (), keys)) + "\n"


def preset_names() -> list[str]:
    """Names of the configurations that come with scanmap."""
    return sorted(entry.name.removesuffix(".toml") for entry in _presets().iterdir() if entry.name.endswith(".toml"))


def load(name: str | None, settings: Iterable[str] = ()) -> Config:
    """Read a configuration and change single keys.

    Args:
        name: path of a TOML file, the name of a preset (`configs/thesis.toml` and `thesis` are the same
            preset where no such file exists), or None for the default, the twin's room.
        settings: `key=value` with dotted keys, the value in TOML's form (`sweep.step_deg=0.5`).

    Raises:
        ConfigError: not found, not TOML, or faulty; every fault with its path and what is allowed.
    """
    text, source, folder = _read(name or DEFAULT_PRESET)
    return parse(text, source, settings, folder)


def parse(text: str, source: str, settings: Iterable[str] = (), folder: Path | None = None) -> Config:
    """`Config` from TOML text; relative calibration paths count from `folder`. Raises as `load`."""
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source} is not valid TOML: {error}") from error
    settings = tuple(settings)
    source += " with the options given" if settings else ""
    calibration = document.get("calibration")
    if isinstance(calibration, str) and folder is not None:
        document["calibration"] = str(folder / calibration)
    for setting in settings:
        _apply(document, setting)
    if isinstance(document.setdefault("laserline", {}), dict):
        document["laserline"].setdefault("pool_rows", POOL_ROWS)
    # Where a key has no bounds, NaN would pass as a number.
    faults = {f"{path} = {value}: must be a finite number" for path, value in _not_finite(document)}
    try:
        # By way of JSON, strictly: a TOML array is a tuple, but text is never taken for a number.
        config = Config.model_validate_json(json.dumps(document, default=str), strict=True)
    except ValidationError as error:
        faults |= _faults(error)
    if faults:
        raise ConfigError(f"{source}: {'; '.join(sorted(faults))}. `scanmap config` lists every key with its meaning")
    return config


def _presets() -> Any:
    """The folder of presets: inside an installed package, beside it in a checkout."""
    installed = files("scanmap") / "configs"
    return installed if installed.is_dir() else Path(__file__).parent.parent / "configs"


def _read(name: str) -> tuple[str, str, Path | None]:
    path = Path(name)
    try:
        if path.is_file():
            return path.read_text(encoding="utf-8"), str(path), path.parent
        preset = path.stem if path.suffix == ".toml" and path.parent.name in ("", "configs") else name
        if preset in preset_names():
            return (_presets() / f"{preset}.toml").read_text(encoding="utf-8"), f"preset {preset}", None
    except UnicodeDecodeError as error:
        raise ConfigError(f"configuration {name} cannot be read: it is not UTF-8 text") from error
    except OSError as error:
        raise ConfigError(f"configuration {name} cannot be read: {error.strerror or error}") from error
    raise ConfigError(f"no configuration {name}: neither a file nor one of the presets {', '.join(preset_names())}")


def _apply(document: dict[str, Any], setting: str) -> None:
    key, equals, value = setting.partition("=")
    path = key.strip().split(".")
    if not equals or not all(path):
        raise ConfigError(f"--set {setting}: not of the form key=value; try --set sweep.step_deg=0.5")
    table = document
    for part in path[:-1]:
        below = table.setdefault(part, {})
        if not isinstance(below, dict):
            raise ConfigError(f"--set {setting}: {part} is a value, not a section")
        table = below
    try:
        table[path[-1]] = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        table[path[-1]] = value.strip()


def _not_finite(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Path and value of every number in a document that is NaN or infinite."""
    if isinstance(value, float) and not math.isfinite(value):
        yield path, value
    elif isinstance(value, dict | list):
        for key, below in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _not_finite(below, f"{path}.{key}" if path else str(key))


def _faults(error: ValidationError) -> set[str]:
    """Every fault in words: path, the bad value, what is allowed; the choices of one key in one."""
    extra: set[str] = set()
    wrong: dict[str, tuple[str, list[str]]] = {}
    for detail in error.errors():
        path, valid = _path_and_keys(detail["loc"])
        where = ".".join(path) or "configuration"
        message = in_words(detail["msg"])
        if detail["type"] == "extra_forbidden":
            extra.add(f"{where} is no key here; valid: {', '.join(valid)}")
        elif isinstance(detail["input"], float) and not math.isfinite(detail["input"]):
            continue  # said already, and better
        elif isinstance(detail["input"], dict) and detail["type"] == "string_type":
            continue  # a table was meant, and its own faults are named
        else:
            shown = detail["type"] != "missing" and not isinstance(detail["input"], dict)
            at = f"{where} = {detail['input']!r}" if shown else where
            wrong.setdefault(where, (at, []))[1].append(message)
    return extra | {f"{at}: {', or '.join(dict.fromkeys(messages))}" for at, messages in wrong.values()}


def _path_and_keys(loc: tuple[int | str, ...]) -> tuple[list[str], list[str]]:
    """A fault's path without pydantic's names for the branches of a union, and the keys valid where it ends."""
    path: list[str] = []
    table: type[BaseModel] | None = Config
    valid = list(Config.model_fields)
    for part in loc:
        own = table.model_fields.get(str(part)) if table is not None else None
        if own is None and _is_branch(part):
            continue
        path.append(str(part))
        valid = list(table.model_fields) if table is not None else valid
        table = _table_of(own) if own is not None else None
    return path, valid


def _is_branch(part: int | str) -> bool:
    """Whether pydantic made this part of a path up: the type tried, as in `sweep.passes.int`."""
    return part in ("str", "int", "float", "bool", CalibrationFile.__name__) or "[" in str(part)


def _table_of(info: FieldInfo) -> type[BaseModel] | None:
    """The model of a field that is a table, or may be one."""
    candidates = (info.annotation, *get_args(info.annotation))
    return next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), None)


def _explain(model: BaseModel, path: tuple[str, ...], keys: tuple[str, ...] | None = None) -> Iterator[str]:
    """TOML lines of one table: plain keys first, as TOML wants it, then the tables below."""
    import tomli_w

    tables, left_out = [], []
    for name, info in type(model).model_fields.items():
        if keys is not None and name not in keys:
            continue
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            tables.append((name, value, info))
            continue
        note = "".join((info.description or "", _limits(info)))
        if value is None or value == {}:
            left_out.append((name, info))
            continue
        plain = model.model_dump(mode="json", include={name})[name]
        line = tomli_w.dumps({name: plain}).strip()
        yield f"{_one_line(line)}  # {note}" if note else _one_line(line)
    for name, info in left_out:
        yield from _explain_left_out(name, info, path)
    for name, value, info in tables:
        yield ""
        about = info.description or (type(value).__doc__ or "").strip().splitlines()[0]
        yield f"# {about}"
        yield f"[{'.'.join((*path, name))}]"
        yield from _explain(value, (*path, name))


def _explain_left_out(name: str, info: FieldInfo, path: tuple[str, ...]) -> Iterator[str]:
    """The same of a key or table that is not there: as comments, ready to be filled in."""
    table = _table_of(info)
    note = "".join((info.description or "", _limits(info)))
    if table is None or note:
        yield f"# {name} =  # {note or 'a table, written by the solvers'}"
    if table is None:
        return
    yield f"# [{'.'.join((*path, name))}]  # {(table.__doc__ or '').strip().splitlines()[0]}"
    for key, below in table.model_fields.items():
        yield f"#   {key} =  # {below.description or ''}{_limits(below)}"


def _one_line(toml: str) -> str:
    return (
        " ".join(part.strip() for part in toml.splitlines()).replace("[ ", "[").replace(", ]", "]").replace(",]", "]")
    )


def _limits(info: FieldInfo) -> str:
    """Limits and choices of a field as a note: ` (>= 0, <= 180)`, ` (one of a, b)`."""
    choices = [c for c in get_args(info.annotation) if isinstance(c, str)]
    words = [f"one of {', '.join(choices)}"] if choices else []
    for bound, sign in (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<")):
        for limit in info.metadata:
            value = getattr(limit, bound, PydanticUndefined)
            if isinstance(value, int | float) and math.isfinite(value):
                words.append(f"{sign} {value:g}")
    return f" ({', '.join(words)})" if words else ""
