"""The command line for real, on a quick environment: train, go on, evaluate, film."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from zoo_configs.cli import main
from zoo_configs.training.training_log import read_training_log

Train = Callable[..., int]
TOY_ID = "BulletArm/CloseLoopToy-v0"


def test_a_run_folder_is_complete(run_folder: Path) -> None:
    names = {path.name for path in run_folder.iterdir()}
    models = {"BulletArm-CloseLoopToy-v0.zip", "best_model.zip", "checkpoints"}
    reports = {"hyperparams.yml", "evaluations.npz", "training.csv", "learning_curve.png", "0.monitor.csv"}
    assert names == {*models, *reports, "BulletArm-CloseLoopToy-v0", "state.yml", ".lock"}


def test_the_resolved_yaml_is_plain(run_folder: Path, toy_id: str) -> None:
    content = yaml.safe_load((run_folder / "hyperparams.yml").read_text())
    assert content["run"]["baseline"] == "equi_sacfd"
    assert content[toy_id]["policy"] == "EquivariantPolicy"
    assert content[toy_id]["env_kwargs"] == {"action_sequence": "pxyzr", "obs_size": 48}
    assert content[toy_id]["batch_size"] == 4


def test_evaluations_report_success(run_folder: Path) -> None:
    with np.load(run_folder / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [0, 6, 12]  # the first after pretraining
        assert evaluations["successes"].shape == (3, 2)


def test_updates_are_logged(run_folder: Path) -> None:
    log = read_training_log(run_folder / "training.csv")
    assert log["timesteps"].tolist() == [0, 6, 12]  # the first is of the pretraining
    for name in ("value_expert", "entropy_expert", "critic_loss", "bc_loss"):
        assert np.isfinite(log[name]).all()
    for name in ("value_online", "entropy_online"):
        assert np.isfinite(log[name]).tolist() == [False, True, True]


def test_plot_draws_what_was_logged(trained: Path, tmp_path: Path) -> None:
    picture = tmp_path / "values.png"
    assert main(["plot", "-f", str(trained), "--training", "-o", str(picture)]) == 0
    with Image.open(picture) as image:
        assert image.size[0] > 2 * image.size[1] * 0.9


def test_plot_needs_a_log(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    [folder] = trained.glob("sacfd/*_1")
    copy = tmp_path / "sacfd" / folder.name
    copy.mkdir(parents=True)
    for name in ("hyperparams.yml", "evaluations.npz"):
        (copy / name).write_bytes((folder / name).read_bytes())
    assert main(["plot", "-f", str(tmp_path), "--training"]) == 2
    assert "has logged its updates" in capsys.readouterr().err


def test_monitor_files_report_success(run_folder: Path) -> None:
    assert "is_success" in (run_folder / "0.monitor.csv").read_text().splitlines()[1]


def test_success_rates_are_logged(
    train_tiny: Train, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_tiny(tmp_path, "--baseline", "sacfd", "--log-interval", "1", "-n", "100") == 0
    printed = capsys.readouterr().out
    rollout, evaluation = printed.partition("rollout/")[2], printed.partition("eval/")[2]
    assert "success_rate" in rollout.partition("time/")[0]
    assert "success_rate" in evaluation.partition("time/")[0]


def test_evaluation_has_the_parameters_but_not_the_scenes_of_training(
    train_tiny: Train, tmp_path: Path, toy_envs: list[object]
) -> None:
    assert train_tiny(tmp_path, "expert_episodes:0", "pretrain_steps:0", "--baseline", "sac") == 0
    _, *evaluation, training = sorted(toy_envs, key=lambda env: 0 in env.seeds)  # type: ignore[attr-defined]
    assert {env.obs_size for env in toy_envs} == {48}  # type: ignore[attr-defined]
    seeds = [seed for env in evaluation for seed in env.seeds if seed is not None]  # type: ignore[attr-defined]
    assert training.seeds[0] == 0  # type: ignore[attr-defined]
    assert len(set(seeds)) >= 2  # fresh scenes at each of the two evaluations
    assert 0 not in seeds


def test_two_runs_never_share_a_folder(tmp_path: Path, toy_id: str) -> None:
    from zoo_configs.training.runs import claim_run_folder

    first = claim_run_folder(tmp_path / "other", toy_id)
    second = claim_run_folder(tmp_path / "other", toy_id)
    assert [first.name, second.name] == ["BulletArm-CloseLoopToy-v0_1", "BulletArm-CloseLoopToy-v0_2"]


def test_claiming_survives_a_race(tmp_path: Path, toy_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process creates the folder between the listing and the claim."""
    from zoo_configs.training.runs import claim_run_folder

    (tmp_path / "BulletArm-CloseLoopToy-v0_1").mkdir()
    monkeypatch.setattr(Path, "iterdir", lambda _: iter(()))
    assert claim_run_folder(tmp_path, toy_id).name == "BulletArm-CloseLoopToy-v0_2"


@pytest.mark.parametrize("model", ["--load-best", "--load-last"])
def test_enjoy_ends_with_the_success_rate(
    run_folder: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["enjoy", str(run_folder), "-n", "4", "--device", "cpu", model]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last in {f"success_rate={rate:.2f} episodes=4" for rate in (0, 0.25, 0.5, 0.75, 1)}


def test_enjoy_repeats_itself(trained: Path, toy_id: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["enjoy", "--baseline", "equi_sacfd", "--env", toy_id, "-f", str(trained), "-n", "5"]
    printed = []
    for _ in range(2):
        assert main([*arguments, "--device", "cpu"]) == 0
        printed.append(capsys.readouterr().out.splitlines()[-1])
    assert printed[0] == printed[1]


def test_enjoy_finds_no_run_of_another_baseline(
    trained: Path, toy_id: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["enjoy", "--baseline", "sacfd", "--env", toy_id, "-f", str(trained)]) == 2
    assert "no run of sacfd" in capsys.readouterr().err


@pytest.mark.parametrize("algo", ["sac", "tqc"])
def test_enjoy_finds_what_train_trained_by_the_name_of_an_algorithm(
    algo: str, toy_id: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    named = ["--algo", algo, "--env", toy_id, "-f", str(tmp_path), "--device", "cpu", "--no-progress"]
    size = ["-n", "2", "--eval-freq", "-1", "--preset", "cpu", "--env-kwargs", "obs_size:48"]
    params = ["expert_episodes:2", "pretrain_steps:0", "batch_size:4", "buffer_size:100", "n_envs:1"]
    assert main(["train", *named, *size, "--seed", "0", "-params", *params]) == 0
    assert f"{toy_id}, seed 0, baseline {algo} of --algo {algo}\n" in capsys.readouterr().out
    assert list(tmp_path.glob(f"{algo}fd/*_1"))
    assert main(["enjoy", *named, "-n", "1"]) == 0
    assert "success_rate=" in capsys.readouterr().out
    assert main(["enjoy", *named, "--algo", "ppo"]) == 2
    assert "no run of ppo" in capsys.readouterr().err


def test_record_films_the_agent(run_folder: Path, tmp_path: Path) -> None:
    film = tmp_path / "agent.gif"
    assert main(["record", str(run_folder), "-n", "2", "--device", "cpu", "-o", str(film)]) == 0
    with Image.open(film) as image:
        assert image.n_frames >= 4  # each episode's first picture and at least one step's
        assert image.size == (640, 352)
    assert [path.name for path in tmp_path.iterdir()] == ["agent.gif"]  # nothing half-written


def test_record_films_the_expert(toy_id: str, tmp_path: Path) -> None:
    film = tmp_path / "expert.mp4"
    assert main(["record", "--expert", "--env", toy_id, "-n", "1", "-o", str(film)]) == 0
    assert film.stat().st_size > 0


@pytest.mark.parametrize(
    ("baseline", "more"),
    [
        ("sacfd", []),
        ("equi_sacfd_per_aug", ["buffer_size:400"]),
        ("equi_tqcfd", []),
        ("sacfd_state", []),
        (
            "ferm_sacfd",
            ["augmentation:{'rad':{'size':48}}", "contrastive_steps:2", "--env-kwargs", "obs_size:53"],
        ),
    ],
)
def test_a_real_task_trains(baseline: str, more: list[str], train_tiny: Train, tmp_path: Path) -> None:
    env_id = "BulletArm/CloseLoopBlockReaching-v0"
    assert train_tiny(tmp_path, *more, "--baseline", baseline, "--env", env_id, "--eval-episodes", "1") == 0
    [run_folder] = tmp_path.glob("*/BulletArm-CloseLoopBlockReaching-v0_1")
    assert main(["enjoy", str(run_folder), "-n", "1", "--device", "cpu"]) == 0


def test_a_stock_algorithm_trains(tmp_path: Path) -> None:
    arguments = ["train", "--algo", "sac", "--env", "Pendulum-v1", "-f", str(tmp_path), "-n", "20"]
    assert main([*arguments, "--eval-freq", "-1", "--no-progress", "--env-kwargs", "g:9.0"]) == 0
    content = yaml.safe_load((tmp_path / "sac" / "Pendulum-v1_1" / "hyperparams.yml").read_text())
    assert content["Pendulum-v1"]["env_kwargs"] == {"g": 9.0}


@pytest.mark.parametrize(
    ("algo", "parameters"),
    [
        ("ppo", ["n_steps:8", "batch_size:8"]),
        ("td3", ["buffer_size:50", "learning_starts:4", "batch_size:4"]),
    ],
)
def test_a_stock_algorithm_trains_on_images(
    algo: str, parameters: list[str], toy_id: str, tmp_path: Path
) -> None:
    arguments = ["train", "--algo", algo, "--env", toy_id, "-f", str(tmp_path), "-n", "8", "--no-progress"]
    options = ["--eval-freq", "-1", "--env-kwargs", "obs_size:48", "-params", *parameters]
    assert main([*arguments, *options, "--device", "cpu"]) == 0


TRAINING_BAR = "━"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_bars_are_for_terminals(
    train_tiny: Train,
    run_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`train_tiny` says --no-progress, the others nothing. The output is a file here."""
    train = ["train", "--baseline", "sacfd", "--preset", "cpu", "--env", TOY_ID, "-f", str(tmp_path / "b")]
    train += ["-n", "2", "--eval-freq", "0", "--device", "cpu", "--env-kwargs", "obs_size:48"]
    train += ["-params", "expert_episodes:2", "pretrain_steps:2", "batch_size:4", "buffer_size:100"]
    enjoy = ["enjoy", str(run_folder), "-n", "1", "--device", "cpu"]
    for file, shown in (Terminal(), True), (io.StringIO(), False):
        monkeypatch.setattr(sys, "stderr", file)
        assert main(train) == main(enjoy) == 0
        bars = ("expert episodes", "pretraining", TRAINING_BAR, "1/1")
        assert [bar in file.getvalue() for bar in bars] == [shown] * 4
    assert TRAINING_BAR not in capsys.readouterr().out
    monkeypatch.setattr(sys, "stderr", silent := Terminal())
    assert train_tiny(tmp_path / "a") == main([*enjoy, "--no-progress"]) == 0
    assert silent.getvalue() == ""


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("train", "enjoy", "record", "plot", "list"))
