"""The scripts of docs/guides/libraries.md run, with our packages or in a virtual environment."""

import os
import re
import runpy
import subprocess
import sys
import venv
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = ROOT / "examples" / "libraries"
PAGE = ROOT / "docs" / "guides" / "libraries.md"
ENVIRONMENTS = ("numpy", "gymnasium", "pybullet", "numba", "h5py", "pillow", "tqdm", "scipy")
"""Dependencies of the environments; those of the learners conflict with some of the libraries."""
OFFLINE = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}
OPERATORS = """import torch

library = torch.library.Library("torchvision", "DEF")
for name in ("nms", "qnms"):
    library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
"""


class Library(NamedTuple):
    """Missing module if the library is not installed, pattern of the output, and requirements of a script.

    Those in ``bare`` are installed without their dependencies, those in ``unpinned`` in other versions than
    those of constraints.txt.
    """

    module: str
    output: str
    packages: tuple[str, ...] = ()
    bare: tuple[str, ...] = ()
    unpinned: tuple[str, ...] = ()


LIBRARIES = {
    "sb3_sac": Library("stable_baselines3", r"mean reward [01]\.\d"),
    "sb3_ppo_open_loop": Library("stable_baselines3", r"64 steps of Box\(0, 255, \(3, 64, 64\), uint8\)"),
    "contrib_tqc_crossq": Library("sb3_contrib", r"TQC 110 steps\nCrossQ 110 steps"),
    "rl_zoo3_sacfd": Library("rl_zoo3", r"mean returns \[[01]\.\S* +[01]\.\S*\]"),
    "cleanrl_ppo": Library("torch", r"iteration 1: \d+ episodes, mean return [01]\.\d\d"),
    "torchrl_sac": Library("torchrl", r"128 transitions, critic's loss \d", ("torchrl",)),
    "tianshou_sac": Library(
        "tianshou",
        r"128 transitions",
        ("tianshou==2.0.1",),
        unpinned=("filelock", "pandas", "python-discovery", "virtualenv"),
    ),
    "skrl_sac": Library("skrl", r"40 transitions", ("skrl",)),
    "rllib_ppo_sac": Library(
        "tree", r"PPO 128.0 steps\n(.*\n)*SAC 100.0 steps", ("ray[rllib]",), unpinned=("gymnasium",)
    ),
    "minari_dataset": Library(
        "minari",
        r"Move the gripper to a cube\.\n3 episodes, \(\d+, 1, 64, 64\) \(\d+, 5\)\n"
        r"seeds \[\d+, \d+, \d+\]\n(.*\n)*\d+ steps recorded",
        ("minari[hdf5,create]",),
    ),
    "torchrl_minari": Library(
        "torchrl",
        r"(\d+) transitions, rewards \[0.0, .*1.0\]\n(.*\n)*batch \(32, 1, 64, 64\)",
        ("torchrl", "minari[hdf5,create]"),
    ),
    "d3rlpy_offline": Library("d3rlpy", r"10 episodes; mean return [01]\.\d", ("d3rlpy==2.8.0",)),
    "lerobot_dataset": Library(
        "lerobot",
        r"3 episodes, kuka .*\n(.*\n)*observation.heightmap 64 64 1\n",
        tuple("accelerate<2 av<16 datasets<5 huggingface-hub<0.36 jsonlines numpy<2.4 termcolor".split()),
        bare=("lerobot==0.4.4", "torchvision==0.28.0"),  # that pin an older PyTorch
        unpinned=("huggingface_hub", "filelock", "fsspec", "numpy", "packaging"),
    ),
    "imitation_bc": Library(
        "imitation",
        r"action at the start \[.*\]",
        ("stable-baselines3", "datasets", "huggingface_sb3", "rich", "scikit-learn"),
        bare=("imitation==1.0.1",),
    ),
}
OF_THEIR_OWN = [script for script, library in LIBRARIES.items() if library.packages]


def test_page_includes_every_script():
    """Each from its third line, behind the docstring."""
    page = PAGE.read_text(encoding="utf-8")
    assert {path.stem for path in SCRIPTS.glob("*.py")} == LIBRARIES.keys()
    for script in LIBRARIES:
        assert f'--8<-- "examples/libraries/{script}.py:3"' in page, f"{PAGE} does not include {script}.py"
        docstring, blank, *_ = (SCRIPTS / f"{script}.py").read_text(encoding="utf-8").splitlines()
        assert docstring.startswith('"""') and docstring.endswith('"""') and not blank


@pytest.mark.parametrize("script", LIBRARIES)
def test_script_with_our_packages(script, tmp_path, capsys, monkeypatch):
    pytest.importorskip(LIBRARIES[script].module)
    if script in OF_THEIR_OWN:
        _run(script, sys.executable, tmp_path)
    else:  # in this process, which has imported torch
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [script])
        runpy.run_path(str(SCRIPTS / f"{script}.py"), run_name="__main__")
        assert re.search(LIBRARIES[script].output, capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize("script", OF_THEIR_OWN)
def test_script_in_an_environment_of_its_own(script, tmp_path):
    library = LIBRARIES[script]
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    constraints = tmp_path / "constraints.txt"
    kept = [pin for pin in pins if pin.partition("==")[0] not in library.unpinned]
    constraints.write_text("\n".join(kept), encoding="utf-8")
    pip = [python, "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "-c", constraints, "torch", *ENVIRONMENTS, *library.packages], check=True)
    subprocess.run([*pip, "--no-deps", *library.bare, ROOT], check=True)
    if any(name.startswith("torchvision") for name in library.bare):
        _declare_operators(python)
    _run(script, str(python), tmp_path)


def _declare_operators(python):
    """Declare the operators that PyPI's torchvision, built for CUDA, lacks with PyTorch for CPUs."""
    if subprocess.run([python, "-c", "import torchvision"], capture_output=True).returncode:
        where = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
        folder = subprocess.run(where, check=True, capture_output=True, text=True).stdout.strip()
        (Path(folder) / "sitecustomize.py").write_text(OPERATORS, encoding="utf-8")


def _run(script, python, folder):
    result = subprocess.run(
        [python, SCRIPTS / f"{script}.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MINARI_DATASETS_PATH": str(folder), **OFFLINE},
        capture_output=True,
        text=True,
    )
    print(result.stdout)  # the output on the page; pytest -rP shows it
    assert result.returncode == 0, result.stderr
    assert re.search(LIBRARIES[script].output, result.stdout), result.stdout
