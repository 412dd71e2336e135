"""Hyperparameters of experiments: the golden file, the paper's numbers, the order of merging, the flags."""

import inspect
import os
from collections import UserDict, UserList
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from sweeps import ALL

from bulletarm_gym.benchmarks import BENCHMARKS
from bulletarm_gym.config import Context, EnvConfig
from bulletarm_gym.registry import TASKS
from sb3_extensions.encoders.cnn import plan_stages
from zoo_configs.algorithms import OTHERS, algorithm_classes
from zoo_configs.cli import main
from zoo_configs.errors import CommandError
from zoo_configs.experiments.config import ExperimentConfig, explained_yaml, merge, resolve
from zoo_configs.experiments.families import families, parse_family
from zoo_configs.experiments.flags import find_experiment
from zoo_configs.files import Dumper, format_yaml, parse_yaml, read_yaml
from zoo_configs.parsers import parse_train
from zoo_configs.training.objects import EVALUATED, parsed
from zoo_configs.training.validation import check_experiment

GOLDEN_FILE = Path(__file__).with_name("golden_experiments.yml")
WRITE = "WRITE_GOLDEN_EXPERIMENTS"
"""Environment variable with which this test writes the file, for its keys, instead of comparing with it."""
CLOSED_LOOP, _ = families()
OWN_SENSOR = '[{"name":"own","sensor":"bulletarm_gym.observations.sensor:JointState"}]'
"""Sensor by its import path, as one of a user's, that returns no image."""
PICKING, STACKING = "BulletArm/CloseLoopBlockPicking-v0", "BulletArm/OpenLoopBlockStacking-v0"


def experiment_of(line):
    """Return the experiment that flags of ``train`` name."""
    line = line.replace("PICKING", PICKING).replace("STACKING", STACKING)
    return find_experiment(parse_train(line.split()))


def hyperparams_of(*names):
    return resolve(*names).hyperparams


def resolved(baseline, preset, task, benchmark=None):
    """Return all values of an experiment."""
    found = resolve(baseline, preset, f"BulletArm/{task}-v0", benchmark=benchmark)
    return {"algo": found.algo, "flags": found.flags, "hyperparams": found.hyperparams}


def test_resolved_experiments_equal_the_golden_file():
    """
    A changed value is a readable diff. Values of the preset "paper" are those of the paper's appendix
    "Benchmark Details", with Polyak averaging and update schedule as in the authors' code.
    """
    golden = yaml.safe_load(GOLDEN_FILE.read_text(encoding="utf-8"))
    found = {names: resolved(*names.split()) for names in golden}
    if os.environ.get(WRITE):
        text = yaml.dump(found, Dumper=Dumper, default_flow_style=None, width=110)
        GOLDEN_FILE.write_text(text, encoding="utf-8")
        return
    assert found == golden and {names.split()[0] for names in golden} >= CLOSED_LOOP.baselines.keys()


def test_the_paper_preset_has_the_default_arguments_of_the_algorithms():
    """Except for augmentations, and for learners without imitation."""
    different, empty = set(), inspect.Parameter.empty
    for names in (names for names in ALL if names[1] == "paper" and names[2] in (PICKING, STACKING)):
        experiment = resolve(*names)
        signatures = map(inspect.signature, reversed(algorithm_classes()[experiment.algo].__mro__[:-1]))
        defaults = {name: value.default for one in signatures for name, value in one.parameters.items()}
        for name, value in experiment.hyperparams.items():
            different |= set() if defaults.get(name) in (value, None, empty) else {name}
    assert different == {"augmentation", "bc_weight"}
    open_loop = hyperparams_of("sdqfd_fcn", "paper", STACKING)
    shares = {"expert_fraction": 0.5, "balanced_from": open_loop["batch_size"] // 2}
    assert open_loop["replay_buffer_kwargs"] == {"sampler": {"shares": shares}}


def test_every_experiment_is_valid():
    for names in ALL:
        check_experiment(resolve(*names))
    check_experiment(resolve("sdqfd_fcn", "cpu", STACKING, {"augmentation": "rigid_motion"}))


def time_limit(env_id):
    """Return the maximum number of steps of an environment without making it."""
    parameters = dict(gym.spec(env_id).kwargs)
    task, control, surface = (parameters.pop(name) for name in ("task", "control", "surface"))
    defaults = parameters.pop("defaults", {})
    return EnvConfig.of(Context(control, TASKS.find(task).defaults, surface), parameters, defaults).max_steps


def test_buffers_hold_all_demonstrations():
    """Even if each is as long as the time limit, with room for the agent's transitions."""
    for names in ALL:
        hyperparams = hyperparams_of(*names)
        needed = hyperparams.get("expert_episodes", 0) * (time_limit(names[2]) + 1)
        assert hyperparams["buffer_size"] >= needed + 100, names


def test_values_of_other_libraries_become_plain_data():
    """Hydra passes mappings and sequences that are no dicts and lists; NumPy's numbers are no floats."""
    env_kwargs = UserDict(workspace=np.eye(3, 2), observation=UserList(["state", UserDict(name="rgb")]))
    given = {"gamma": np.float64(0.5), "env_kwargs": env_kwargs, "expert_data": Path("a.h5")}
    expected = {
        "gamma": 0.5,
        "env_kwargs": {"workspace": np.eye(3, 2).tolist(), "observation": ["state", {"name": "rgb"}]},
        "expert_data": "a.h5",
    }
    experiment = ExperimentConfig("sacfd", PICKING, given)
    for found in (experiment, experiment.overridden(UserDict(given))):
        assert yaml.safe_load(format_yaml(found.hyperparams)) == expected == found.hyperparams


def test_a_value_that_no_file_can_have_is_refused():
    experiment = resolve("equi_sacfd", "cpu", PICKING, {"policy_kwargs": {"activation_fn": len}})
    with pytest.raises(CommandError, match=r"policy_kwargs .*built-in function len"):
        check_experiment(experiment)


def test_the_cpu_preset_has_the_budget_of_the_paper_and_one_set_of_hyperparameters():
    """At most 100 demonstrations, and 10,000 updates of five environment steps, no DAgger."""
    tasks = [row.env_id for row in BENCHMARKS["close_loop_4d"].environments]
    for name in (name for name in CLOSED_LOOP.baselines if "fd" in name):
        found = [hyperparams_of(name, "cpu", env_id) for env_id in tasks]
        for each in found:
            assert (each["n_timesteps"] // each["n_envs"]) + each["pretrain_steps"] <= 10_000
            assert each["expert_episodes"] <= 100 and each["gamma"] == 0.99
            assert each["expert_noise"] == 0.1 and "callback" not in each
        if name == "equi_sacfd":
            assert all({**each, "n_timesteps": 0} == {**found[0], "n_timesteps": 0} for each in found)


def test_layers_have_a_fixed_order():
    """The order of the keys in a file does not matter."""
    values = [{"set": {"gamma": number / 10}} for number in range(9)]
    tasks = {"tasks": {"Toy": {**values[7], "networks": {"cnn": values[8]}}}}
    content = {
        "envs": "*",
        "baselines": {"sacfd": ["sacfd", "cnn"], "rad_sac": ["sac", "cnn", "rad"]},
        "presets": {
            "cpu": {**tasks, "additions": {"rad": values[6]}, "networks": {"cnn": values[5]}, **values[4]}
        },
        "tasks": {"Toy": values[3]},
        "learners": {"sac": values[2]},
        "networks": {"cnn": values[1]},
        "defaults": [values[0]],
    }
    family = parse_family("mine", yaml.safe_dump(content, sort_keys=False))
    layers = list(family.layers("rad_sac", "cpu", "Any/Toy-v0", None))
    assert [layer.values["hyperparams"]["gamma"] for layer in layers[1:]] == [
        number / 10 for number in range(9)
    ]
    assert layers[-1].source == "mine.yml, presets.cpu.tasks.Toy.networks.cnn"
    other = list(family.layers("sacfd", "cpu", "Any/Other-v0", None))
    assert [layer.values["hyperparams"]["gamma"] for layer in other[1:]] == [0.0, 0.1, 0.4, 0.5]
    family = parse_family("mine", yaml.safe_dump({**content, "defaults": {"sets": {}}}))
    with pytest.raises(CommandError, match="'sets', did you mean 'set'"):
        list(family.layers("sacfd", "cpu", PICKING, None))


def test_overrides_are_merged_last_and_shared_with_nothing():
    overrides = {"learning_rate": 0.5, "env_kwargs": {"action_sequence": "xyzp"}}
    hyperparams = hyperparams_of("equi_sacfd", "cpu", PICKING, overrides)
    assert hyperparams["learning_rate"] == 0.5
    assert hyperparams["env_kwargs"].items() >= {"action_sequence": "xyzp", "obs_size": 64}.items()
    assert hyperparams["policy_kwargs"]["action_sequence"] == "xyzp"  # it follows the environment
    hyperparams["env_kwargs"]["obs_size"] = 1
    assert hyperparams_of("equi_sacfd", "cpu", PICKING)["env_kwargs"]["obs_size"] == 64
    assert merge({"a": {"b": [1], "c": 2}}, {"a": {"b": [3]}}) == {"a": {"b": [3], "c": 2}}


@pytest.mark.parametrize("size", [16, 48, 64, 224])
@pytest.mark.parametrize("baseline", ["sacfd", "equi_sacfd"])
def test_presets_fit_the_image_size(baseline, size):
    experiment = resolve(baseline, "cpu", PICKING, {"env_kwargs": {"obs_size": size}})
    check_experiment(experiment)
    encoder = experiment.hyperparams["policy_kwargs"]["features_extractor_kwargs"]
    plan_stages(size, len(encoder["channels"]), encoder["strided"])
    own = hyperparams_of(baseline, "cpu", PICKING)["policy_kwargs"]["features_extractor_kwargs"]
    assert set(encoder["channels"]) == set(own["channels"]) and (size != 64 or encoder == own)


def test_a_dry_run_prints_every_value_with_its_source(capsys):
    line = f"--env {PICKING} --baseline drq_sacfd --preset paper -n 7 -params tau:1e-2 callback:None"
    assert main(["train", "--dry-run", *line.split()]) == 0
    printed = capsys.readouterr().out
    content, experiment = parse_yaml(printed), experiment_of(line)
    assert content[PICKING] == experiment.hyperparams and content[PICKING]["augmentation"]["drq"]["pad"] == 4
    assert content[PICKING]["tau"] == 0.01 and content["options"]["n_timesteps"] == 7
    assert all("  # " in line or line.endswith(":") for line in printed.splitlines())
    lines = {line.split(":")[0].strip(): line for line in printed.splitlines()}
    assert lines["pad"].endswith("# close_loop.yml, presets.paper.additions.drq")
    assert "defaults" in lines["gamma"] and "appendix" in lines["gamma"]
    assert "bulletarm_gym.benchmarks" in lines["expert_episodes"]
    assert all("command line" in lines[name] for name in ("tau", "callback", "n_timesteps"))


def test_a_dry_run_names_the_file_of_a_value(tmp_path):
    (file := tmp_path / "own.yml").write_text(
        "default: {n_timesteps: 9, policy: P, env_kwargs: {g: 9.0, h: 1}}"
    )
    line = f"--env Pendulum-v1 --algo sac --conf-file {file} --env-kwargs h:2"
    printed = explained_yaml(experiment_of(line), {}, {})
    sources = {line.split(":")[0].strip(): line.partition("  # ")[2] for line in printed.splitlines()}
    assert sources["g"] == sources["n_timesteps"] == str(file) and sources["h"] == "command line"


@pytest.mark.parametrize(
    ("line", "baseline"),
    [
        ("ferm --env PICKING", "ferm_sacfd"),
        ("tqcfd --env PICKING", "tqcfd"),
        ("sac --env PICKING", "sac"),
        ("spatial_dqn --env STACKING", "dqn_equi_asr"),
        ("sdqfd --env STACKING", "sdqfd_equi_asr"),
        ("adet --env STACKING --benchmark open_loop_2d", "adet_equi_fcn"),
        ("dqfd --env BulletArm/OpenLoopBlockSorting-v0", "dqfd_equi_asr"),
        ("dqfd --env BulletArm/OpenLoopRampBlockStacking-v0", "dqfd_equi_deictic_asr"),
    ],
)
def test_an_algorithm_alone_selects_a_baseline_that_serves_the_task(line, baseline):
    assert experiment_of(f"--algo {line}").baseline == baseline


@pytest.mark.parametrize("algo", ["ppo", "a2c", "sac", "td3", "ddpg", "tqc", "trpo"])
def test_stock_algorithms_have_a_policy_for_our_observations(algo):
    experiment = experiment_of(f"--algo {algo} --env STACKING --env-kwargs obs_size:32")
    check_experiment(experiment)
    extractor = experiment.hyperparams["policy_kwargs"]["features_extractor_class"]
    assert experiment.hyperparams["policy"] == "MultiInputPolicy" and extractor.endswith(".CnnExtractor")
    for more, policy in (
        ("STACKING --env-kwargs observation:[holding]", "MultiInputPolicy"),
        (f"STACKING --env-kwargs observation:{OWN_SENSOR}", "MultiInputPolicy"),
        ("Pendulum-v1", "MlpPolicy"),
        ("STACKING -params policy:CnnPolicy", "CnnPolicy"),
    ):
        found = experiment_of(f"--algo {algo} --env {more}").hyperparams
        assert found["policy"] == policy and "policy_kwargs" not in found


def test_files_of_rl_zoo3_are_valid():
    for path in Path(pytest.importorskip("rl_zoo3").__file__).parent.glob("hyperparams/*.yml"):
        sections = read_yaml(path)
        if path.stem in OTHERS and "CartPole-v1" in sections:
            check_experiment(experiment_of(f"--algo {path.stem} --env CartPole-v1 --conf-file {path}"))
        for values in sections.values():
            parsed({key: value for key, value in values.items() if key in EVALUATED})


def test_values_are_yaml_of_version_1_2():
    line = "--algo ppo --env Pendulum-v1 -params a:1e-3 b:no c:12:30 d:[1,x] e:None f:[010,1_000]"
    values = {"a": 0.001, "b": "no", "c": "12:30", "d": [1, "x"], "e": None, "f": [10, 1000]}
    assert experiment_of(f"{line} --env-kwargs g:panda").overrides == {**values, "env_kwargs": {"g": "panda"}}
