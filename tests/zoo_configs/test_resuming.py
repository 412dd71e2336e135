"""Resuming of runs, also after a kill at any moment, loading of models, and certificates of trainings."""

import os
import pickle
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from sweeps import PATH, RUN_NAME, TINY, TUNED, jobs_of, same, study_of

from bulletarm_gym.demonstrations import collect
from sb3_extensions.sacfd import SACfD
from zoo_configs.agents import AgentQuery, algorithm_of, find_agent
from zoo_configs.algorithms import algorithm_classes
from zoo_configs.cards import read_card
from zoo_configs.cli import main
from zoo_configs.training import options
from zoo_configs.training.runs import find_runs, load_run
from zoo_configs.training.state import State, run_status
from zoo_configs.training.train import train_run
from zoo_configs.tuning.study import counted

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


def test_a_run_that_cannot_be_resumed_is_one_line(run_folder, tmp_path, refuse):
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
    copy = Path(shutil.copytree(run_folder, tmp_path / RUN_NAME))
    (file := copy / "hyperparams.yml").write_text(file.read_text().replace("batch_size: ", "batch_size: 1"))
    assert "batch_size" in refuse("train", "--resume", str(copy), "-n", "18")


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


def test_a_model_file_has_the_parameters_of_its_run(run_folder, toy_id):
    for env in None, toy_id, f"toy_env:{toy_id}":
        query = AgentQuery(run_folder / "best_model.zip", env, device="cpu")
        assert find_agent(query).env_kwargs["obs_size"] == 48


def test_a_damaged_model_another_algorithm_and_other_observations_are_named(run_folder, tmp_path, refuse):
    assert "--algo" in refuse("enjoy", str(run_folder / "best_model.zip"), "--algo", "ppo")
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
    more = [
        "gamma:0.9",
        "n_steps:2",
        "ent_coef:auto_0.5",
        "replay_buffer_kwargs:{sampler: {shares: {expert_fraction: 0.25}}}",
    ]
    assert train_tiny(tmp_path, *more, "n_envs:2", "-i", model) == 0
    trained = SACfD.load(tmp_path / "sacfd" / RUN_NAME / "best_model.zip", device="cpu")
    assert (trained.gamma, trained.n_steps, trained.n_pretrained) == (0.9, 2, 2)
    assert trained.log_ent_coef.exp().item() == pytest.approx(0.5, rel=0.1)
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


COUNTING = "CloseLoopToyCounting"
OPTIONS = {**TINY["options"], "eval_freq": 4, "eval_episodes": 1, "save_freq": 4, "num_threads": 1}
TUNE = ["tune", "--baseline", "sacfd", "--preset", "quick", *TUNED, "-n", "6", "--n-trials", "2"]
TUNE += ["--num-threads", "1", "--eval-episodes", "1", "--n-evaluations", "2", "--n-startup-trials", "1"]
TUNE += ["--env", f"toy_tasks:BulletArm/{COUNTING}-v0"]


def moments(highest, count):
    """Numbers of events; the default run has the first one alone."""
    numbers = np.random.default_rng(0).integers(1, highest, count).tolist()
    return [numbers[0], *(pytest.param(number, marks=pytest.mark.slow) for number in numbers[1:])]


def train(folder):
    [job] = jobs_of(Path(), tasks=[COUNTING], seeds=1, options=OPTIONS)
    return train_run(replace(job, folder=Path(folder)))


def run_dying(moment, code):
    """Run code in a process that kills itself at an event."""
    variables = {**os.environ, "DIES_AT": str(moment), "PYTHONPATH": PATH}
    done = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, check=False)
    assert done.returncode in (0, -9), done.stderr


@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize("moment", moments(45, 27))
def test_a_killed_training_loses_nothing(moment, tmp_path):
    run_dying(moment, f"import test_resuming; test_resuming.train({str(tmp_path / 'run')!r})")
    assert run_status(tmp_path / "run").state in (State.WAITING, State.DONE, State.KILLED)
    assert same(train(tmp_path / "run").folder, train(tmp_path / "whole").folder)


@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize("moment", moments(60, 26))
def test_a_killed_study_loses_nothing(moment, tmp_path):
    (tmp_path / "space.yml").write_text("learning_rate: {low: 0.0001, high: 0.01, log: true}")
    words = [*TUNE, "-f", str(tmp_path / "logs"), "--space", str(tmp_path / "space.yml")]
    run_dying(moment, f"from zoo_configs.cli import main; main({words!r})")
    assert main(words) == 0
    assert main([*words, "--study-name", "whole"]) == 0
    studies = [study_of(tmp_path / "logs", name) for name in (f"sacfd_{COUNTING}", "whole")]
    killed, whole = ({str((t.params, t.value, t.state)) for t in counted(study)} for study in studies)
    assert killed == whole and len(whole) == 2


def test_a_repeated_training_has_the_checksums_of_the_run(run_folder, capsys):
    first, *_, last = rows = yaml.safe_load((run_folder / "certificate.yml").read_text())["checksums"]
    numbers = [row["updates"] for row in rows]
    assert numbers[:3] == [0, 1, 2] and last["updates"] >= 10
    assert len({row["parameters"] for row in rows}) == len(rows)
    assert first["replay_buffer"] != last["replay_buffer"]
    before = sorted(run_folder.rglob("*"))
    assert main(["verify", str(run_folder), "--no-progress"]) == 0
    assert ", ".join(map(str, numbers)) in capsys.readouterr().out.splitlines()[-1]
    assert sorted(run_folder.rglob("*")) == before


def test_a_longer_run_repeats_until_its_first_end(run_folder, tmp_path, capsys):
    """Its learning rate depends on the number of time steps."""
    copy = shutil.copytree(run_folder, tmp_path / "run")
    assert main(["train", "--resume", str(copy), "-n", "30", "--no-progress"]) == 0
    assert (copy / "certificate.yml").read_text() == (run_folder / "certificate.yml").read_text()
    assert main(["verify", str(copy), "--no-progress"]) == 0


@pytest.mark.parametrize("quantity", ["observations", "parameters", "replay_buffer"])
def test_the_first_difference_and_other_versions_are_named(quantity, run_folder, tmp_path, refuse):
    copy = shutil.copytree(run_folder, tmp_path / "run")
    content = yaml.safe_load((copy / "certificate.yml").read_text())
    content["checksums"][1][quantity] = "0" * 16
    content["versions"]["python"] = "2.7"
    (copy / "certificate.yml").write_text(yaml.safe_dump(content))
    message = refuse("verify", str(copy), "--no-progress", "--updates", "1")
    assert f"{quantity} differ after 1 updates" in message and "2.7" in message


def test_a_published_agent_can_be_verified(run_folder, tmp_path):
    folder = str(tmp_path / "agent")
    assert main(["push", str(run_folder), "--folder", folder, "-n", "1", "--no-progress"]) == 0
    certificate = read_card(tmp_path / "agent").certificate
    assert certificate["options"] == {"n_timesteps": 12, "vec_env": "dummy", "num_threads": 1}
    assert main(["verify", "--published", folder, "--updates", "1", "--no-progress"]) == 0


def test_mistakes_are_one_line(run_folder, tmp_path, refuse):
    copy = shutil.copytree(run_folder, tmp_path / "run")
    (copy / "certificate.yml").write_text("checksums: 1")
    assert "certificate.yml" in refuse("verify", str(copy))
    (copy / "certificate.yml").unlink()
    assert "certificate.yml" in refuse("verify", str(copy))
    assert "RUN_FOLDER" in refuse("verify")
    assert "--baseline" in refuse("verify", str(run_folder), "--baseline", "sacfd")
    assert "'-1'" in refuse("verify", str(run_folder), "--updates", "-1")


def test_an_agent_with_hindsight_replay_acts(tmp_path):
    config = {
        "n_timesteps": 8,
        "policy": "MultiInputPolicy",
        "env_kwargs": {"observation": "state", "max_steps": 4},
        "env_wrapper": "bulletarm_gym.wrappers.GoalObservation",
        "replay_buffer_class": "HerReplayBuffer",  # as in files of rl_zoo3
    }
    (file := tmp_path / "her.yml").write_text(yaml.safe_dump({"default": config}))
    words = ["--algo", "sac", "--env", "BulletArm/CloseLoopBlockReaching-v0", "--conf-file", str(file)]
    assert main(["train", *words, "--eval-freq", "0", "-f", str(tmp_path), "--no-progress"]) == 0
    [run] = find_runs(tmp_path)
    assert main(["enjoy", str(run.folder), "-n", "1", "--no-progress"]) == 0


def test_a_run_keeps_the_normalization_of_the_model_that_it_started_from(train_tiny, tmp_path, refuse):
    first, second = (tmp_path / name / "sacfd" / RUN_NAME for name in ("first", "second"))
    assert train_tiny(tmp_path / "first", "normalize:{norm_obs: false, clip_reward: 3}") == 0
    assert train_tiny(tmp_path / "second", "-i", str(first / "best_model.zip")) == 0
    shutil.rmtree(first)
    assert main(["train", "--resume", str(second), "-n", "18", "--verbose", "0"]) == 0
    assert pickle.loads(load_run(second).statistics_file.read_bytes()).clip_reward == 3
    for words in ("record",), ("push", "--folder", str(tmp_path / "pushed")):
        assert "normalize" in refuse(words[0], str(second), *words[1:])
