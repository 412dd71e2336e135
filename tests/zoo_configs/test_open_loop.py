"""Baselines of the open-loop benchmarks: the paper's numbers, and the command line for real."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch as th
import yaml

from bulletarm_gym.benchmarks import BENCHMARKS
from zoo_configs.cli import main
from zoo_configs.drawing.video import PANEL_SIZE
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import resolve
from zoo_configs.experiments.rules import family_of
from zoo_configs.training.trainer import Trainer

register_environments()
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
FAMILY = family_of(STACKING)
LEARNERS = ("dqn", "adet", "dqfd", "sdqfd")
FLAT = [(name, row) for name in ("open_loop_2d", "open_loop_3d") for row in BENCHMARKS[name].environments]
SE3 = [("open_loop_6d", row) for row in BENCHMARKS["open_loop_6d"].environments]

TINY = ["--seed", "0", "--device", "cpu", "--num-threads", "1", "--no-progress", "-n", "6"]
TINY += ["--eval-freq", "3", "--eval-episodes", "1", "--save-freq", "3"]
TINY_LEARNER = [
    "-params",
    "expert_episodes:1",
    "pretrain_steps:2",
    "batch_size:4",
    "buffer_size:50",
    "n_envs:1",
]


def test_there_is_a_baseline_for_every_learner_and_network() -> None:
    flat = ("fcn", "equi_fcn", "rot_fcn", "cnn_asr", "equi_asr")
    expected = {f"{a}_{b}" for a in LEARNERS for b in (*flat, "cnn_asr_6d", "equi_deictic_asr")}
    assert FAMILY.baselines.keys() == expected


@pytest.mark.parametrize(
    ("learner", "own"),
    [
        ("dqn", {}),
        ("adet", {"imitation_weight": 0.01}),
        ("dqfd", {"imitation_weight": 0.1, "margin": 0.1}),
        ("sdqfd", {"imitation_weight": 0.1, "margin": 0.1}),
    ],
)
def test_the_paper_preset_is_the_papers(learner: str, own: dict[str, float]) -> None:
    """Appendix "Benchmark Details", Open-Loop Benchmark; the schedule of updates as its authors' code."""
    experiment = resolve(f"{learner}_equi_asr", "paper", STACKING)
    expected = {
        "learning_rate": 1e-4,
        "gamma": 0.95,
        "batch_size": 16,
        "buffer_size": 100_000,
        "n_envs": 5,
        "expert_episodes": 200,
        "exploration_initial_eps": 0.0,
        "exploration_final_eps": 0.0,
        "train_freq": 1,
        "gradient_steps": 1,
        "target_update_interval": 100,
        "replay_buffer_kwargs": {"sampler": {"shares": {"expert_fraction": 0.5}}},
        **own,
    }
    assert {key: experiment.hyperparams[key] for key in expected} == expected
    assert "pretrain_steps" not in experiment.hyperparams
    assert experiment.hyperparams["policy_kwargs"]["optimizer_kwargs"] == {"weight_decay": 1e-5}
    assert experiment.hyperparams["env_kwargs"]["obs_size"] == 128
    assert (experiment.flags["eval_freq"], experiment.flags["eval_episodes"]) == (5 * 500, 100)


def test_rot_fcn_sees_90_pixels() -> None:
    assert resolve("sdqfd_rot_fcn", "paper", STACKING).hyperparams["env_kwargs"]["obs_size"] == 90


@pytest.mark.parametrize(("benchmark", "row"), FLAT + SE3)
def test_the_benchmark_says_what_a_task_is_like(benchmark: str, row: Any) -> None:
    network = "equi_deictic_asr" if benchmark == "open_loop_6d" else "equi_fcn"
    experiment = resolve(f"sdqfd_{network}", "paper", row.env_id, benchmark=benchmark)
    sequence = {"open_loop_2d": "pxy", "open_loop_3d": "pxyr", "open_loop_6d": "pxyzrrr"}[benchmark]
    assert experiment.benchmark == benchmark
    assert experiment.hyperparams["env_kwargs"]["action_sequence"] == sequence
    assert experiment.hyperparams["policy_kwargs"]["action_sequence"] == sequence
    assert experiment.hyperparams["env_kwargs"]["random_orientation"] is (benchmark != "open_loop_2d")
    on_bumps = "Bump" in row.env_id
    assert experiment.hyperparams["env_kwargs"]["in_hand_size"] == (40 if on_bumps else 24)
    episodes = 500 if "Covid" in row.env_id else 1000 if "Ramp" in row.env_id else 200
    assert experiment.hyperparams["expert_episodes"] == episodes


def test_a_task_of_several_benchmarks_is_3d_unless_one_is_named() -> None:
    assert resolve("sdqfd_fcn", "cpu", STACKING).benchmark == "open_loop_3d"
    assert resolve("sdqfd_fcn", "cpu", STACKING, benchmark="open_loop_2d").benchmark == "open_loop_2d"


@pytest.mark.parametrize(
    ("network", "benchmark", "message"),
    [
        ("equi_asr", "open_loop_2d", "'equi_asr' does not fit .*'open_loop_2d'"),
        ("equi_deictic_asr", None, "'equi_deictic_asr' does not fit"),
        (
            "equi_asr",
            "open_loop_6d",
            "got 'open_loop_6d'",
        ),
        ("equi_asr", "open_loop_3", "unknown benchmark 'open_loop_3', did you mean 'open_loop_3d'"),
    ],
)
def test_what_does_not_fit_is_refused(network: str, benchmark: str | None, message: str) -> None:
    with pytest.raises(CommandError, match=message):
        resolve(f"sdqfd_{network}", "cpu", STACKING, benchmark=benchmark)


RAMP, BUMP = "BulletArm/OpenLoopRampBlockStacking-v0", "BulletArm/OpenLoopBumpHouseBuilding4-v0"
NETWORKS = [
    ("fcn", STACKING, "open_loop_3d"),
    ("fcn", STACKING, "open_loop_2d"),
    ("equi_fcn", STACKING, "open_loop_3d"),
    ("equi_fcn", STACKING, "open_loop_2d"),
    ("rot_fcn", STACKING, "open_loop_3d"),
    ("cnn_asr", STACKING, "open_loop_3d"),
    ("equi_asr", STACKING, "open_loop_3d"),
    ("cnn_asr_6d", RAMP, "open_loop_6d"),
    ("cnn_asr_6d", BUMP, "open_loop_6d"),
    ("equi_deictic_asr", RAMP, "open_loop_6d"),
    ("equi_deictic_asr", BUMP, "open_loop_6d"),
]


@pytest.mark.parametrize("preset", ["cpu", "paper"])
@pytest.mark.parametrize(("network", "env_id", "benchmark"), NETWORKS)
def test_every_network_is_built_and_expects_nothing(
    network: str, env_id: str, benchmark: str, preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """True values lie in [0, 1]; the paper's networks, which take a GPU, are built and not run."""
    built: list[Any] = []

    def learn(trainer: Any) -> bool:
        built.append((trainer.model, trainer.model.get_env().reset()))
        return True

    monkeypatch.setattr(Trainer, "learn", learn)
    arguments = ["train", "--baseline", f"sdqfd_{network}", "--preset", preset, "--env", env_id]
    arguments += ["--benchmark", benchmark, "--seed", "0", "-f", str(tmp_path), "--device", "cpu"]
    arguments += ["--vec-env", "dummy", "--no-progress", "--eval-freq", "-1"]
    assert main([*arguments, "-params", "n_envs:1"]) == 0
    [(model, first)] = built
    assert model.policy.action_sequence == BENCHMARKS[benchmark].action_sequence
    if preset == "paper":
        return
    observations, _ = model.policy.obs_to_tensor(first)
    indices, _ = model.q_net.greedy(observations)
    with th.no_grad():
        values = model.q_net.values(observations, indices)
    assert all(level.isfinite().all() and level.abs().max() <= 1 for level in values)


def train(folder: Path, baseline: str, env_id: str, *more: str) -> Path:
    """Train for a few steps; returns the run folder."""
    arguments = ["train", "--baseline", baseline, "--preset", "cpu", "--env", env_id, "-f", str(folder)]
    assert main([*arguments, *TINY, *TINY_LEARNER, *more]) == 0
    [run] = folder.glob("*/BulletArm-*_1")
    return run


@pytest.mark.parametrize("learner", LEARNERS)
def test_each_learner_trains(learner: str, tmp_path: Path) -> None:
    run = train(tmp_path, f"{learner}_cnn_asr", STACKING, "--env-kwargs", "num_objects:2")
    with np.load(run / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [0, 3, 6]
    assert yaml.safe_load((run / "hyperparams.yml").read_text())["run"]["baseline"] == f"{learner}_cnn_asr"


def test_films_show_what_the_agent_thinks(tmp_path: Path) -> None:
    train(tmp_path, "sdqfd_equi_asr", STACKING, "--env-kwargs", "num_objects:2")
    chosen = ["--baseline", "sdqfd_equi_asr", "--env", STACKING, "-f", str(tmp_path), "--load-last"]
    assert main(["enjoy", *chosen, "-n", "1"]) == 0
    film = tmp_path / "film.gif"
    assert main(["record", *chosen, "-n", "1", "-o", str(film)]) == 0
    frames = iio.imread(film)
    # Scene, heightmap, in-hand image, values
    assert frames.shape[2] == 4 * PANEL_SIZE
    assert len(np.unique(frames[0][:PANEL_SIZE, -PANEL_SIZE:].reshape(-1, 3), axis=0)) > 2


@pytest.mark.parametrize("network", ["cnn_asr_6d", "equi_deictic_asr"])
def test_6d_trains(network: str, tmp_path: Path) -> None:
    env_id = "BulletArm/OpenLoopRampBlockStacking-v0"
    run = train(tmp_path, f"sdqfd_{network}", env_id, "--env-kwargs", "num_objects:2")
    content = yaml.safe_load((run / "hyperparams.yml").read_text())
    assert content[env_id]["env_kwargs"]["action_sequence"] == "pxyzrrr"


def test_2d_trains(tmp_path: Path) -> None:
    more = ("--benchmark", "open_loop_2d", "--env-kwargs", "num_objects:2")
    run = train(tmp_path, "sdqfd_equi_fcn", STACKING, *more)
    content = yaml.safe_load((run / "hyperparams.yml").read_text())
    assert content[STACKING]["env_kwargs"]["random_orientation"] is False
