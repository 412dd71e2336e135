"""The built wheel is complete: installed away from the checkout, it runs an environment."""

import os
import shutil
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("bulletarm_gym", "sb3_extensions", "zoo_configs")
METADATA = ("pyproject.toml", "README.md", "LICENSE")

# The first line of the child proves that it runs the installed copy, not the checkout.
RUN_AN_ENVIRONMENT = """
import sys, pathlib, gymnasium, bulletarm_gym, sb3_extensions, zoo_configs
for package in (bulletarm_gym, sb3_extensions, zoo_configs):
    assert pathlib.Path(sys.argv[1]) in pathlib.Path(package.__file__).parents, package.__file__
env = gymnasium.make("BulletArm/CloseLoopBlockPicking-v0")
observation, info = env.reset(seed=0)
for _ in range(3):
    observation, *_ = env.step(env.unwrapped.expert_action())
assert observation in env.observation_space
env.close()
print("ran")
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy, so that nothing is left in the checkout."""
    source, output = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in METADATA:
        shutil.copy(ROOT / name, source)
    command = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(output),
        str(source),
    ]
    subprocess.run(command, check=True, capture_output=True, text=True)
    (built,) = output.glob("*.whl")
    return built


def test_wheel_holds_every_file(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    suffixes = {".py", ".typed", ".yml", ".csv", ".urdf", ".obj", ".zip", ".json", ".md"}
    wanted = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.suffix in suffixes and "__pycache__" not in path.parts
    }
    assert {f"{package}/py.typed" for package in PACKAGES} <= wanted
    assert wanted <= held, sorted(wanted - held)


def test_wheel_holds_nothing_else(wheel: Path) -> None:
    roots = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert roots - set(PACKAGES) == {root for root in roots if root.endswith(".dist-info")}


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel unpacked away from the checkout."""
    target = tmp_path_factory.mktemp("installed")
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--target",
        str(target),
        str(wheel),
    ]
    subprocess.run(install, check=True, capture_output=True)
    return target


def _run(installed: Path, folder: Path, *words: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    child = [sys.executable, *words]
    result = subprocess.run(child, cwd=folder, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_installed_wheel_runs_an_environment(installed: Path, tmp_path: Path) -> None:
    assert _run(installed, tmp_path, "-c", RUN_AN_ENVIRONMENT, str(installed)) == "ran"


def test_installed_wheel_runs_a_published_agent(installed: Path, tmp_path: Path) -> None:
    command = ["-m", "zoo_configs.cli", "enjoy", "--published", "CloseLoopBlockReaching", "-n", "1"]
    printed = _run(installed, tmp_path, *command)
    assert str(installed) in printed  # that agent, not the checkout's
    assert printed.endswith("success_rate=1.00 episodes=1")
    assert not list(tmp_path.iterdir())


def test_tested_versions_take_every_python_3_11() -> None:
    """A version that asks for a later patch than a distribution's (Debian 12: 3.11.2) breaks `make test`."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    names = [Requirement(line).name for line in lines if line and not line.startswith("#")]
    known = {distribution.name.lower(): distribution.metadata for distribution in metadata.distributions()}
    needed = {
        name: known[name.lower()].json.get("requires_python") for name in names if name.lower() in known
    }
    assert len(needed) > len(names) / 2
    assert {
        name for name, python in needed.items() if "3.11.0" not in SpecifierSet(str(python or ""))
    } == set()
