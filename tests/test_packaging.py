"""The built wheel is complete: installed away from the checkout, it runs an environment."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

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
    suffixes = {".py", ".typed", ".yml", ".urdf", ".obj"}
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


def test_installed_wheel_runs_an_environment(wheel: Path, tmp_path: Path) -> None:
    target = tmp_path / "installed"
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
    environment = {**os.environ, "PYTHONPATH": str(target)}
    child = [sys.executable, "-c", RUN_AN_ENVIRONMENT, str(target)]
    result = subprocess.run(child, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.stdout.strip() == "ran", result.stderr
