"""Resuming of runs, and loading of models."""

import shlex
import shutil
from pathlib import Path

import gymnasium as gym
import pytest
import yaml
from sweeps import RUN_NAME, same

from bulletarm_gym.demonstrations import collect
from sb3_extensions.sacfd import SACfD
from zoo_configs.agents import algorithm_of
from zoo_configs.algorithms import algorithm_classes
from zoo_configs.cli import main
from zoo_configs.training import options
from zoo_configs.training.runs import load_run

STACKING = "BulletArm/OpenLoopBlockStacking-v0"


def test_an_extended_run_equals_a_longer_one(train_tiny, tmp_path, capsys, refuse):
    """Also from an older checkpoint, if the newest is damaged."""
    runs = extended, damaged, longer = [tmp_path / name / "sacfd" / RUN_NAME for name in "abc"]
    # A schedule depends on the end of the training.
    constant = ("n_envs:1", "learning_rate:0.001", "--preset", "quick")
    assert train_tiny(tmp_path / "a", *constant) == 0
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    older, newest = sorted((damaged / "checkpoints").iterdir())
    (newest / "model.zip").write_bytes(b"")
    for run in (extended, damaged):
        capsys.readouterr()
        assert main(["train", "--resume", str(run), "-n", "18", "--no-progress"]) == 0
    [line] = capsys.readouterr().err.splitlines()
    assert str(newest) in line and str(older) in line
    assert train_tiny(tmp_path / "c", *constant, "-n", "18") == 0
    assert same(extended, longer) and same(damaged, longer)
    assert load_run(extended).options == load_run(longer).options
    *shorter, whole = (yaml.safe_load((run / "certificate.yml").read_text())["checksums"] for run in runs)
    assert all(rows and whole[: len(rows)] == rows for rows in shorter)
    for model in damaged.glob("checkpoints/*/model.zip"):
        model.write_bytes(b"")
    assert "model.zip" in refuse("train", "--resume", str(damaged), "-n", "24")


def test_a_resumed_run_has_the_tables_and_the_tensorboard_folder_of_its_options(
    train_tiny, toy_id, tmp_path, capsys, monkeypatch
):
    """Runs that share this folder have logs of their own."""
    folders = []

    class Writer:
        def __init__(self, log_dir):
            folders.append(Path(log_dir).relative_to(tmp_path / "tb" / "BulletArm-CloseLoopToy-v0"))

        def __getattr__(self, name):
            return lambda *args: None

    monkeypatch.setattr(options, "find_spec", lambda name: name)
    monkeypatch.setattr("stable_baselines3.common.utils.SummaryWriter", Writer)
    monkeypatch.setattr("stable_baselines3.common.logger.SummaryWriter", Writer)
    assert train_tiny(tmp_path, "n_envs:1", "--preset", "quick", "--verbose", "0") == 0
    assert "eval/" not in capsys.readouterr().out and not folders
    run = tmp_path / "sacfd" / RUN_NAME
    resume = ["train", "--resume", str(run), "-tb", str(tmp_path / "tb"), "--verbose", "1", "--no-progress"]
    assert main([*resume, "-n", "18"]) == 0
    assert "eval/" in capsys.readouterr().out
    assert len(folders) == 1 and str(folders[0]).startswith("sacfd_1_")


def test_a_model_of_a_run_has_its_algorithm(run_folder, refuse):
    assert "--algo" in refuse("enjoy", str(run_folder / "best_model.zip"), "--algo", "ppo")


def test_a_run_that_cannot_be_resumed_is_one_line(run_folder, refuse):
    fixed = ("--seed", "--baseline", "--env", "--benchmark", "--log-folder")
    for words, text in (
        ("", "12 of 12 steps"),
        ("-n 18 --eval-episodes 3", "eval_episodes must be 2"),
        ("-n 18 --device cuda:99", "'cuda:99'"),
        *((f"{flag} 0", flag) for flag in fixed),
        ("-params gamma:0.5", "-params"),
        ("--env-kwargs obs_size:64", "--env-kwargs"),
        ("-i model.zip", "--trained-agent"),
    ):
        assert text in refuse("train", "--resume", str(run_folder), *words.split())


def test_a_run_without_a_model_is_skipped(trained, toy_id, tmp_path, capsys, refuse):
    shutil.copytree(trained, tmp_path / "logs")
    runs = tmp_path / "logs" / "sacfd"
    killed, garbled = runs / f"{RUN_NAME[:-1]}2", runs / f"{RUN_NAME[:-1]}3"
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
    assert "has no model" in refuse("enjoy", str(killed))


def test_a_damaged_model_and_other_observations_are_named(run_folder, tmp_path, refuse):
    shutil.copytree(run_folder, folder := tmp_path / RUN_NAME)
    content = (folder / "best_model.zip").read_bytes()
    for damaged in content[: len(content) // 2], b"", b"no archive":
        (folder / "best_model.zip").write_bytes(damaged)
        assert "best_model.zip" in refuse("enjoy", str(folder))
    for command in ("enjoy", "record"):
        assert "agent" in refuse(command, str(run_folder), "--env-kwargs", "obs_size:64")


def test_training_starts_from_a_model_that_had_other_demonstrations(train_tiny, tmp_path):
    picking = ["--env", "BulletArm/CloseLoopBlockPicking-v0"]
    collect(picking[1], 2, seed=0, env_kwargs={"obs_size": 48}, path=tmp_path / "expert.h5")
    assert train_tiny(tmp_path / "first", f"expert_data:{tmp_path / 'expert.h5'}", *picking) == 0
    name = Path("sacfd", "BulletArm-CloseLoopBlockPicking-v0_1", "best_model.zip")
    assert train_tiny(tmp_path / "second", *picking, "-i", str(tmp_path / "first" / name)) == 0
    trained = SACfD.load(tmp_path / "second" / name, device="cpu")
    assert trained.n_pretrained == trained.pretrain_steps == 2


def test_training_starts_from_a_model_with_other_hyperparameters(train_tiny, run_folder, tmp_path, capsys):
    model = str(run_folder / "best_model.zip")
    assert main(["enjoy", model, "-n", "1", "--device", "cpu"]) == 0  # its folder has the environment
    more = ["gamma:0.9", "n_steps:2", "replay_buffer_kwargs:{sampler: {shares: {expert_fraction: 0.25}}}"]
    assert train_tiny(tmp_path, *more, "n_envs:2", "-i", model) == 0
    trained = SACfD.load(tmp_path / "sacfd" / RUN_NAME / "best_model.zip", device="cpu")
    assert (trained.gamma, trained.n_steps, trained.n_pretrained) == (0.9, 2, 2)
    assert trained.replay_buffer_kwargs["sampler"]["shares"]["expert_fraction"] == 0.25
    for baseline, wanted in ("sacfd", "sacfd.policies.MultiInputPolicy"), ("equi_tqcfd", "tqcfd.policies."):
        assert train_tiny(tmp_path / "other", "-i", model, "--baseline", baseline) == 2
        assert wanted in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_ctrl_c_prints_the_command_that_resumes(train_tiny, tmp_path, monkeypatch, capsys):
    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("zoo_configs.training.trainer.save_checkpoint", stop)  # after the last step
        assert train_tiny(tmp_path / "a log", "n_envs:1", "--preset", "quick") == 130
        [line] = [line for line in capsys.readouterr().out.splitlines() if "--resume" in line]
        assert train_tiny(tmp_path / "early", "n_envs:1", "--preset", "quick", "--save-freq", "100") == 130
        assert "--resume" not in capsys.readouterr().out
    assert main(shlex.split(line.partition("bulletarm-zoo ")[2])) == 0


def test_a_run_is_read_without_its_first_model(train_tiny, run_folder, tmp_path, monkeypatch, refuse):
    """And without TensorBoard."""
    shutil.copy(run_folder / "best_model.zip", model := tmp_path / "start.zip")
    assert train_tiny(tmp_path / "logs", "n_envs:1", "--preset", "quick", "-i", str(model)) == 0
    model.unlink()
    run = tmp_path / "logs" / "sacfd" / RUN_NAME
    assert main(["train", "--resume", str(run), "-n", "18", "--no-progress"]) == 0
    text = run.joinpath("hyperparams.yml").read_text()
    run.joinpath("hyperparams.yml").write_text(text.replace("tensorboard_log: ''", "tensorboard_log: folder"))
    monkeypatch.setattr(options, "find_spec", lambda name: None)
    assert main(["enjoy", str(run), "-n", "1", "--device", "cpu"]) == 0
    assert "pip install tensorboard" in refuse("train", "--resume", str(run), "-n", "24")


@pytest.mark.parametrize(
    ("name", "env_id", "policy"),
    [
        *((name, "Pendulum-v1", "Mlp") for name in ("a2c", "crossq", "ppo", "sac", "td3", "tqc", "trpo")),
        *((name, "CartPole-v1", "Mlp") for name in ("dqn", "qrdqn")),
        ("ppo_lstm", "Pendulum-v1", "MlpLstm"),
        *((name, "TOY", "MultiInput") for name in ("sacfd", "tqcfd", "ferm")),
        ("sdqfd", STACKING, "FCN"),
    ],
)
def test_a_model_file_is_recognized(name, env_id, policy, toy_id, tmp_path, refuse):
    kwargs = {}
    if env_id == "TOY":
        extractor = {"channels": [4, 8, 8, 8, 8], **({"features_dim": 6} if name == "ferm" else {})}
        kwargs["policy_kwargs"] = {"features_extractor_kwargs": extractor}
        kwargs |= {"augmentation": "drq"} if name == "ferm" else {}
    size = {"TOY": {"obs_size": 48}, STACKING: {"obs_size": 32}}.get(env_id, {})
    env = gym.make(env_id.replace("TOY", toy_id), **size)
    file = str(tmp_path / "model.zip")
    algorithm_classes()[name](f"{policy}Policy", env, **kwargs).save(file)
    env.close()
    # The open-loop algorithms differ in their losses only.
    assert algorithm_of(Path(file)) in ({"adet", "dqfd", "sdqfd"} if name == "sdqfd" else {name})
    if env_id == "TOY":
        words = [file, "--env", toy_id, "-n", "1", "--device", "cpu", "--env-kwargs", "obs_size:48"]
        assert main(["enjoy", *words]) == 0
        assert "'sacc'" in refuse("enjoy", *words, "--algo", "sacc")
