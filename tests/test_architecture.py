"""The law of ARCHITECTURE.md, held: which module may import which, what is imported late, and what is not there."""

import ast
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "scanmap"

# Importer -> what it may import from scanmap; the table of ARCHITECTURE.md.
CORE = {"errors", "geometry", "shot", "laserline", "calibration", "triangulation", "scan"}
PARAMS = CORE | {"grid", "recording", "rig", "sweep", "twin", "view"}
MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "geometry": {"errors"},
    "shot": {"errors"},
    "laserline": {"errors"},
    "raycast": {"errors"},
    "calibration": {"errors", "geometry"},
    "rig": {"errors", "shot"},
    "triangulation": {"errors", "geometry", "laserline", "calibration"},
    "twin": {"errors", "geometry", "shot", "calibration", "raycast", "rig"},
    "sweep": {"errors", "shot", "rig"},
    "recording": {"errors", "shot", "calibration"},
    "scan": {"errors", "geometry", "triangulation", "laserline"},
    "grid": {"errors", "geometry", "scan", "laserline"},
    "pipeline": {"errors", "shot", "laserline", "calibration", "triangulation", "scan"},
    "view": CORE | {"pipeline", "grid"},
    "config": PARAMS | {"pipeline"},
    "solvers": CORE | {"recording", "grid", "pipeline", "view"},
    "session": PARAMS | {"pipeline", "config", "solvers", "raycast"},
    "cli": PARAMS | {"pipeline", "config", "solvers", "session"},
}
HEAVY = {"open3d", "rerun", "scipy", "rosbags", "mcap", "trimesh", "serial", "simplejpeg", "plyfile", "matplotlib"}
FORBIDDEN_NAMES = {"utils", "common", "types", "helpers", "manager"}


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    part = path.relative_to(PACKAGE).parts[0]
    return part.removesuffix(".py")


def imported(path: Path, *, top_level_only: bool = False) -> set[str]:
    """Dotted names this file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names: set[str] = set()
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if top_level_only and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        pending.extend(ast.iter_child_nodes(node))
    return names


@pytest.mark.parametrize("path", sources(), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_only_what_its_room_may(path: Path) -> None:
    room = room_of(path)
    if room == "__init__":
        return
    others = {name.split(".")[1] for name in imported(path) if name.startswith("scanmap.")} - {room, "__version__"}
    assert others <= MAY_IMPORT[room], f"{room} may not import {sorted(others - MAY_IMPORT[room])}"


@pytest.mark.parametrize("path", sources(), ids=lambda p: str(p.relative_to(ROOT)))
def test_heavy_libraries_are_imported_inside_functions(path: Path) -> None:
    heavy = {name.split(".")[0] for name in imported(path, top_level_only=True)} & HEAVY
    assert not heavy


def test_one_importer_each_of_open3d_and_rerun() -> None:
    importers: dict[str, set[str]] = {"open3d": set(), "rerun": set()}
    for path in sources():
        for library, rooms in importers.items():
            if any(name.split(".")[0] == library for name in imported(path)):
                rooms.add(room_of(path))
    assert importers == {"open3d": {"raycast"}, "rerun": {"view"}}


def test_no_import_circle() -> None:
    for room, allowed in MAY_IMPORT.items():
        for other in allowed:
            assert room not in MAY_IMPORT[other], f"{room} and {other} import each other"


def test_architecture_page_has_the_same_law() -> None:
    page = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)/?` \|.*\| ([^|]*) \|$", page, re.MULTILINE)
    written = {room: set(re.findall(r"`(\w+)`", allowed)) for room, allowed in rows}
    assert written == MAY_IMPORT


@pytest.mark.parametrize("room", sorted(path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()))
def test_architecture_page_names_every_file_once(room: str) -> None:
    page = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    (listed,) = re.findall(rf"^- \*\*{room}\*\* (.*?)\n(?=-|\n)", page, re.MULTILINE | re.DOTALL)
    named = re.findall(r"`(\w+)`", listed)
    there = {path.stem for path in (PACKAGE / room).glob("*.py")} - {"__init__"}
    assert set(named) == there, f"ARCHITECTURE.md, inside the rooms: {sorted(set(named) ^ there)}"
    assert len(named) == len(there)


def test_no_module_with_a_name_that_says_nothing() -> None:
    assert not {path.stem for path in sources()} & FORBIDDEN_NAMES


def test_only_the_cli_prints_or_exits() -> None:
    for path in sources():
        if room_of(path) == "cli":
            continue
        calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
        names = {ast.unparse(call.func) for call in calls}
        assert not names & {"print", "sys.exit", "exit", "logging.basicConfig"}, path


def test_help_loads_nothing_heavy() -> None:
    script = (
        "import sys; from scanmap.cli import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "print(sorted({m.split('.')[0] for m in sys.modules}))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(ast.literal_eval(result.stdout.splitlines()[-1]))
    assert not loaded & (HEAVY | {"numpy", "cv2", "pydantic"})


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_a_benchmark_still_finds_what_it_measures(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(path.parent))  # type: ignore[no-untyped-call]
    runpy.run_path(str(path), run_name="looked at")
