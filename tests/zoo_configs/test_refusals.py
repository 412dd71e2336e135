"""What cannot be followed: one line, exit code 2, nothing left behind."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from zoo_configs.cli import main
from zoo_configs.drawing import video
from zoo_configs.errors import CommandError
from zoo_configs.experiments import ranges
from zoo_configs.training import options

Refuse = Callable[..., str]
REACHING = "BulletArm/CloseLoopBlockReaching-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
TRAIN = ["train", "--baseline", "sacfd", "--preset", "cpu", "--env", "TOY", "--device", "cpu"]
NO_FOLDER = "/dev/null/folder"  # /dev/null is none


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tarin"], "unknown command 'tarin', did you mean 'train'?"),
        (["frobnicate"], "unknown command 'frobnicate', choose from benchmark, demos"),
        (["train", "--baseline", "sacfd", "--env", "BulletArm/CloseLopToy-v0"], "CloseLoopToy-v0'?"),
        (["train", "--baseline", "sacfd", "--env", "CloseLoopFrobnication"], "see bulletarm-zoo list"),
        (["train", "--baseline", "safcd"], "name an environment"),
        (["train", "--baseline", "safcd", "--env", "TOY"], "unknown baseline 'safcd', did you mean 'sacfd'?"),
        (
            ["train", "--baseline", "sacfd", "--algo", "ppo", "--env", "TOY"],
            "--algo must be sacfd",
        ),
        (["train", "--baseline", "sacfd", "--preset", "cpuu", "--env", "TOY"], "did you mean 'cpu'?"),
        (["train", "--algo", "pp0", "--env", "TOY"], "unknown algorithm 'pp0', did you mean 'ppo'?"),
        (["train", "--algo", "crossq", "--env", "TOY"], "You must use `MultiInputPolicy`"),
        (["train", "--algo", "ppo", "--conf-file", "none.yml", "--env", "TOY"], "got none.yml"),
        (["train", "--algo", "dqn", "--env", "Pendulum-v1"], "only supports"),
        (
            ["train", "--algo", "dqfd", "--env", STACKING, "--benchmark", "open_loop_6d"],
            "got 'open_loop_6d'",
        ),
        (["train", "--algo", "ferm", "--env", STACKING], "no baseline of ferm"),
        (["train", "--resume", "nowhere"], "nowhere is not a run folder"),
        ([*TRAIN, "frobnicate"], "unrecognized arguments: frobnicate"),
        ([*TRAIN, "--frobnicate"], "unrecognized arguments: --frobnicate"),
        ([*TRAIN, "--vec-env", "frobnicate"], "invalid choice: 'frobnicate'"),
        ([*TRAIN, "--n-trials", "500"], "unrecognized arguments: --n-trials 500"),
        ([*TRAIN, "-n", "0"], "at least 1, got '0'"),
        ([*TRAIN, "-n", "-5"], "at least 1, got '-5'"),
        ([*TRAIN, "-n", "many"], "at least 1, got 'many'"),
        ([*TRAIN, "--eval-episodes", "0"], "--eval-episodes: must be a whole number of at least 1"),
        ([*TRAIN, "--num-threads", "0"], "--num-threads: must be a whole number"),
        ([*TRAIN, "--seed", "1e9"], "--seed: must be a whole number"),
        ([*TRAIN, "--device", "gpu0"], "device, got 'gpu0'"),
        ([*TRAIN, "--device", "cuda:99"], "device, got 'cuda:99'"),
        ([*TRAIN, "-i", "none.zip"], ".zip file, got none.zip"),
        ([*TRAIN, "-f", NO_FOLDER], f"{NO_FOLDER}/sacfd: Not a directory"),
        ([*TRAIN, "--gym-packages", "frobnicate"], "package 'frobnicate' cannot be imported"),
        ([*TRAIN, "--env-kwargs", "obs_size:8"], "obs_size must be at least 48, got 8"),
        ([*TRAIN, "--env-kwargs", "options:'foo'"], "unexpected keyword argument 'options'"),
        ([*TRAIN, "-params", "gama:1"], "did you mean 'gamma'?"),
        ([*TRAIN, "-params", "gamma:x"], "got 'x'"),
        ([*TRAIN, "-params", "learning_rate:-1"], "learning_rate must be a number of at least 0"),
        ([*TRAIN, "-params", "learning_rate:'lin_x'"], "learning_rate must be"),
        ([*TRAIN, "-params", "batch_size:0"], "batch_size must be a whole number of at least 1, got 0"),
        ([*TRAIN, "-params", "n_envs:0"], "n_envs must be"),
        ([*TRAIN, "-params", "policy_kwargs:3"], "policy_kwargs must be a mapping of arguments, got 3"),
        ([*TRAIN, "-params", "policy_kwargs:{'net_arch': 'x'}"], "net_arch"),
        (
            [*TRAIN, "-params", "replay_buffer_kwargs:{'sampler': {'shares': {'expert_fraction': 2.0}}}"],
            "expert_fraction must be",
        ),
        ([*TRAIN, "-params", "policy_kwargs:{'features_extractor_class': 3}"], "import path of a class"),
        ([*TRAIN, "-params", "policy_kwargs:{'features_extractor_kwargs': 3}"], "must be a mapping"),
        ([*TRAIN, "-params", "gradient_steps:'x'"], "gradient_steps must be a whole number"),
        ([*TRAIN, "-params", "train_freq:[1, 'week']"], "train_freq must be"),
        ([*TRAIN, "-params", "action_noise:True"], "noise_type"),
        ([*TRAIN, "-params", "gamma:{"], "-params must be key:value with a YAML value, got 'gamma:{'"),
        ([*TRAIN, "-params", "policy_kwargs:exit(3)"], "name 'exit' is not defined"),
        ([*TRAIN, "-params", "expert_episodes:-1"], "expert_episodes must not be negative"),
        ([*TRAIN, "-params", "expert_data:'none.h5'"], "none.h5"),
        (["demos", "--env", REACHING, "--env-kwargs", "obs_size=64"], "got 'obs_size=64'"),
        (
            ["demos", "--env", REACHING, "--env-kwargs", "obs_size:64", "obs_size:32"],
            "--env-kwargs must have each key once, got obs_size more often",
        ),
        ([*TRAIN, "-params", "gamma:0.9", "gamma:0.99"], "-params must have each key once, got gamma"),
        (["demos", "--env", REACHING, "--env-kwargs", "robot:'x'"], "robot must be one of 'kuka'"),
        (["demos", "--env", REACHING, "-o", f"{NO_FOLDER}/a.h5"], "cannot be written"),
        (["demos", "--env", REACHING, "-n", "0"], "at least 1, got '0'"),
        (["demos", "--env", REACHING, "--env-kwargs", "obs_size:2"], "got 2"),
        (
            ["train", "--baseline", "sdqfd_fcn", "--env", STACKING, "--preset", "quick"],
            f"preset must be one of cpu, paper for {STACKING}, got 'quick'",
        ),
        (["record"], "pass a run folder"),
        (["train", "--baseline", "sdqfd_fcn", "--env", REACHING], "is for BulletArm/OpenLoop*, not for"),
        (["record", "--expert"], "--expert needs --env"),
        (["record", "nowhere", "--expert", "--env", "TOY"], "neither a path nor --published"),
        (["record", "--expert", "--env", "Pendulum-v1"], "has no expert"),
        (["record", "--expert", "--env", "TOY", "--env-kwargs", "obs_size:8"], "at least 48, got 8"),
        (
            ["record", "--expert", "--env", "TOY", "--env-kwargs", "render_mode:'human'"],
            "must be 'rgb_array'",
        ),
        (["record", "--expert", "--env", "TOY", "-o", f"{NO_FOLDER}/a.gif"], "cannot be written"),
        (["record", "--expert", "--env", "TOY", "--fps", "nan"], "--fps must be positive"),
        (["record", "--expert", "--env", "TOY", "-o", "a.avi"], "must end in .gif or .mp4"),
        (["enjoy"], "pass a run folder"),
        (["enjoy", "nowhere"], "nowhere is not a run folder"),
        (
            ["enjoy", "--env", "TOY", "--baseline", "sacfd"],
            "no run of sacfd on BulletArm/CloseLoopToy-v0 in logs",
        ),
        (["enjoy", "none.zip", "--env", "TOY", "--algo", "sac"], "none.zip does not exist"),
        (["enjoy", "none.zip"], "pass --env with none.zip"),
        (["plot"], "no evaluated run"),
        (["list", "--baseline", "sacfd"], "sacfd"),
        (["list", "--env", "xyzzy"], "unknown environment 'xyzzy', see bulletarm-zoo list"),
    ],
    ids=lambda value: " ".join(value[-3:]) if isinstance(value, list) else "",
)
def test_errors_are_one_clear_line(arguments: list[str], message: str, refuse: Refuse) -> None:
    assert message in refuse(*arguments)


@pytest.mark.parametrize("flag", ["--track", "-tb"])
def test_packages_that_are_not_installed_are_named(
    flag: str, refuse: Refuse, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(options, "find_spec", lambda name: None)
    line = refuse(*TRAIN, flag, *(["logs"] if flag == "-tb" else []))
    assert "pip install" in line and "tensorboard" in line


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere a window needs no server")
def test_a_window_needs_a_display(refuse: Refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    arguments = ["train", "--baseline", "sacfd", "--preset", "cpu", "--env", REACHING]
    assert "no display was found" in refuse(*arguments, "--env-kwargs", "render_mode:'human'")


def test_an_agent_is_not_put_where_it_sees_something_else(run_folder: Path, refuse: Refuse) -> None:
    for command in ("enjoy", "record"):
        line = refuse(command, str(run_folder), "--env-kwargs", "obs_size:64")
        assert "the agent cannot act here" in line


def test_a_learner_that_cannot_learn_leaves_nothing(
    refuse: Refuse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What turns out in the first update only, in the place where all runs are kept."""
    (tmp_path / "logs").mkdir()
    more = ["expert_episodes:0", "pretrain_steps:0", "n_envs:1", "learning_starts:0", "tau:'x'"]
    monkeypatch.setattr(ranges, "RANGES", {})
    assert "sacfd cannot train on" in refuse(*TRAIN, "-n", "20", "--eval-freq", "0", "-params", *more)


def test_a_full_disk_is_told(refuse: Refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(video.Path, "write_bytes", fill)
    line = refuse("record", "--expert", "--env", "TOY", "-n", "1", "-o", "new/film.gif")
    assert line.endswith("film.gif: No space left on device")


def test_the_traceback_is_there_for_who_asks(toy_id: str) -> None:
    with pytest.raises(CommandError, match="at least 48") as raised:
        main(["--traceback", "record", "--expert", "--env", toy_id, "--env-kwargs", "obs_size:8"])
    assert isinstance(raised.value.__cause__, ValueError)


def test_errors_between_processes_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise ConnectionResetError(errno.ECONNRESET, "a worker is gone")

    monkeypatch.setattr("zoo_configs.commands.plot.main", fail)
    with pytest.raises(ConnectionResetError):
        main(["plot"])


def test_errors_of_a_users_code_are_told_with_their_place(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any) -> None:
        raise KeyError("no item of that name")

    monkeypatch.setattr("zoo_configs.commands.plot.main", fail)
    assert main(["plot"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert f"KeyError: 'no item of that name' ({__file__}, line " in line and "--traceback plot" in line
    with pytest.raises(KeyError):
        main(["--traceback", "plot"])


def test_who_stops_reading_gets_no_traceback() -> None:
    command = [sys.executable, "-m", "zoo_configs.cli", "--help"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    with process.stderr as errors:
        assert errors.read() == b""
    assert process.wait() == 141


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    from bulletarm_gym import __version__

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"bulletarm-zoo {__version__}\n"


def test_unknown_parameter_is_named_without_all_parameters(refuse: Refuse) -> None:
    message = refuse("demos", "--env", REACHING, "--env-kwargs", "obssize:64")
    assert message.strip().endswith("Did you mean 'obs_size'?")
