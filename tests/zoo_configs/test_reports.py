"""Lists, curves, tables, videos, demonstrations and other files."""

import csv
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import closing

import gymnasium
import h5py
import imageio.v3 as iio
import numpy as np
import pytest
from gymnasium import spaces
from PIL import Image
from sweeps import ROOT

from bulletarm_gym.demonstrations import load
from zoo_configs import provenance
from zoo_configs.cli import main
from zoo_configs.drawing.curves import SUCCESS, LearningCurve, draw_curves, mean_curve
from zoo_configs.drawing.video import observed_images
from zoo_configs.experiments.config import resolve
from zoo_configs.experiments.flags import find_experiment
from zoo_configs.parsers import parse_train
from zoo_configs.results import baseline_rows, experiment_row, interquartile_mean, read_experiments
from zoo_configs.training.options import TrainingOptions, given_options
from zoo_configs.training.runs import Run, find_runs, repeating_command, write_resolved
from zoo_configs.training.state import State, run_lock, set_status

PICKING, REACHING = "BulletArm/CloseLoopBlockPicking-v0", "BulletArm/CloseLoopBlockReaching-v0"
SMALL = {"obs_size": 48}
OVERRIDES = {"expert_episodes": 7, "replay_buffer_kwargs": {"expert_fraction": 0.4}, "env_kwargs": SMALL}
GOOD = [[False] * 4, [True, True, False, True], [True, True, True, False]]


@pytest.mark.parametrize(
    ("words", "row"),
    [
        ("", REACHING),
        (f"--env {REACHING}", "control 'close_loop' surface 'flat'"),
        ("--baselines", "equi_sacfd_per_aug sacfd equivariant per_aug"),
    ],
)
def test_lists_fit_80_columns(words, row, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["list", *words.split()]) == 0
    printed = capsys.readouterr().out
    assert max(len(line) for line in printed.splitlines() if not line.startswith("observation")) <= 80
    assert "…" not in printed and row in " ".join(printed.split())


def test_help_loads_neither_pytorch_nor_the_engine(capsys):
    code = (
        "import sys; from zoo_configs.cli import COMMANDS, main\n"
        "for command in COMMANDS:\n"
        "    try: main([command, '--help'])\n"
        "    except SystemExit: pass\n"
        "assert not {'torch', 'pybullet', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert main([]) == main(["--version"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("train", "enjoy", "record", "plot", "list"))


def test_a_mean_curve_has_at_each_step_the_runs_that_were_evaluated():
    error = np.full(3, 0.1)
    long = LearningCurve(np.array([5, 10, 15]), np.array([0.0, 0.5, 1.0]), error, "success")
    short = LearningCurve(np.array([5, 10]), np.array([1.0, 1.0]), error[:2], "success")
    mean = mean_curve([long, short])
    found = [mean.timesteps, mean.success, mean.error]
    np.testing.assert_allclose(found, [[5, 10, 15], [0.5, 0.75, 1.0], [0.5, 0.25, np.nan]])


def test_plot_draws_values_of_expert_and_online_transitions(trained, tmp_path, refuse):
    assert main(["plot", "-f", str(trained), "--training", "-o", str(tmp_path / "a.png")]) == 0
    with Image.open(tmp_path / "a.png") as image:
        assert image.size[0] > 2 * image.size[1] * 0.9  # two panels
    shutil.copytree(trained, logs := tmp_path / "logs")
    next(logs.glob("sacfd/*/training.csv")).unlink()
    assert "logged" in refuse("plot", "-f", str(logs), "--training")


def add_run(folder, env_id, baseline, seed, successes, **changes):
    """A run that was evaluated every 10 time steps; it gets the next free folder."""
    options = {"n_timesteps": 30, "eval_freq": 10, "num_threads": 1, **changes.pop("options", {})}
    experiment = resolve(baseline, changes.pop("preset", "cpu"), env_id, {**OVERRIDES, **changes})
    task = env_id.partition("/")[2].partition("-")[0]
    place = folder / f"{task}_{len(list(folder.glob('*')))}" / baseline / f"seed_{seed}"
    run = Run(place, experiment, seed, "cpu", TrainingOptions.of(experiment, options))
    write_resolved(run)
    with run_lock(run.folder):
        steps = np.arange(1, len(successes) + 1) * 10
        np.savez(run.evaluations_file, timesteps=steps, results=successes, successes=successes)
    return run


@pytest.fixture
def folder(tmp_path):
    """Two tasks, two baselines, two seeds."""
    for env_id in (PICKING, REACHING):
        for seed in range(2):
            good = [[False] * 4, [True, True, False, seed == 0], [True, True, True, seed == 0]]
            add_run(tmp_path, env_id, "equi_sacfd", seed, good)
            add_run(tmp_path, env_id, "sacfd", seed, [[False] * 4, [True] + [False] * 3])
    return tmp_path


def test_runs_of_other_settings_are_other_experiments(tmp_path):
    """Evaluations and threads do not make an experiment."""
    add_run(tmp_path, REACHING, "sacfd", 0, GOOD)
    add_run(tmp_path, REACHING, "sacfd", 1, GOOD, options={"eval_episodes": 3, "num_threads": 2})
    assert [experiment.label for experiment in read_experiments(tmp_path)] == ["sacfd"]
    for changes, label in (
        ({"learning_rate": 0.002}, "learning_rate=0.002"),
        ({"env_kwargs": {**SMALL, "robot": "panda"}}, "robot=panda"),
        ({"preset": "quick"}, "preset=quick"),
        ({"options": {"n_timesteps": 20}}, "n_timesteps=20"),
    ):
        add_run(tmp_path, REACHING, "sacfd", 0, GOOD, **changes)
        assert sum(label in experiment.label for experiment in read_experiments(tmp_path)) == 1


def test_experiments_are_in_the_order_of_their_numbers(tmp_path):
    for count in (100, 5, 10):
        add_run(tmp_path, REACHING, "sacfd", 0, GOOD, expert_episodes=count)
    labels = [experiment.label for experiment in read_experiments(tmp_path)]
    assert labels == [f"sacfd, expert_episodes={count}" for count in (5, 10, 100)]


def test_variants_of_a_benchmark_are_labelled_by_their_names(tmp_path):
    for variant, changes in (("complete", {}), ("no_rotation", {"augmentation": None})):
        run = add_run(tmp_path, REACHING, "sacfd", 0, GOOD, **changes)
        run.folder.parent.rename(run.folder.parents[1] / f"sacfd-{variant}")
    labels = [experiment.label for experiment in read_experiments(tmp_path)]
    assert labels == ["sacfd, complete", "sacfd, no_rotation"]


def test_a_long_label_is_inside_of_the_figure(tmp_path):
    curve = LearningCurve(np.array([0, 1]), np.ones(2), np.zeros(2), SUCCESS)
    widths = []
    for label in ("sacfd", "sacfd, " + 100 * "long"):
        draw_curves({REACHING: {label: curve}}, tmp_path / "figure.png")
        with Image.open(tmp_path / "figure.png") as image:
            widths.append(image.size[0])
    assert widths[1] > 3 * widths[0]


def test_an_equal_run_counts_once(tmp_path, capsys):
    longer = add_run(tmp_path, REACHING, "sacfd", 0, GOOD)
    shorter = add_run(tmp_path, REACHING, "sacfd", 0, GOOD[:2])
    [experiment] = read_experiments(tmp_path)
    assert [result.run.folder for result in experiment.results.values()] == [longer.folder]
    assert str(shorter.folder) in capsys.readouterr().err


def test_tables_show_every_seed(folder):
    experiments = read_experiments(folder)
    row = ["CloseLoopBlockPicking", "equi_sacfd", "0.88", "0: 1.00, 1: 0.75", "2 of 2", "30"]
    assert experiment_row(experiments[0])[:6] == row
    assert baseline_rows(experiments)[0] == ["equi_sacfd", "0.88", "0: 1.00, 1: 0.75", "0.88", "2", "4"]
    means = [interquartile_mean(values) for values in ([0.0, 1.0, 0.4, 0.6], [0.0, 1.0, 0.5], [0.3])]
    assert means == pytest.approx([0.5, 0.5, 0.3])


def test_the_command_of_a_run_repeats_it(folder):
    run = next(run for run in find_runs(folder) if run.seed == 1)
    words = shlex.split(repeating_command(run))
    assert words[:2] == ["bulletarm-zoo", "train"]
    args = parse_train(words[2:])
    again = find_experiment(args)
    assert again.hyperparams == run.experiment.hyperparams and args.seed == 1 and args.device == "cpu"
    assert TrainingOptions.of(again, given_options(args)) == run.options


def test_plot_writes_figure_and_tables(folder, capsys, refuse):
    assert main(["plot", "-f", str(folder)]) == 0
    out = capsys.readouterr().out
    written = [folder / f"learning_curves.{suffix}" for suffix in ("png", "md", "csv")]
    assert [line.strip() for line in out.splitlines()[-3:]] == [str(path) for path in written]
    assert written[0].read_bytes().startswith(b"\x89PNG")
    page = written[1].read_text()
    assert "](learning_curves.png)" in page and "torch" in page and "interquartile mean" in page
    assert page.count("    bulletarm-zoo train --env") == 4
    with written[2].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 and {row["done"] for row in rows} == {"yes"}
    assert [row["success"] for row in rows[:2]] == ["1.0", "0.75"]
    svg, env = str(folder / "curves.svg"), f"json:{PICKING}"  # any module in front
    assert main(["plot", "-f", str(folder), "--env", env, "--baseline", "sacfd", "-o", svg]) == 0
    out = capsys.readouterr().out
    assert "equi_sacfd" not in out and "BlockReaching" not in out
    evaluations = next(folder.glob("*/*/*/evaluations.npz"))
    evaluations.write_bytes(evaluations.read_bytes()[:100])
    assert str(evaluations) in refuse("plot", "-f", str(folder))


def test_seed_and_device_select_runs(folder, capsys, refuse):
    def listed(*words):
        assert main(["list", "-f", str(folder), *words]) == 0
        return [line.split() for line in capsys.readouterr().out.splitlines()[1:]]

    assert len(listed()) == 8 and listed("--device", "cpu") == listed()
    rows = listed("--env", PICKING, "--seed", "1")
    assert rows[0][:4] == ["CloseLoopBlockPicking", "equi_sacfd", "1", "0.75"] and len(rows) == 2
    assert main(["plot", "-f", str(folder), "--seed", "1"]) == 0
    assert "1: 0.75" in (printed := capsys.readouterr().out) and "0: 1.00" not in printed
    assert str(folder) in refuse("plot", "-f", str(folder), "--device", "cuda")
    assert "--log-folder" in refuse("list", "--seed", "1")


def test_returns_and_failed_runs_are_in_the_table(tmp_path):
    run = add_run(tmp_path, REACHING, "sacfd", 0, GOOD)
    np.savez(run.evaluations_file, timesteps=[10], results=[[3.0, 5.0]])
    (run.folder / "state.yml").unlink()
    set_status(run.folder, State.FAILED, "the block is lost")
    [experiment] = read_experiments(tmp_path)
    assert experiment_row(experiment)[2:5] == ["4.00", "0: 4.00", "0 of 1"]
    assert experiment.results[0].curve.measure == "evaluation return"


def test_record_shows_agent_and_expert(run_folder, tmp_path):
    video = tmp_path / f"{'agent' * 50}.gif"  # nearly the longest name of a file
    assert main(["record", str(run_folder), "-n", "2", "--device", "cpu", "-o", str(video)]) == 0
    with Image.open(video) as image:
        assert image.n_frames >= 4 and image.size == (640, 352)
    video = tmp_path / "expert.mp4"
    words = ["--env", "BulletArm/OpenLoopBlockStacking-v0", "--env-kwargs", "num_objects:2"]
    assert main(["record", "--expert", *words, "-n", "1", "-o", str(video)]) == 0
    assert len(iio.imread(video)) > 10  # of two actions, whose motion is shown
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{'agent' * 50}.gif", "expert.mp4"]


def test_images_have_fixed_scales():
    """The surface stays dark while the gripper moves, and a pixel of another image keeps its value."""
    with closing(gymnasium.make("BulletArm/CloseLoopBlockPicking-v0", obs_size=32)) as env:
        env.reset(seed=0)
        for height in (0.0, 1.0):
            observation, *_ = env.step(np.array([1, 0, 0, height, 0], np.float32))
            (image,) = observed_images(observation, env)
            assert np.median(image) == pytest.approx(0.0, abs=0.01) and 0.2 < image.max() <= 1.0
    generic = gymnasium.make("CartPole-v1")
    generic.observation_space = spaces.Box(0.0, 0.4, (1, 8, 8))
    (image,) = observed_images(np.full((1, 8, 8), 0.1, np.float32), generic)
    assert image == pytest.approx(np.full((8, 8), 0.25))


def test_the_commit_is_that_of_the_running_code(tmp_path, monkeypatch):
    def git(*words):
        who = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        command = ["git", "-C", str(tmp_path), *who, *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    (code := tmp_path / "provenance.py").write_text("1")
    monkeypatch.setattr(provenance, "HERE", code)
    commit = provenance.commit.__wrapped__
    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "another repository, in whose folder the package lies")
    assert commit().startswith("version ")
    git("add", ".")
    git("commit", "-q", "-m", "ours")
    ours = git("rev-parse", "--short=7", "HEAD")
    assert commit() == ours
    code.write_text("2")
    assert commit() == f"{ours}-dirty"


SMALL_IMAGES = ["--env-kwargs", "obs_size:48"]


@pytest.fixture(scope="module")
def picking(tmp_path_factory):
    """A file of two episodes."""
    path = tmp_path_factory.mktemp("demos") / "picking.h5"
    assert main(["demos", "--env", PICKING, "-n", "2", "--seed", "3", "-o", str(path), *SMALL_IMAGES]) == 0
    return path


def train(folder, data, *more):
    names = ["--baseline", "sacfd", "--preset", "cpu", "--env", PICKING, "--device", "cpu", "-f", str(folder)]
    tiny = ["-n", "4", "--eval-freq", "0", "--num-threads", "1", "--no-progress"]
    params = ["-params", f"expert_data:{data}", "pretrain_steps:2", "batch_size:4", "buffer_size:100"]
    return main(["train", *names, *tiny, *more, *params])


def test_a_file_is_written_and_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["--env", "BulletArm/OpenLoopBlockStacking-v0", "--planner", "deconstruction", "-n", "1"]
    words += ["-f", "files", "--env-kwargs", "num_objects:2"]
    assert main(["demos", *words]) == 0
    printed, name = capsys.readouterr().out, "OpenLoopBlockStacking-v0-deconstruction.h5"
    assert "1 of 1 attempts succeeded, mean_length=2.00" in printed
    assert printed.endswith(f"Written:\n  files/{name}\n")
    assert [path.name for path in (tmp_path / "files").iterdir()] == [name]
    assert len(load(tmp_path / "files" / name)[0]) == 2


def test_a_training_starts_with_the_file_and_resumes_without_it(picking, tmp_path, capsys):
    (file := tmp_path / "picking.h5").write_bytes(picking.read_bytes())
    assert train(tmp_path, file, *SMALL_IMAGES, "--save-freq", "4") == 0
    assert "expert episodes" not in capsys.readouterr().err
    [run] = tmp_path.glob("sacfd/*")
    assert str(file) in (run / "hyperparams.yml").read_text()
    file.unlink()
    assert main(["train", "--resume", str(run), "-n", "6", "--no-progress"]) == 0


def test_demonstrations_of_another_environment_are_refused(picking, tmp_path, capsys):
    for more, texts in (
        ([], ("'obs_size': 48", "'obs_size': 64")),
        ([*SMALL_IMAGES, "--env", REACHING], (PICKING, REACHING)),
        ([*SMALL_IMAGES, "--env-kwargs", "max_steps:9"], ("'max_steps': 50", "'max_steps': 9")),
        ([*SMALL_IMAGES, "--env-kwargs", "action_sequence:xyzrp"], ("'pxyzr'", "'xyzrp'")),
        ([*SMALL_IMAGES, "--env-kwargs", "surface:ramp"], ("'surface': 'flat'", "'surface': 'ramp'")),
    ):
        assert train(tmp_path, picking, *more) == 2
        message = capsys.readouterr().err
        assert all(text in message for text in texts)
    assert not list(tmp_path.iterdir())
    assert train(tmp_path, picking, *SMALL_IMAGES, "--env", REACHING, "--allow-mismatched-demos") == 0


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "hollow"])
def test_a_damaged_file_is_named(damage, picking, tmp_path, capsys):
    content = picking.read_bytes()
    (file := tmp_path / "damaged.h5").write_bytes({"cut": content[:5000], "empty": b""}.get(damage, content))
    if damage == "flipped":
        with h5py.File(file) as opened:
            start = opened["episodes/0/observations/heightmap"].id.get_chunk_info(0).byte_offset
        file.write_bytes(content[:start] + bytes(100) + content[start + 100 :])
    if damage == "hollow":
        with h5py.File(file, "a") as opened:
            del opened["about"], opened["episodes/0/actions"]
            opened["about"] = "{}"
    assert train(tmp_path, file, *SMALL_IMAGES) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert str(file) in line


def test_a_killed_collection_leaves_nothing(tmp_path):
    words = ["demos", "--env", PICKING, "-n", "100000", "-P", *SMALL_IMAGES, "-o", str(tmp_path / "a.h5")]
    command = [sys.executable, "-m", "zoo_configs.cli", *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, cwd=ROOT) as process:
        printed = b""
        while not re.search(rb"[1-9]\d*/100000 ", printed):
            character = process.stderr.read(1)
            assert character, printed
            printed += character
        process.kill()
    assert not list(tmp_path.iterdir())
