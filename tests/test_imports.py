"""Imports point one way: between the three packages, and between the modules and subpackages of each."""

import ast
import graphlib
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
GYM = ROOT / "bulletarm_gym"

# A module or subpackage of bulletarm_gym imports those of its own line and of the lines above it.
LAYERS = """
config_checks
registry
geometry config randomization
simulation
robots objects surfaces
scene
observations
control
experts
tasks
episode
wrappers
env
demonstrations
benchmarks real_arm vector __init__
command_line
check play
"""
LEVEL = {name: level for level, layer in enumerate(LAYERS.split("\n")) for name in layer.split()}
FORBIDDEN = {
    "bulletarm_gym": "sb3_extensions zoo_configs torch stable_baselines3 sb3_contrib rl_zoo3",
    "sb3_extensions": "bulletarm_gym zoo_configs pybullet rl_zoo3",
    "zoo_configs": "bulletarm_gym pybullet rl_zoo3",
}
# Exceptions: files of episodes, the paper's numbers, and the checks of the machine and the environments.
ALLOWED: dict[str, tuple[str, ...]] = {
    "bulletarm_gym": (),
    "sb3_extensions": ("bulletarm_gym.demonstrations",),
    "zoo_configs": ("bulletarm_gym.benchmarks", "bulletarm_gym.demonstrations", "bulletarm_gym.check"),
}
ENGINE = {"pybullet", "pybullet_utils"}


@cache
def _tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def _imported(path):
    """Dotted names of everything that a file imports, relative imports resolved."""
    folder = path.relative_to(ROOT).parent.parts
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = folder[: len(folder) - node.level + 1] if node.level else ()
            module = ".".join((*base, *([node.module] if node.module else [])))
            yield from (f"{module}.{alias.name}" for alias in node.names)


def _own(path):
    """Modules and subpackages of ``bulletarm_gym`` that a file imports; other names are of ``__init__``."""
    names = {name.split(".")[1] for name in _imported(path) if name.startswith("bulletarm_gym.")}
    return {name if name in LEVEL else "__init__" for name in names}


FILES = [(path.relative_to(GYM).parts[0].removesuffix(".py"), path) for path in sorted(GYM.rglob("*.py"))]
"""Files of ``bulletarm_gym`` with their module or subpackage."""


@pytest.mark.parametrize("package", FORBIDDEN)
def test_packages_import_one_way(package):
    paths = sorted((ROOT / package).rglob("*.py"))
    assert paths
    for path in paths:
        names = {name.split(".")[0] for name in _imported(path) if not name.startswith(ALLOWED[package])}
        assert not names & set(FORBIDDEN[package].split()), path


@pytest.mark.parametrize("package", FORBIDDEN)
def test_modules_and_subpackages_have_no_import_cycle(package):
    graph: dict[str, set[str]] = {}
    for path in (ROOT / package).rglob("*.py"):
        part = path.relative_to(ROOT / package).parts[0].removesuffix(".py")
        names = {name.split(".")[1] for name in _imported(path) if name.startswith(f"{package}.")}
        graph.setdefault(part, set()).update(names - {part})
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError with the cycle


def test_modules_import_one_way():
    for module, path in FILES:
        imported = _own(path)
        assert all(LEVEL[name] <= LEVEL[module] for name in imported), f"{path} imports {imported}"


def test_only_simulation_uses_the_engine():
    for module, path in FILES:
        if module != "simulation":
            attributes = {node.attr for node in ast.walk(_tree(path)) if isinstance(node, ast.Attribute)}
            assert not {name.split(".")[0] for name in _imported(path)} & ENGINE, path
            assert "client" not in attributes, f"{path} uses PyBullet's client"


def test_learners_import_the_environments_for_a_file_of_episodes_only():
    """In a function."""
    for path in (ROOT / "sb3_extensions").rglob("*.py"):
        imports = [node for node in _tree(path).body if isinstance(node, ast.Import | ast.ImportFrom)]
        assert "bulletarm_gym" not in "".join(map(ast.unparse, imports)), path


def test_importing_the_package_is_light():
    heavy = ["pybullet", "numba", "torch", "stable_baselines3", "h5py", "matplotlib"]
    code = f"import sys, bulletarm_gym; print(sorted(set({heavy}) & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
