"""The examples, the package for LeRobot and the notebooks of the tutorials run, for some steps."""

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

import bulletarm_gym

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"
PLUGIN = EXAMPLES / "lerobot_plugin"
NOTEBOOKS = sorted((EXAMPLES / "tutorials").glob("*.ipynb"))


@pytest.mark.parametrize(
    "command",
    [
        "train_ppo.py --steps 32 --rollout 16 --equivariant",
        "train_multi_task.py --steps 6 --pretrain 2 --expert-episodes 3",
        "train_crossq.py --steps 104",  # after 100 random steps
        "train_curriculum.py --steps 110",
        "her_reaching.py --steps 304",  # after 300 random steps
        "train_asymmetric.py --steps 3 --expert-episodes 1",
    ],
)
def test_training_examples(command, monkeypatch, capsys):
    script, *arguments = command.split()
    monkeypatch.setattr(sys, "argv", [script, *arguments, "--episodes", "1"])
    runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    rates = re.findall(r"success rate [01]\.\d\d$", capsys.readouterr().out, re.MULTILINE)
    assert len(rates) >= (3 if "multi_task" in script else 1)


def test_small_arm(capsys):
    runpy.run_path(str(EXAMPLES / "small_arm.py"), run_name="__main__")
    assert re.findall(r"rate (\d\.\d\d)", capsys.readouterr().out) == ["1.00"] * 4


@pytest.mark.parametrize(
    "command",
    [
        "CloseLoopDoorOpening-v0 --gym-packages door",
        "CloseLoopBlockPicking-v0 --gym-packages step_surface --env-kwargs surface:step",
        "CloseLoopBlockPicking-v0 --gym-packages six_dof --env-kwargs control:six_dof",
    ],
)
def test_examples_of_components_pass_the_check(command):
    env_id, *flags = command.split()
    check = [sys.executable, "-m", "bulletarm_gym.check", f"BulletArm/{env_id}", "-n", "1", *flags]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(check, cwd=EXAMPLES, env=env, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


EVALUATE = """--env.type=bulletarm --env.discover_packages_path=lerobot_env_bulletarm --env.object_poses=true
--env.task=CloseLoopBlockReaching-v0 --env.cameras={"front":{"size":48}} --env.env_kwargs={"obs_size":32}
--policy.type=scripted --policy.discover_packages_path=lerobot_scripted --policy.device=cpu
--eval.n_episodes=2 --eval.batch_size=2 --output_dir=results""".split()


def test_evaluation_of_a_scripted_policy(tmp_path):
    pytest.importorskip("lerobot")
    paths = os.pathsep.join(map(str, (ROOT, PLUGIN, ROOT / "tests")))
    result = subprocess.run(
        [sys.executable, "-m", "lerobot.scripts.lerobot_eval", *EVALUATE],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": paths, "HF_HUB_OFFLINE": "1"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert re.search(r"'pc_success': 100.0, 'n_episodes': 2", result.stdout), result.stdout
    assert len(list(tmp_path.glob("results/videos/*/*.mp4"))) == 2


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [*bulletarm_gym.ENV_IDS, "door:BulletArm/CloseLoopDoorOpening-v0"])
def test_observations_have_the_configured_features(env_id, monkeypatch):
    pytest.importorskip("lerobot")
    monkeypatch.syspath_prepend(PLUGIN)
    monkeypatch.syspath_prepend(EXAMPLES)
    import lerobot_env_bulletarm as plugin
    from lerobot.envs.factory import make_env
    from lerobot.envs.utils import add_envs_task, env_to_policy_features, preprocess_observation

    task = env_id.replace("BulletArm/", "")
    config = plugin.BulletArmEnv(task=task, cameras={"front": {"size": 32}}, object_poses=True)
    (envs,) = make_env(config, n_envs=1)["bulletarm"].values()
    observation, _ = envs.reset(seed=[3], options={"lerobot_new_rollout": True})  # as LeRobot 0.6.1
    assert observation in envs.observation_space
    found: Any = add_envs_task(envs, preprocess_observation(observation))
    features = env_to_policy_features(config)
    assert features.pop("action").shape == envs.single_action_space.shape
    assert {name: tuple(found[name].shape[1:]) for name in features} == {
        name: tuple(feature.shape) for name, feature in features.items()
    }
    assert found["task"] == [envs.envs[0].unwrapped.task_description]
    envs.step(np.stack(envs.call("expert_action")))
    envs.close()


MAX_LINES = 15
"""Maximum number of lines of a code cell."""
KERNEL = "tutorial"
RUNS = [
    ("1_environment_and_expert", "", r"'is_success': True.*\nequal after set_state\(\): True"),
    ("2_train", "STEPS = 4", r"success rate [01]\.\d\d in 4 episodes\n(.*\n)*.*success_rate="),
    ("3_task", "EPISODES = 5", r"passes Gymnasium's check_env\n(.*\n)+5 of 5 attempts"),
    ("4_robot", "", r"(\w+: picked the block in \d+ steps\n){5}"),
    ("5_object_and_sensor", "", r"11\.4 cm long\n(.*\n)+step 0: (.*\n)+lifted an object in \d+ steps"),
    ("6_offline_imitation", "EPISODES = UPDATES = 4", r"success rate [01]\.\d\d in 4 episodes"),
    (
        "7_tune_and_benchmark",
        "STEPS = 4\nTRIALS = 4\nSEEDS = [1]",
        r"reaching: 4 complete\n(.*\n)+.*found: (.*\n)+ +found\.png",
    ),
]
"""Name of each notebook, its shortened constants, and a pattern of its output."""


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Return the name of a Jupyter kernel with this interpreter, independent of the user's settings."""
    folder = tmp_path / "jupyter" / "kernels" / KERNEL
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    spec = {"argv": command, "display_name": KERNEL, "language": "python"}
    (folder / "kernel.json").write_text(json.dumps(spec), encoding="utf-8")
    for variable in ("JUPYTER_PATH", "JUPYTER_DATA_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(variable, str(tmp_path / "jupyter"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)  # bulletarm-zoo
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)
    return KERNEL


@pytest.mark.parametrize(
    ("name", "constants", "pattern"),
    [pytest.param(*run, id=run[0], marks=[pytest.mark.slow] if run is not RUNS[0] else []) for run in RUNS],
)
def test_notebook_runs(name, constants, pattern, kernel, tmp_path):
    """With the constants in place of the cell with the tag "parameters"."""
    notebook = nbformat.read(EXAMPLES / "tutorials" / f"{name}.ipynb", as_version=4)
    for cell in notebook.cells:
        if "parameters" in cell.metadata.get("tags", []):
            cell.source = constants
    (folder := tmp_path / "work").mkdir()
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, kernel_name=kernel, resources=resources, timeout=1200).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "".join(output.text for output in outputs if output.output_type == "stream")
    assert re.search(pattern, text.replace("\r\n", "\n")), text
    assert any("image/png" in output.get("data", {}) for output in outputs)


def test_every_notebook_is_executed_and_described():
    names = [path.stem for path in NOTEBOOKS]
    assert names == [name for name, *_ in RUNS]
    page = (ROOT / "docs" / "tutorials.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\(\.\./examples/tutorials/(\w+)\.ipynb\)", page) == names


def test_notebooks_are_stored_without_outputs():
    for path in NOTEBOOKS:
        content = json.loads(path.read_text(encoding="utf-8"))
        nbformat.validate(content)
        assert content["metadata"]["kernelspec"]["name"] == "python3"
        code = [cell for cell in content["cells"] if cell["cell_type"] == "code"]
        assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code), path
        assert all(len(cell["source"]) <= MAX_LINES for cell in code), path
