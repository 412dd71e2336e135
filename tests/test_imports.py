"""Imports go one way: between the three packages, and between the layers of ``bulletarm_gym``."""

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# A room (module or subpackage of bulletarm_gym) may import rooms of its own layer and of those before it.
LAYERS = (
    {"config_checks"},
    {"registry"},
    {"geometry", "config"},
    {"simulation"},
    {"robots", "objects", "surfaces"},
    {"scene"},
    {"observations"},
    {"control"},
    {"experts"},
    {"tasks"},
    {"wrappers"},
    {"env"},
    {"demonstrations"},
    {"benchmarks", "real_arm", "vector", "__init__"},
    {"command_line"},
    {"check", "play"},
)
LEVEL = {room: level for level, layer in enumerate(LAYERS) for room in layer}

FORBIDDEN = {
    "bulletarm_gym": {
        "sb3_extensions",
        "zoo_configs",
        "torch",
        "stable_baselines3",
        "sb3_contrib",
        "rl_zoo3",
    },
    "sb3_extensions": {"bulletarm_gym", "zoo_configs", "pybullet", "rl_zoo3"},
    "zoo_configs": {"bulletarm_gym", "pybullet", "rl_zoo3"},
}
# What the command line may know of the environments: data of the paper, files of episodes, how machine and
# environments are.
DOORS: dict[str, tuple[str, ...]] = {
    "sb3_extensions": ("bulletarm_gym.demonstrations",),  # when expert_data is the path of a file
    "zoo_configs": (
        "bulletarm_gym.benchmarks",
        "bulletarm_gym.demonstrations",
        "bulletarm_gym.check",
    ),
}
ENGINE = {"pybullet", "pybullet_utils"}


def _sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def _imported(path: Path) -> Iterator[str]:
    """Dotted names of everything a file imports, at any depth, relative imports resolved."""
    folder = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = folder[: len(folder) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            yield from (f"{module}.{alias.name}" for alias in node.names)


def _room(path: Path) -> str:
    """The room of ``bulletarm_gym`` that a file belongs to."""
    parts = path.relative_to(ROOT / "bulletarm_gym").parts
    return parts[0].removesuffix(".py")


def _imported_rooms(path: Path) -> set[str]:
    own = [name.split(".") for name in _imported(path) if name.split(".")[0] == "bulletarm_gym"]
    return {_named_room(parts[1]) if len(parts) > 1 else "__init__" for parts in own}


def _named_room(name: str) -> str:
    """``from bulletarm_gym import name`` means a room or, where there is none, something of ``__init__``."""
    folder = ROOT / "bulletarm_gym"
    return name if (folder / name).is_dir() or (folder / f"{name}.py").exists() else "__init__"


@pytest.mark.parametrize("package", FORBIDDEN)
def test_packages_import_one_way(package: str) -> None:
    assert _sources(package)
    for path in _sources(package):
        names = [name for name in _imported(path) if not name.startswith(DOORS.get(package, ()))]
        wrong = {name.split(".")[0] for name in names} & FORBIDDEN[package]
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_every_room_has_a_layer() -> None:
    rooms = {_room(path) for path in _sources("bulletarm_gym")}
    assert rooms <= LEVEL.keys(), f"give {sorted(rooms - LEVEL.keys())} a place in LAYERS"


def test_rooms_import_one_way() -> None:
    for path in _sources("bulletarm_gym"):
        room = _room(path)
        above = {other for other in _imported_rooms(path) if LEVEL[other] > LEVEL[room]}
        assert not above, f"{path.relative_to(ROOT)} imports {sorted(above)}, which is above {room}"


def test_rooms_do_not_import_each_other_in_a_circle() -> None:
    graph: dict[str, set[str]] = {}
    for path in _sources("bulletarm_gym"):
        room = _room(path)
        graph.setdefault(room, set()).update(_imported_rooms(path) - {room})
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError with the circle


def test_only_simulation_imports_the_engine() -> None:
    for path in _sources("bulletarm_gym"):
        if _room(path) != "simulation":
            wrong = {name.split(".")[0] for name in _imported(path)} & ENGINE
            assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_only_simulation_calls_the_engine() -> None:
    for path in _sources("bulletarm_gym"):
        if _room(path) != "simulation":
            nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            lines = [
                node.lineno for node in nodes if isinstance(node, ast.Attribute) and node.attr == "client"
            ]
            assert not lines, f"{path.relative_to(ROOT)} uses PyBullet's client in the lines {lines}"


def test_importing_the_package_is_light() -> None:
    heavy = ["pybullet", "numba", "torch", "stable_baselines3", "h5py", "matplotlib"]
    code = f"import sys, bulletarm_gym; print(sorted(set({heavy}) & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
