"""``enjoy`` and ``record`` with models that ``save()`` wrote."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import sb3_contrib
import stable_baselines3 as sb3

from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd import SACfD
from sb3_extensions.spatial_dqn import ADET, DQfD, SDQfD
from sb3_extensions.tqcfd import TQCfD
from zoo_configs.agents import algorithm_of
from zoo_configs.cli import main

Refuse = Callable[..., str]
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
CHANNELS = {"channels": [4, 8, 8, 8, 8]}
CONTINUOUS = {
    **{"a2c": sb3.A2C, "ddpg": sb3.DDPG, "ppo": sb3.PPO, "sac": sb3.SAC, "td3": sb3.TD3},
    **{
        "ars": sb3_contrib.ARS,
        "crossq": sb3_contrib.CrossQ,
        "tqc": sb3_contrib.TQC,
        "trpo": sb3_contrib.TRPO,
    },
}
DISCRETE = {"dqn": sb3.DQN, "qrdqn": sb3_contrib.QRDQN}
CLOSED_LOOP = {"sacfd": SACfD, "tqcfd": TQCfD, "ferm": FERM}
OPEN_LOOP = {"adet": ADET, "dqfd": DQfD, "sdqfd": SDQfD}


@pytest.mark.parametrize("name", [*CONTINUOUS, *DISCRETE])
def test_stock_algorithms_are_recognized(name: str, tmp_path: Path) -> None:
    env_id = "CartPole-v1" if name in DISCRETE else "Pendulum-v1"
    model: Any = {**CONTINUOUS, **DISCRETE}[name]
    model("MlpPolicy", env_id).save(tmp_path / "model")
    assert algorithm_of(tmp_path / "model.zip") in {name, "td3" if name == "ddpg" else name}
    assert main(["enjoy", str(tmp_path / "model.zip"), "--env", env_id, "-n", "1", "--device", "cpu"]) == 0


def test_a_recurrent_policy_is_recognized(tmp_path: Path) -> None:
    sb3_contrib.RecurrentPPO("MlpLstmPolicy", "Pendulum-v1").save(tmp_path / "model")
    assert algorithm_of(tmp_path / "model.zip") == "ppo_lstm"


@pytest.mark.parametrize("name", CLOSED_LOOP)
def test_our_algorithms_are_recognized(name: str, toy_id: str, tmp_path: Path) -> None:
    more = {"augmentation": "drq"} if name == "ferm" else {}
    extractor = {**CHANNELS, "features_dim": 6} if name == "ferm" else CHANNELS
    model: Any = CLOSED_LOOP[name]
    env = gym.make(toy_id, obs_size=48)
    model("MultiInputPolicy", env, policy_kwargs={"features_extractor_kwargs": extractor}, **more).save(
        tmp_path / "model"
    )
    words = [str(tmp_path / "model.zip"), "--env", toy_id, "--env-kwargs", "obs_size:48", "--device", "cpu"]
    assert algorithm_of(tmp_path / "model.zip") == name
    assert main(["enjoy", *words, "-n", "1"]) == 0
    assert main(["record", *words, "-n", "1", "-o", str(tmp_path / "video.gif")]) == 0


@pytest.mark.parametrize("name", OPEN_LOOP)
def test_open_loop_algorithms_are_recognized(name: str, tmp_path: Path) -> None:
    """They differ in their losses only, so that any of them can load and act."""
    model: Any = OPEN_LOOP[name]
    model("FCNPolicy", gym.make(STACKING, obs_size=32)).save(tmp_path / "model")
    assert algorithm_of(tmp_path / "model.zip") in OPEN_LOOP


def test_a_model_of_a_run_needs_no_env(run_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["enjoy", str(run_folder / "best_model.zip"), "-n", "1", "--device", "cpu"]) == 0
    assert "success_rate=" in capsys.readouterr().out


def test_the_file_decides_between_algorithms_of_one_policy(tmp_path: Path, refuse: Refuse) -> None:
    sb3.SAC("MlpPolicy", "Pendulum-v1").save(tmp_path / "model")
    words = ["enjoy", str(tmp_path / "model.zip"), "--env", "Pendulum-v1", "-n", "1", "--device", "cpu"]
    assert main([*words, "--algo", "sac"]) == 0
    assert "'sacc'" in refuse(*words, "--algo", "sacc")


def test_a_file_of_something_else_is_refused(tmp_path: Path, refuse: Refuse) -> None:
    (tmp_path / "model.zip").write_text("x")
    assert "model.zip" in refuse("enjoy", str(tmp_path / "model.zip"), "--env", "Pendulum-v1")
