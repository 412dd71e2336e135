"""Command lines drawn at random: followed or refused, without a traceback or half a run."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zoo_configs.cli import main

REACHING = "BulletArm/CloseLoopBlockReaching-v0"
JUNK = "|0|-1|1.5|x|'|a:1|a:|{|☃|nowhere|/dev/null/x|nan|TOY|None".split("|")
ENV_KWARGS = (
    "obs_size obs_size:48 obs_size:2 obs_size:'a' obs_size:None action_sequence:'xyz' "
    "action_sequence:3 robot:panda "
    "render_mode:'human' render_mode:3 max_episode_steps:2 id:1"
).split()
ENVS = ["TOY", "TOY", "TOY", "Pendulum-v1", "my:TOY", "CloseLoopToy", "TOY-v1", REACHING]
BASELINES = ["sacfd", "equi_sacfd", "tqcfd", "sdqfd_fcn", "sacdf"]
FOLDERS = ["RUN", "RUN", "EMPTY", "GARBLED", "."]
VALUES = ["0", "-1", "1", "0.5", "'x'", "None", "True", "[]", "[1]", "{}", "{'a': 1}", "lambda: 0"]
NAMES = """
    learning_rate gamma tau train_freq gradient_steps learning_starts n_envs policy policy_kwargs
    n_steps batch_size replay_buffer_class replay_buffer_kwargs ent_coef target_entropy
    expert_episodes expert_noise expert_data pretrain_steps env_wrapper callback
    normalize frame_stack monitor_kwargs noise_type augmentation bc_weight bc_limit
    self_imitation_temperature value_range exploration critic_warmup_steps n_timesteps
    stats_window_size use_sde action_noise
    target_update_interval env_kwargs buffer_size deterministic_fraction expert_q_weight
""".split()
CHEAP = ["-n", "2", "--eval-freq", "0", "--device", "cpu", "--num-threads", "1", "--no-progress"]
CHEAP_ENV = ["--env-kwargs", "obs_size:48"]
CHEAP_LEARNING = ["expert_episodes:1", "pretrain_steps:1", "batch_size:2", "n_envs:1", "buffer_size:50"]

Choices = dict[str, list[str] | None]
PACKAGES: Choices = {"--gym-packages": ["my", "json", "os.path"]}
PROGRESS: Choices = {"-P": None, "--no-progress": None}
OF_RUN: Choices = {
    "--env": ENVS,
    "--baseline": BASELINES,
    "--algo": ["sacfd", "ppo"],
    "--preset": ["cpu", "quick", "papre"],
    "-f": ["LOGS", "."],
    "--device": ["cpu", "auto", "gpu"],
    "--seed": ["3", "99999999999"],
    "--env-kwargs": ENV_KWARGS,
    "--load-last": None,
    **PACKAGES,
    **PROGRESS,
}
FLAGS: dict[str, Choices] = {
    "train": {
        "--baseline": BASELINES,
        "--algo": ["sacfd", "sac", "ppo", "dqn", "ferm", "sdqfd"],
        "--preset": ["cpu", "quick", "papre"],
        "--benchmark": ["close_loop_4d", "open_loop_2d"],
        "--env": ENVS,
        "--seed": ["3", "99999999999"],
        "--device": ["auto", "gpu0", "cuda:99", "meta"],
        "-f": ["here", "FILE"],
        "-conf": ["FILE", "RUN/hyperparams.yml"],
        "--resume": FOLDERS,
        "-i": ["RUN/best_model.zip", "FILE", "DAMAGED"],
        "--env-kwargs": ENV_KWARGS,
        "-n": ["3", "1"],
        "--eval-freq": ["1", "-2"],
        "--eval-episodes": ["1"],
        "--n-eval-envs": ["1"],
        "--save-freq": ["1", "-3"],
        "--log-interval": ["1", "-4"],
        "--verbose": ["0", "2"],
        "--allow-mismatched-demos": None,
        "-tb": ["logs"],
        "--track": None,
        "-optimize": None,
        "--sampler": ["tpe", "x"],
        **PACKAGES,
        **PROGRESS,
    },
    "enjoy": {**OF_RUN, "-n": ["1"], "--n-envs": ["1"], "--render": None},
    "record": {
        **OF_RUN,
        "--expert": None,
        "-n": ["1"],
        "--format": ["gif", "mp4", "avi"],
        "-o": ["film.gif", "film.mp4", "film", "FILE/film.gif", "."],
        "--fps": ["3", "0", "1e-9"],
    },
    "plot": {
        "--env": ENVS,
        "--baseline": BASELINES,
        "-f": ["LOGS", "FILE"],
        "-o": ["curves.png", "curves.pdf", "curves", "FILE/curves.png"],
        "--training": None,
    },
    "demos": {
        "--env": ["TOY", "Pendulum-v1", REACHING],
        "--planner": ["waypoint", "deconstruction", "magic"],
        "-o": ["demos.h5", "demos", "FILE/demos.h5"],
        "--seed": ["3", "99999999999"],
        "--env-kwargs": ["obs_size:16", *ENV_KWARGS],
        **PACKAGES,
        **PROGRESS,
    },
    "list": {"--env": ENVS, "--baselines": None, "--markdown": None, **PACKAGES},
}
# What keeps a command line quick; flags drawn later win over it.
BEGINNINGS = {
    "train": ["--baseline", "sacfd", "--preset", "cpu", "--env", "TOY", *CHEAP, *CHEAP_ENV],
    "enjoy": ["RUN", "-n", "1"],
    "record": ["RUN", "-n", "1"],
    "plot": ["-f", "LOGS"],
    "demos": ["--env", REACHING, "-n", "1"],
    "list": ["--env", "TOY"],
}

Follow = Callable[[list[str]], None]


def draw(rng: np.random.Generator) -> list[str]:
    """A command line with some flags, often with values that they take."""
    command = str(rng.choice(list(FLAGS), p=[0.5, *[0.1] * 5]))
    alone = rng.random() < 0.1
    line = [command, *([] if alone else BEGINNINGS[command])]
    for flag in rng.choice(list(FLAGS[command]), size=rng.integers(4), replace=False):
        values = FLAGS[command][str(flag)]
        line.append(str(flag))
        if values is not None and rng.random() < 0.95:
            line.append(str(rng.choice(values if rng.random() < 0.7 else JUNK)))
    if command == "train":
        line += ["-params", *CHEAP_LEARNING]
        line += [f"{rng.choice(NAMES)}:{rng.choice(VALUES)}" for _ in range(rng.integers(3))]
    if rng.random() < 0.05:
        line.insert(int(rng.integers(1, len(line) + 1)), str(rng.choice(JUNK)))
    return line


def check_outcome(line: list[str], status: int, errors: str, here: Path) -> None:
    """No traceback, a refusal in one line, and no folder of a run without an agent or a checkpoint."""
    assert status in (0, 2), line
    assert "Traceback" not in errors, line
    if status == 2:
        assert errors.splitlines()[-1].startswith(f"bulletarm-zoo {line[0]}: error: "), line
    for folder in here.rglob("*_[0-9]*/"):
        if folder.is_dir() and (folder / "hyperparams.yml").is_file():
            assert list(folder.glob("*.zip")) or list(folder.glob("checkpoints/*")), line


def damaged_files(run: Path, given: Path) -> dict[str, Path]:
    """What a word of a command line stands for: files and folders that are no runs."""
    (given / "empty").mkdir(parents=True)
    (given / "garbled").mkdir()
    (given / "garbled" / "hyperparams.yml").write_text("run: 3")
    (given / "file").write_text("x")
    (given / "damaged.zip").write_bytes((run / "best_model.zip").read_bytes()[:5000])
    return {
        "EMPTY": given / "empty",
        "GARBLED": given / "garbled",
        "FILE": given / "file",
        "DAMAGED": given / "damaged.zip",
    }


@pytest.fixture
def follow(
    toy_id: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> Follow:
    """Runs a command line in a folder of its own and looks at what it did."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    [run] = trained.glob("sacfd/*_1")
    logs, here = tmp_path / "logs", tmp_path / "here"
    meanings = damaged_files(run, tmp_path / "given")
    meanings |= {"RUN": logs / "sacfd" / run.name, "LOGS": logs, "TOY": Path(toy_id)}

    def go(line: list[str]) -> None:
        shutil.rmtree(logs, ignore_errors=True)
        shutil.copytree(trained, logs)
        here.mkdir()
        monkeypatch.chdir(here)
        words = line
        for name, meant in meanings.items():
            words = [word.replace(name, str(meant)) for word in words]
        status = main(words)
        check_outcome(line, status, capsys.readouterr().err, here)
        shutil.rmtree(here)

    return go


def test_random_command_lines(follow: Follow) -> None:
    rng = np.random.default_rng(0)
    for _ in range(60):
        follow(draw(rng))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 11))
def test_many_random_command_lines(seed: int, follow: Follow) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(150):
        follow(draw(rng))
