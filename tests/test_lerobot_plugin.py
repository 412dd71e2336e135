"""LeRobot's evaluation runs our environments with the package in examples/lerobot_plugin."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bulletarm_gym

ROOT = Path(__file__).resolve().parent.parent
PLUGIN = ROOT / "examples" / "lerobot_plugin"
EVALUATE = """--env.type=bulletarm --env.discover_packages_path=lerobot_env_bulletarm --env.object_poses=true
--env.task=CloseLoopBlockReaching-v0 --env.cameras={"front":{"size":48}} --env.env_kwargs={"obs_size":32}
--policy.type=scripted --policy.discover_packages_path=lerobot_scripted --policy.device=cpu
--eval.n_episodes=2 --eval.batch_size=2 --output_dir=results""".split()


def test_evaluation_of_a_scripted_policy(tmp_path: Path) -> None:
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
@pytest.mark.parametrize("env_id", bulletarm_gym.ENV_IDS)
def test_observations_have_the_configured_features(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("lerobot")
    monkeypatch.syspath_prepend(PLUGIN)
    import lerobot_env_bulletarm as plugin
    from lerobot.envs.factory import make_env
    from lerobot.envs.utils import add_envs_task, env_to_policy_features, preprocess_observation

    task = env_id.partition("/")[2]
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
