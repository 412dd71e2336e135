"""The built wheel is complete, and each extra installs what its part of the package imports."""

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
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("bulletarm_gym", "sb3_extensions", "zoo_configs")
METADATA = ("pyproject.toml", "README.md", "LICENSE")
MAX_BASE_PACKAGES = 25
"""Packages that somebody who only wants the environments should have to install at most."""
IMPORT_ALL_AND_RUN_TWO_IDS = """
import importlib, pkgutil, gymnasium, bulletarm_gym
for module in pkgutil.walk_packages(bulletarm_gym.__path__, "bulletarm_gym."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
for name in ("CloseLoopBlockPicking", "CloseLoopDrawerOpening"):
    env = gymnasium.make(f"BulletArm/{name}-v0", obs_size=32)
    observation, info = env.reset(seed=0)
    observation, *_ = env.step(env.unwrapped.expert_action())
    assert observation in env.observation_space
    env.close()
print(bulletarm_gym.__file__)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build the wheel from a copy, so that nothing is left in the checkout."""
    source, output = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in METADATA:
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", output, source]
    subprocess.run(command, check=True, capture_output=True)
    (built,) = output.glob("*.whl")
    return built


def test_wheel_holds_the_files_of_the_packages_and_nothing_else(wheel):
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
    roots = {name.split("/")[0] for name in held}
    assert roots - set(PACKAGES) == {root for root in roots if root.endswith(".dist-info")}


@pytest.fixture(scope="module")
def unpacked(wheel, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unpacked")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


@pytest.fixture(scope="module")
def run(unpacked, tmp_path_factory):
    """Runs Python with the unpacked wheel and what an extra of it requires, and with no other package."""
    (info,) = unpacked.glob("*.dist-info")

    def run(extra, *words):
        links = tmp_path_factory.mktemp("links")
        for dependency in required(metadata.Distribution.at(info).requires or [], extra):
            distribution = metadata.distribution(dependency)
            for top in {file.parts[0] for file in distribution.files or []} - {"..", "__pycache__"}:
                if not (links / top).exists():
                    (links / top).symlink_to(str(distribution.locate_file(top)))
        path = f"{unpacked}{os.pathsep}{links}"
        variables = {**os.environ, "PYTHONPATH": path, "NUMBA_DISABLE_JIT": "1"}  # compiling takes a minute
        child = [sys.executable, "-S", *words]  # -S: without the packages of this interpreter
        return subprocess.run(child, cwd=links, env=variables, capture_output=True, text=True)

    return run


def required(requirements, extra):
    """Return the names of the installed distributions that requirements need."""
    found: dict[str, set[str]] = {}
    waiting = [(requirements, {extra})]
    while waiting:
        lines, extras = waiting.pop()
        for requirement in map(Requirement, lines):
            marker, name = requirement.marker, canonicalize_name(requirement.name)
            applies = marker is None or any(marker.evaluate({"extra": item}) for item in extras | {""})
            if applies and (name not in found or requirement.extras - found[name]):
                found[name] = found.get(name, set()) | requirement.extras
                waiting.append((metadata.requires(name) or [], found[name]))
    return set(found) - {"bulletarm-gym"}


def test_environments_run_with_the_base_alone(run, unpacked):
    (info,) = unpacked.glob("*.dist-info")
    packages = required(metadata.Distribution.at(info).requires or [], "")
    assert len(packages) <= MAX_BASE_PACKAGES and "torch" not in packages
    ran = run("", "-c", IMPORT_ALL_AND_RUN_TWO_IDS)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == str(unpacked / "bulletarm_gym" / "__init__.py")


@pytest.mark.parametrize("extra", ["", "sb3"])
def test_what_is_not_installed_names_its_extra(run, extra):
    learners = run(extra, "-c", "import sb3_extensions.sacfd.sacfd")
    assert (learners.returncode == 0) == (extra == "sb3"), learners.stderr
    assert extra or "bulletarm-gym[sb3]" in learners.stderr.splitlines()[-1]
    command = run(extra, "-m", "zoo_configs.cli", "list", "--baselines")
    [line] = command.stderr.splitlines()
    assert command.returncode == 2 and "bulletarm-gym[zoo]" in line


def test_command_line_runs_a_published_agent_with_its_extra_alone(run, unpacked):
    ran = run("zoo", "-m", "zoo_configs.cli", "enjoy", "--published", "CloseLoopBlockReaching", "-n", "1")
    assert ran.returncode == 0, ran.stderr
    assert str(unpacked) in ran.stdout  # that agent, not the checkout's
    assert ran.stdout.strip().endswith("success_rate=1.00 episodes=1")


def test_tested_versions_take_every_python_3_11():
    """A version that asks for a later patch than a distribution's (Debian 12: 3.11.2) breaks `make test`."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    names = {Requirement(line).name.lower() for line in lines if line and not line.startswith("#")}
    known = {distribution.name.lower(): distribution.metadata for distribution in metadata.distributions()}
    assert len(names & known.keys()) > len(names) / 2
    for name in names & known.keys():
        python = known[name].json.get("requires_python")
        assert "3.11.0" in SpecifierSet(str(python or "")), name


def test_lowest_versions_are_those_of_the_ranges(unpacked):
    lines = (ROOT / "tests" / "lowest_versions.txt").read_text().splitlines()
    lowest = {pin.name: pin.specifier for pin in map(Requirement, lines[1:])}
    (info,) = unpacked.glob("*.dist-info")
    requirements = [Requirement(line) for line in metadata.Distribution.at(info).requires or []]
    used = [r for r in requirements if str(r.marker) in ("None", 'extra == "sb3"', 'extra == "zoo"')]
    ranges = {r.name: r.specifier for r in used if not r.extras and r.name != "torch"}
    assert lowest.keys() == ranges.keys()
    for name, specifier in ranges.items():
        [bound] = [part.version for part in specifier if part.operator == ">="]
        [pin] = lowest[name]
        assert pin.version in specifier and pin.version.startswith(bound), name
