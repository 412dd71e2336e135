"""Going on: with an interrupted run, from a model, past what is damaged."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_extensions.common import checkpoint
from sb3_extensions.replay.buffer import ExpertReplayBuffer
from sb3_extensions.sacfd import SACfD
from zoo_configs.cli import main
from zoo_configs.training.evaluation import PeriodicEvaluation

RUN_NAME = "BulletArm-CloseLoopToy-v0_1"
Train = Callable[..., int]
Refuse = Callable[..., str]


def _same_run(first: Path, second: Path) -> bool:
    """Whether two runs were evaluated alike and ended in the same model."""
    with np.load(first / "evaluations.npz") as left, np.load(second / "evaluations.npz") as right:
        if any(not np.array_equal(left[key], right[key]) for key in ("timesteps", "results", "successes")):
            return False
    name = "BulletArm-CloseLoopToy-v0.zip"
    models = [load_from_zip_file(folder / name, device="cpu")[1]["policy"] for folder in (first, second)]
    return all(bool((models[0][key] == models[1][key]).all()) for key in models[0])


def test_an_extended_run_equals_a_longer_one(train_tiny: Train, tmp_path: Path) -> None:
    """At a constant learning rate; one that falls with the share of the run that is left knows its end."""
    extended, longer = (tmp_path / name / "sacfd" / "BulletArm-CloseLoopToy-v0_1" for name in ("a", "b"))
    constant = "learning_rate:0.001"  # one more of the -params
    assert train_tiny(tmp_path / "a", constant) == 0
    assert main(["train", "--resume", str(extended), "-n", "18", "--no-progress"]) == 0
    assert train_tiny(tmp_path / "b", constant, "-n", "18") == 0
    assert _same_run(extended, longer)
    assert len(list(extended.parent.iterdir())) == 1


def test_an_interrupted_run_goes_on(
    train_tiny: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    interrupted, whole = (tmp_path / name / "sacfd" / "BulletArm-CloseLoopToy-v0_1" for name in ("a", "b"))

    def press_ctrl_c(callback: PeriodicEvaluation, on_step: Any = PeriodicEvaluation._on_step) -> bool:
        if callback.num_timesteps == 10:  # four steps after the only checkpoint
            raise KeyboardInterrupt
        return bool(on_step(callback))

    with monkeypatch.context() as patch:
        patch.setattr(PeriodicEvaluation, "_on_step", press_ctrl_c)
        assert train_tiny(tmp_path / "a") == 130
    assert f"bulletarm-zoo train --resume {interrupted}" in capsys.readouterr().out
    assert (interrupted / "BulletArm-CloseLoopToy-v0.zip").is_file()
    assert main(["train", "--resume", str(interrupted), "--no-progress"]) == 0
    assert train_tiny(tmp_path / "b") == 0
    assert _same_run(interrupted, whole)


def test_a_damaged_checkpoint_gives_way_to_the_one_before(
    train_tiny: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str], refuse: Refuse
) -> None:
    damaged, whole = (tmp_path / name / "sacfd" / "BulletArm-CloseLoopToy-v0_1" for name in ("a", "b"))
    constant = "learning_rate:0.001"  # one more of the -params
    assert train_tiny(tmp_path / "a", constant) == 0
    older, newest = sorted((damaged / "checkpoints").iterdir())
    (newest / "model.zip").write_bytes(b"")
    capsys.readouterr()
    assert main(["train", "--resume", str(damaged), "-n", "18", "--no-progress"]) == 0
    [line] = capsys.readouterr().err.splitlines()
    assert f"{newest} is damaged: model.zip" in line and f"Resuming from {older}" in line
    assert train_tiny(tmp_path / "b", constant, "-n", "18") == 0
    assert _same_run(damaged, whole)
    for model in damaged.glob("checkpoints/*/model.zip"):
        model.write_bytes(b"")
    assert "damaged: model.zip" in refuse("train", "--resume", str(damaged), "-n", "24")


def test_what_the_run_was_begun_with_stays(run_folder: Path, refuse: Refuse) -> None:
    flags = ["--seed", "0", "--baseline", "sac", "--preset", "cpu", "--env", "TOY", "--benchmark", "x"]
    flags += ["--env-kwargs", "obs_size:64", "-params", "gamma:0.5", "-i", "model.zip", "-f", "elsewhere"]
    for flag, value in zip(flags[::2], flags[1::2], strict=True):
        line = refuse("train", "--resume", str(run_folder), flag, value)
        assert line.endswith({"-i": "--trained-agent", "-f": "--log-folder"}.get(flag, flag))


def test_a_resumed_run_keeps_its_number_of_evaluation_episodes(run_folder: Path, refuse: Refuse) -> None:
    line = refuse("train", "--resume", str(run_folder), "-n", "18", "--eval-episodes", "3")
    assert "eval_episodes must be 2" in line


def test_a_finished_run_needs_more_steps(run_folder: Path, refuse: Refuse) -> None:
    assert "12 of 12 steps" in refuse("train", "--resume", str(run_folder))
    assert "device, got 'cuda:99'" in refuse(
        "train", "--resume", str(run_folder), "-n", "18", "--device", "cuda:99"
    )


def test_a_full_disk_is_told_and_leaves_no_half_checkpoint(
    train_tiny: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fill(path: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoint, "_sync", fill)
    assert train_tiny(tmp_path / "a") == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "No space left on device" in line
    [run] = (tmp_path / "a" / "sacfd").iterdir()
    assert (run / "best_model.zip").is_file()  # of the first evaluation
    assert not list((run / "checkpoints").iterdir())
    assert train_tiny(tmp_path / "b", "--eval-freq", "0") == 2
    assert not (tmp_path / "b").exists()


def test_a_run_without_a_model_is_passed_over(
    trained: Path, toy_id: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], refuse: Refuse
) -> None:
    """What a killed run leaves before its first evaluation, and a folder whose description is garbage."""
    shutil.copytree(trained, tmp_path / "logs")
    runs = tmp_path / "logs" / "sacfd"
    killed, garbled = runs / "BulletArm-CloseLoopToy-v0_2", runs / "BulletArm-CloseLoopToy-v0_3"
    for folder, text in (killed, (runs / RUN_NAME / "hyperparams.yml").read_text()), (garbled, "run: ["):
        folder.mkdir()
        (folder / "hyperparams.yml").write_text(text)
    named = ["--baseline", "equi_sacfd", "--env", toy_id, "-f", str(tmp_path / "logs")]
    assert main(["enjoy", *named, "-n", "1", "--device", "cpu"]) == 0
    printed = capsys.readouterr()
    assert f"{RUN_NAME}/best_model.zip" in printed.out
    [line] = printed.err.splitlines()
    assert line.startswith("skipped: ") and str(garbled) in line
    shutil.rmtree(garbled)
    assert "has no model yet" in refuse("enjoy", str(killed))


@pytest.mark.parametrize("command", ["enjoy", "record"])
@pytest.mark.parametrize("damage", ["cut", "empty", "foreign"])
def test_a_damaged_model_is_told(
    command: str, damage: str, run_folder: Path, tmp_path: Path, refuse: Refuse
) -> None:
    folder = tmp_path / RUN_NAME
    shutil.copytree(run_folder, folder)
    content = (folder / "best_model.zip").read_bytes()
    damaged = {"cut": content[: len(content) // 2], "empty": b"", "foreign": b"no archive"}
    (folder / "best_model.zip").write_bytes(damaged[damage])
    assert "best_model.zip is damaged" in refuse(command, str(folder))


def test_training_goes_on_from_a_model(train_tiny: Train, run_folder: Path, tmp_path: Path) -> None:
    """Of the same policy, with other hyperparameters: the discount, what is drawn from the buffer."""
    model = str(run_folder / "best_model.zip")
    more = [
        "gamma:0.9",
        "n_steps:2",
        "replay_buffer_kwargs:{'sampler':{'shares':{'expert_fraction':0.25}}}",
        "n_envs:2",
    ]
    assert train_tiny(tmp_path, *more, "-i", model) == 0
    trained = SACfD.load(tmp_path / "sacfd" / RUN_NAME / "best_model.zip", device="cpu")
    assert (trained.gamma, trained.n_steps, trained.n_pretrained) == (0.9, 2, 2)
    assert trained.replay_buffer_kwargs["sampler"]["shares"]["expert_fraction"] == 0.25


def test_a_model_with_an_augmentation_and_a_buffer_of_its_own_goes_on(
    train_tiny: Train, tmp_path: Path
) -> None:
    names = ["--baseline", "rad_sacfd", "--env-kwargs", "obs_size:53", "--eval-freq", "0"]
    crops = ["augmentation:{'rad': {'size': 48}}", *names]
    assert train_tiny(tmp_path / "a", *crops) == 0
    model = tmp_path / "a" / "sacfd" / RUN_NAME / "BulletArm-CloseLoopToy-v0.zip"
    assert train_tiny(tmp_path / "b", *crops, "-i", str(model)) == 0
    rotated = ["buffer_size:400", "--baseline", "equi_sacfd_per_aug", "--eval-freq", "0"]
    assert train_tiny(tmp_path / "c", *rotated) == 0
    model = tmp_path / "c" / "sacfd" / RUN_NAME / "BulletArm-CloseLoopToy-v0.zip"
    assert train_tiny(tmp_path / "d", "-i", str(model)) == 0


def test_a_loaded_model_learns_with_another_buffer(run_folder: Path, toy_id: str) -> None:
    env, other = gym.make(toy_id, obs_size=48), {"sampler": {"shares": {"expert_fraction": 0.25}}}
    file = run_folder / "best_model.zip"
    model = SACfD.load(file, env=env, device="cpu", replay_buffer_kwargs=other, gamma=0.5)
    model.learn(4)
    assert isinstance(model.replay_buffer, ExpertReplayBuffer)
    assert (model.replay_buffer.sampler.expert_fraction, model.replay_buffer.gamma) == (0.25, 0.5)


def test_a_model_of_another_policy_is_refused(
    train_tiny: Train, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for baseline, wanted in ("sacfd", "sacfd.policies.MultiInputPolicy"), ("equi_tqcfd", "tqcfd.policies."):
        given = ["-i", str(run_folder / "best_model.zip"), "--baseline", baseline]
        assert train_tiny(tmp_path, *given) == 2
        assert wanted in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
