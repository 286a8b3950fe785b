"""Shared by the tests: data beside the checkout, and one small scan of the twin."""

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from hypothesis import settings

from scanmap import session
from scanmap.cli import main
from scanmap.twin.light import LightParams
from scanmap.twin.scene import RoomParams, Scene, build_scene

DATA = Path(__file__).parent.parent.parent / "shared" / "data"

# A smaller head and coarse steps: everything is exercised, in seconds.
SMALL = (
    "calibration.image.width=1280",
    "calibration.image.height=960",
    "sweep.step_deg=5.0",
)


# Wall time is no law on a machine that others use too.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")


@pytest.fixture(scope="session")
def data() -> Path:
    """The test data that is not part of the repository; skips where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"test data not found at {DATA}")
    return DATA


_bake = functools.lru_cache(maxsize=None)(build_scene)


def baked_scene(params: RoomParams, light: LightParams | None = None) -> Scene:
    """`build_scene`, but the light of a room is computed once for all tests: half the time of a small scan."""
    return _bake(RoomParams(**{name: getattr(params, name) for name in RoomParams.model_fields}), light)


@pytest.fixture
def baked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every twin that is opened has a `baked_scene`."""
    monkeypatch.setattr("scanmap.session.rigs.build_scene", baked_scene)


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str, str]]:
    """Run a command in an empty folder; gives exit code, output, errors."""
    monkeypatch.chdir(tmp_path)

    def call(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(list(words))
        said = capsys.readouterr()
        return int(ended.value.code or 0), said.out, said.err

    return call


class TwinScan:
    """A finished scan of the twin with its files."""

    def __init__(self, folder: Path, *settings: str) -> None:
        self.folder = folder
        self.cloud, self.map = folder / "room.ply", folder / "room.yaml"
        self.recording = folder / "room.mcap"
        outputs = session.Outputs((self.cloud,), self.map, self.recording)
        with pytest.MonkeyPatch.context() as patch, ExitStack() as opened:
            patch.setattr("scanmap.session.rigs.build_scene", baked_scene)
            choice = session.Choice(None, (*SMALL, *settings))
            job = self.job = opened.enter_context(session.prepare_scan(choice, outputs, view=False))
            self.result = job.run(lambda _: None, lambda: False)
            self.truth = job.truth


@pytest.fixture(scope="session")
def twin_scan(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TwinScan]:
    """The default room, small and coarse, with recording, cloud and map."""
    yield TwinScan(tmp_path_factory.mktemp("twin"))
