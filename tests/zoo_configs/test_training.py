"""Training from Python and by the command line: run folder, logs, repeating, networks of the presets."""

import functools
import io
import os
import sys
import textwrap
import threading
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pandas as pd
import pytest
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from sweeps import TINY, TUNED, same
from toy_env import TOY_ID

from bulletarm_gym.benchmarks import BENCHMARKS
from measure_updates import make_model
from zoo_configs.algorithms import algorithm_classes
from zoo_configs.cli import main
from zoo_configs.drawing.curves import read_training_log
from zoo_configs.drawing.video import PANEL_SIZE
from zoo_configs.environments import register_environments
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import ExperimentConfig, resolve
from zoo_configs.files import write_yaml
from zoo_configs.training.objects import build_vec_env
from zoo_configs.training.options import TrainingOptions
from zoo_configs.training.runs import find_runs, load_run
from zoo_configs.training.state import State
from zoo_configs.training.train import TrainingInterrupted, train_experiment

GOLDEN = Path(__file__).with_name("golden_updates.yml")
"""Certificates of short trainings; the bits depend on processor and versions."""
SHORT = TINY["options"]
REACHING, STACKING = "BulletArm/CloseLoopBlockReaching-v0", "BulletArm/OpenLoopBlockStacking-v0"


class Stop(BaseCallback):
    """Ends a training by an error."""

    def __init__(self, at, error):
        super().__init__()
        self.at, self.error = at, error

    def _on_step(self):
        if self.num_timesteps == self.at:
            raise self.error
        return True


@pytest.fixture
def train(toy_id, tmp_path):
    """Trains the toy: ``train(*callbacks, at=..., seed=..., gamma=..., option=...)`` returns the run."""

    def run(*callbacks, at=None, seed=0, progress=False, **changes):
        options = {name: changes.pop(name) for name in list(changes) if name in SHORT}
        experiment = resolve("sacfd", "quick", toy_id, {**TINY["hyperparams"], **changes})
        chosen = TrainingOptions.of(experiment, {**SHORT, **options})
        folder = None if at is None else tmp_path / at
        more = {"options": chosen, "at": folder, "callbacks": callbacks, "progress": progress}
        return train_experiment(experiment, seed, "cpu", tmp_path, **more)

    return run


def test_trainings_in_a_process_are_independent_and_quiet(train, capsys):
    threads = th.get_num_threads()
    alone, other, again = train(), train(seed=1), train()
    assert same(alone.folder, again.folder) and not same(alone.folder, other.folder)
    assert {run.folder.name[-1] for run in (alone, other, again)} == {"1", "2", "3"}
    assert th.get_num_threads() == threads and capsys.readouterr().out == ""


def test_a_chosen_folder_continues_from_its_checkpoint(train, tmp_path):
    with pytest.raises(RuntimeError, match="pulled"):
        train(Stop(10, RuntimeError("the plug was pulled")), at="there")
    failed = load_run(tmp_path / "there").status
    assert (failed.state, failed.error) == (State.FAILED, "the plug was pulled")
    run = train(at="there")
    assert same(run.folder, train(at="other").folder)
    before = run.last_model.stat().st_mtime_ns
    assert train(Stop(1, RuntimeError("not reached")), at="there").last_model.stat().st_mtime_ns == before
    for changes in {"seed": 1}, {"gamma": 0.5}:
        with pytest.raises(CommandError, match="there"):
            train(at="there", **changes)


def test_work_before_the_first_checkpoint_is_not_counted_twice(train):
    with pytest.raises(RuntimeError, match="pulled"):
        train(Stop(8, RuntimeError("the plug was pulled")), at="there", save_freq=100)
    ours, theirs = (train(at=at, save_freq=100) for at in ("there", "here"))
    assert same(ours.folder, theirs.folder)
    assert pd.read_csv(ours.training_log).equals(pd.read_csv(theirs.training_log))


def test_a_run_that_was_killed_at_its_very_end_is_done(train):
    """Model and last checkpoint exist, but the status does not say that it is done."""
    run, whole = train(at="a"), train(at="b")
    status = run.folder / "state.yml"
    status.write_text(status.read_text().replace("state: done", "state: running"))
    assert run.status.state is State.KILLED
    run.last_model.write_bytes(b"of an earlier interruption")
    assert train(at="a").status.state is State.DONE and same(run.folder, whole.folder)


def test_an_early_failure_leaves_no_folder_and_ctrl_c_a_model(train, tmp_path):
    with pytest.raises(RuntimeError):
        train(Stop(1, RuntimeError("early")), eval_freq=0, save_freq=0, progress=True)
    assert "_RefreshThread" not in {type(thread).__name__ for thread in threading.enumerate()}  # of the bar
    assert not (tmp_path / "sacfd").exists()
    with pytest.raises(TrainingInterrupted) as stop:
        train(Stop(8, KeyboardInterrupt()))
    assert stop.value.run.status.state is State.KILLED and stop.value.run.last_model.is_file()


@pytest.mark.parametrize("algo", ["sacfd", "sac"])
def test_rl_zoo3_evaluates_our_runs(algo, toy_id, tmp_path, monkeypatch):
    enjoy, algos = pytest.importorskip("rl_zoo3.enjoy"), pytest.importorskip("rl_zoo3.utils").ALGOS
    monkeypatch.setitem(algos, algo, algorithm_classes()[algo])
    own = {"policy": "MultiInputPolicy", "env_kwargs": {"obs_size": 48}, "expert_episodes": 2}
    stock = {"policy": "MlpPolicy", "env_kwargs": {"g": 9.0}, "normalize": True}
    env_id, hyperparams = (toy_id, own) if algo == "sacfd" else ("Pendulum-v1", stock)
    hyperparams |= {"buffer_size": 200, "learning_starts": 4, "learning_rate": "lin_1e-3", "n_timesteps": 12}
    experiment = ExperimentConfig(algo, env_id, hyperparams)
    run = train_experiment(experiment, 0, "cpu", tmp_path, options=TrainingOptions(eval_freq=6, verbose=0))
    assert run.statistics_file.is_file() == (algo == "sac")
    words = ["--algo", algo, "--env", env_id, "-f", str(tmp_path), "-n", "20", "--no-render", "--load-best"]
    monkeypatch.setattr(sys, "argv", ["enjoy", *words, "--device", "cpu"])
    enjoy.enjoy()


def test_a_run_folder_is_complete(run_folder, toy_id):
    models = {"BulletArm-CloseLoopToy-v0.zip", "best_model.zip", "checkpoints"}
    tables = {"evaluations.npz", "training.csv", "learning_curve.png", "0.monitor.csv"}
    about = {"hyperparams.yml", "certificate.yml", "state.yml", ".lock", "BulletArm-CloseLoopToy-v0"}
    assert {path.name for path in run_folder.iterdir()} == {*models, *tables, *about}
    content = yaml.safe_load((run_folder / "hyperparams.yml").read_text())
    about = content["run"]
    assert (about["seed"], about["baseline"], about["preset"]) == (0, "equi_sacfd", "quick")
    assert about["versions"]["torch"] == th.__version__ and "cores" in about["machine"]
    assert content[toy_id]["policy"] == "EquivariantPolicy"
    assert content[toy_id]["env_kwargs"] == {"action_sequence": "pxyzr", "obs_size": 48}
    loaded = load_run(run_folder)
    assert (loaded.seed, loaded.experiment.hyperparams) == (0, content[toy_id])
    how = loaded.status
    assert how.state is State.DONE and how.pid == os.getpid() and how.seconds > 0
    assert "is_success" in (run_folder / "0.monitor.csv").read_text().splitlines()[1]
    with np.load(run_folder / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [0, 6, 12]  # the first after pretraining
        assert evaluations["successes"].shape == (3, 2)
    log = read_training_log(run_folder / "training.csv")
    assert log["timesteps"].tolist() == [0, 6, 12]
    assert np.isfinite(log[["value_expert", "entropy_expert", "critic_loss", "bc_loss"]]).all(axis=None)
    for name in ("value_online", "entropy_online"):
        assert np.isfinite(log[name]).tolist() == [False, True, True]
    check_updates("equi_sacfd", run_folder)


def test_evaluation_has_the_parameters_but_not_the_scenes_of_training(train_tiny, tmp_path, toy_envs):
    more = ["expert_episodes:0", "pretrain_steps:0", "--baseline", "sac", "--preset", "quick"]
    assert train_tiny(tmp_path, *more) == 0
    _, *evaluation, training = sorted(toy_envs, key=lambda env: 0 in env.seeds)
    seeds = {seed for env in evaluation for seed in env.seeds if seed is not None}
    assert {env.obs_size for env in toy_envs} == {48} and training.seeds[0] == 0
    assert len(seeds) >= 2 and 0 not in seeds  # new scenes at each evaluation


TRAINING_BAR = "━"


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_bars_are_shown_on_terminals(run_folder, tmp_path, monkeypatch, toy_id):
    words = ["train", "--baseline", "sacfd", "--preset", "quick", "--env", toy_id, "-f", str(tmp_path)]
    words += ["-n", "2", "--eval-freq", "0", "--device", "cpu", *TUNED]
    enjoy = ["enjoy", str(run_folder), "-n", "1", "--device", "cpu"]
    for file, more in (Terminal(), []), (io.StringIO(), []), (silent := Terminal(), ["--no-progress"]):
        monkeypatch.setattr(sys, "stderr", file)
        assert main([*words, *more]) == main([*enjoy, *more]) == 0
        bars = ("expert episodes", "pretraining", TRAINING_BAR, "1/1")
        assert [bar in file.getvalue() for bar in bars] == [file.isatty() and not more] * 4
    assert silent.getvalue() == ""


RAD = ["augmentation:{rad: {size: 48}}", "contrastive_steps:2", "--env-kwargs", "obs_size:53"]


@pytest.mark.parametrize(
    ("baseline", "env_id", "more"),
    [
        ("equi_sacfd_per_aug", TOY_ID, []),
        ("equi_tqcfd", TOY_ID, []),
        ("sacfd_state", REACHING, []),
        ("ferm_sacfd", TOY_ID, RAD),
        ("dqn_cnn_asr", STACKING, []),
        ("adet_cnn_asr", STACKING, []),
        ("dqfd_equi_fcn", STACKING, ["--benchmark", "open_loop_2d"]),
        ("sdqfd_equi_deictic_asr", "BulletArm/OpenLoopRampBlockStacking-v0", []),
    ],
)
def test_a_baseline_trains(baseline, env_id, more, train_tiny, tmp_path):
    words = ["--baseline", baseline, "--env", env_id, "--eval-freq", "0", "--save-freq", "0"]
    if "OpenLoop" in env_id:
        words += ["-n", "6", "--env-kwargs", "num_objects:2", "obs_size:64", "max_steps:4"]
        words += ["-params", "expert_episodes:1", "n_envs:1"]
    assert train_tiny(tmp_path, *more, *words) == 0
    [run] = tmp_path.glob("*/BulletArm-*_1")
    assert main(["enjoy", str(run), "-n", "1", "--device", "cpu"]) == 0
    check_updates(baseline, run)


def check_updates(baseline, run):
    """
    Check that a training has the recorded bits, on a machine like that of the record: then the results in the
    documentation are still valid. Record others with ``WRITE_GOLDEN_UPDATES=1``.
    """
    golden, found = yaml.safe_load(GOLDEN.read_text()), yaml.safe_load((run / "certificate.yml").read_text())
    if "WRITE_GOLDEN_UPDATES" in os.environ:
        write_yaml(GOLDEN, {**golden, baseline: found})
    elif {**found, "checksums": 0} == {**golden[baseline], "checksums": 0}:
        assert found["checksums"] == golden[baseline]["checksums"]


SHORTER = "{gymnasium.wrappers.TimeLimit: {max_episode_steps: 3}}"
WRAPPERS = [f"env_wrapper:[toy_env.without_holding, {SHORTER}]", "normalize:{norm_obs: false}"]
BUFFER = "rollout_buffer_class:stable_baselines3.common.buffers.DictRolloutBuffer"


@pytest.mark.parametrize(
    ("algo", "env_id", "parameters"),
    [
        ("sac", "Pendulum-v1", ["g:9.0", "-params", "learning_starts:4"]),
        (
            "ppo",
            "TOY",
            ["obs_size:48", "-params", "n_steps:8", "batch_size:8", BUFFER, *WRAPPERS],
        ),
        ("ppo_lstm", "Pendulum-v1", ["g:9.0", "-params", "n_steps:8", "batch_size:8"]),
    ],
)
def test_a_stock_algorithm_trains(algo, env_id, parameters, toy_id, tmp_path, capsys):
    named = ["--algo", algo, "--env", env_id.replace("TOY", toy_id), "-f", str(tmp_path), "--device", "cpu"]
    options = ["-n", "8", "--eval-freq", "-1", "--no-progress", "--env-kwargs"]
    assert main(["train", *named, *options, *parameters]) == 0
    assert main(["enjoy", *named, "-n", "1", "--no-progress"]) == 0
    reported = "success_rate=" if env_id == "TOY" else "mean_return=-"
    assert capsys.readouterr().out.splitlines()[-1].startswith(reported)
    if env_id == "TOY":
        assert main(["record", *named, "-n", "1", "-o", str(tmp_path / "toy.gif"), "--no-progress"]) == 0
    [run] = find_runs(tmp_path)
    for path in run.folder.glob("*.monitor.csv"):  # a copied folder need not have them
        path.unlink()
    assert main(["train", "--resume", str(run.folder), "-n", "16", "--no-progress"]) == 0


def test_frames_are_stacked_as_channels(toy_id):
    env = build_vec_env(toy_id, {"frame_stack": 2, "env_kwargs": {"obs_size": 48}}, 1, 0)
    assert {name: space.shape for name, space in env.observation_space.items()} == {
        "heightmap": (2, 48, 48),
        "holding": (2,),
    }


MODULE, OWN_ID = "my_own_tasks", "BulletArm/CloseLoopOwnReaching-v0"
TASKS = """
    import bulletarm_gym
    from bulletarm_gym.tasks.picking import BlockReaching

    class OwnReaching(BlockReaching):
        pass

    def steps(scene, outcome):
        return -1.0

    bulletarm_gym.register_task("OwnReaching", OwnReaching)
"""


def forget():
    """Restore the state of a new process."""
    gym.registry.pop(OWN_ID, None)
    sys.modules.pop(MODULE, None)


@pytest.fixture
def own_tasks(tmp_path, monkeypatch):
    """The working directory, with a module of tasks in it."""
    (tmp_path / f"{MODULE}.py").write_text(textwrap.dedent(TASKS))
    monkeypatch.chdir(tmp_path)
    forget()
    yield tmp_path
    forget()
    sys.path.remove(str(tmp_path))


def test_a_run_stores_the_package_of_its_task(own_tasks, train_tiny, capsys):
    named = ["n_envs:1", "--env", f"{MODULE}:{OWN_ID}", "--baseline", "sacfd", "--env-kwargs", "max_steps:4"]
    assert train_tiny(own_tasks / "logs", *named, "-n", "2", "--eval-freq", "0") == 0
    [run] = (own_tasks / "logs" / "sacfd").iterdir()
    assert yaml.safe_load((run / "hyperparams.yml").read_text())["run"]["gym_packages"] == [MODULE]
    acting = ["-n", "1", "--device", "cpu"]
    assert main(["push", str(run), "--folder", "agent", *acting]) == 0
    assert f"import {MODULE}" in (own_tasks / "agent" / "README.md").read_text()
    for command in (
        ["enjoy", "--published", "agent", *acting],
        ["enjoy", "--env", OWN_ID, "--baseline", "sacfd", *acting],
        ["train", "--resume", str(run), "-n", "4", "--no-progress"],
    ):
        forget()
        assert main(command) == 0, capsys.readouterr().err


def test_commands_import_tasks_and_rewards(own_tasks, capsys):
    words = ["demos", "--env", REACHING, "-n", "1", "--env-kwargs", "obs_size:32"]
    assert main(["list", "--env", OWN_ID, "--gym-packages", MODULE]) == 0
    assert main([*words, f"reward:{MODULE}:stepz"]) == 2
    assert "stepz" in capsys.readouterr().err
    assert main([*words, f"reward:{MODULE}:steps"]) == 0
    forget()
    (own_tasks / f"{MODULE}.py").write_text("def")
    assert main(["enjoy", "--gym-packages", MODULE]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert MODULE in line and "SyntaxError" in line


register_environments()
BLOCKS = "BulletArm/CloseLoopBlockStacking-v0"
RAMP = "BulletArm/OpenLoopRampBlockStacking-v0"
CLOSED_LOOP = ("sacfd", "rad_sac", "ferm_sacfd", "equi_sacfd_per_aug", "equi_tqc", "sacfd_state")
NETWORKS_3D = ("fcn", "equi_fcn", "rot_fcn", "cnn_asr", "equi_asr")
OPEN_LOOP = [
    *((network, STACKING, "open_loop_3d") for network in NETWORKS_3D),
    ("cnn_asr_6d", RAMP, "open_loop_6d"),
    ("equi_deictic_asr", "BulletArm/OpenLoopBumpHouseBuilding4-v0", "open_loop_6d"),
]
UNTRAINED = {"expert_episodes": 0, "pretrain_steps": 0, "buffer_size": 100}


@functools.cache
def real_observations(**env_kwargs):
    """Return the observations while blocks are stacked, (n, ...) each."""
    env = gym.make(BLOCKS, **env_kwargs)
    observations, over = [env.reset(seed=0)[0]], False
    while not over:
        observation, _, terminated, truncated, _ = env.step(env.unwrapped.expert_action())  # type: ignore[attr-defined]
        observations.append(observation)
        over = terminated or truncated
    env.close()
    return {key: th.as_tensor(np.stack([entry[key] for entry in observations])) for key in observations[0]}


@pytest.mark.parametrize("baseline", CLOSED_LOOP)
def test_an_untrained_agent_expects_nothing_and_explores(baseline):
    """Values lie in [0, 1]. In the preset "cpu"; networks of the preset "paper" are not normalised."""
    model = make_model(resolve(baseline, "cpu", BLOCKS), "cpu", **UNTRAINED)
    spaces, observation = model.observation_space.spaces, "state" if baseline.endswith("_state") else "image"
    size = {"obs_size": spaces["heightmap"].shape[-1]} if observation == "image" else {}
    observations = real_observations(observation=observation, **size)
    assert observations.keys() == spaces.keys()
    model.env.close()
    actions = th.rand(len(observations["holding"]), 5, generator=th.Generator().manual_seed(0)) * 2 - 1
    with th.no_grad():
        mean, log_std, _ = model.actor.get_action_dist_params(observations)
        values = th.stack(tuple(model.critic(observations, actions)))
    assert values.isfinite().all() and values.abs().max() <= 1
    assert mean.tanh().abs().max() <= 0.3
    assert 0.5 <= log_std.exp().min() and log_std.exp().max() <= 2
    first = {key: value[0].numpy() for key, value in observations.items()}
    assert model.predict(first, deterministic=True)[0].shape == model.action_space.shape


@pytest.mark.parametrize("preset", ["cpu", pytest.param("paper", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("network", "env_id", "benchmark"), OPEN_LOOP)
def test_an_untrained_spatial_network_expects_nothing(network, env_id, benchmark, preset):
    """Networks of the paper, which need a GPU, are built but not evaluated."""
    experiment = resolve(f"sdqfd_{network}", preset, env_id, benchmark=benchmark)
    model = make_model(experiment, "cpu", **UNTRAINED)
    assert model.policy.action_sequence == BENCHMARKS[benchmark].action_sequence
    if preset == "cpu":
        observations, _ = model.policy.obs_to_tensor(model.env.reset())
        indices, _ = model.q_net.greedy(observations)
        with th.no_grad():
            values = model.q_net.values(observations, indices)
        assert all(level.isfinite().all() and level.abs().max() <= 1 for level in values)
    model.env.close()


def test_a_video_shows_the_values_of_a_spatial_policy(tmp_path):
    model = make_model(resolve("sdqfd_fcn", "cpu", STACKING), "cpu", **UNTRAINED)
    model.save(tmp_path / "model")
    model.env.close()
    words = [str(tmp_path / "model.zip"), "--env", STACKING, "--env-kwargs", "obs_size:64", "in_hand_size:16"]
    video = tmp_path / "video.gif"
    assert main(["record", *words, "max_steps:1", "-n", "1", "-o", str(video), "--device", "cpu"]) == 0
    frames = iio.imread(video)
    assert frames.shape[2] == 4 * PANEL_SIZE  # scene, heightmap, in-hand image, values
    assert len(np.unique(frames[0][:PANEL_SIZE, -PANEL_SIZE:].reshape(-1, 3), axis=0)) > 2
