"""Baseline, preset and id resolve to one valid set of hyperparameters, or to a clear error."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest
import yaml

from bulletarm_gym.benchmarks import BENCHMARKS
from sb3_extensions.common.env_metadata import constructor_keys
from sb3_extensions.encoders.cnn import plan_stages
from sb3_extensions.replay.sampling import PrioritizedSampler, make_sampler
from sb3_extensions.spatial_dqn.codec import SpatialActionCodec
from zoo_configs.commands.train import build_parser
from zoo_configs.environments import make_env, our_env_ids, register_environments
from zoo_configs.errors import CommandError, nearest_name
from zoo_configs.experiments.config import ExperimentConfig, explain, merge, resolve
from zoo_configs.experiments.explanation import explained_yaml
from zoo_configs.experiments.flags import find_experiment
from zoo_configs.experiments.rules import Case, Family, families, family_of, parse_family, task_name
from zoo_configs.experiments.validation import check_experiment
from zoo_configs.training.objects import import_classes
from zoo_configs.training.options import TrainingOptions
from zoo_configs.yaml_files import parse_yaml

register_environments()
EXPERIMENTS = [
    (baseline, preset, env_id)
    for env_id in our_env_ids()
    for family in families()
    if family.serves(env_id)
    for baseline, row in family.baselines.items()
    for preset in family.presets
    if any(
        row.network in networks and env_id in {row.env_id for row in BENCHMARKS[benchmark].environments}
        for benchmark, networks in family.benchmarks.items()
    )
]
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
CLOSE_LOOP = [row.env_id for row in BENCHMARKS["close_loop_4d"].environments]


def experiment_of(*words: str) -> ExperimentConfig:
    """The experiment that the flags of ``train`` name."""
    args = build_parser().parse_args(words)
    return find_experiment(args, args.env)


@pytest.mark.parametrize("experiment", EXPERIMENTS, ids="-".join)
def test_every_experiment_is_valid(experiment: tuple[str, str, str]) -> None:
    check_experiment(resolve(*experiment))


@pytest.mark.parametrize("env_id", our_env_ids())
def test_buffers_hold_all_demonstrations(env_id: str) -> None:
    """Be each as long as the time limit: they stay, and what the agent does needs room beside them."""
    with closing(make_env(env_id, {})) as env:
        limit = env.unwrapped.config.max_steps  # type: ignore[attr-defined]
    for baseline, preset, _ in (experiment for experiment in EXPERIMENTS if experiment[2] == env_id):
        hyperparams = resolve(baseline, preset, env_id).hyperparams
        needed = hyperparams.get("expert_episodes", 0) * (limit + 1)
        assert hyperparams["buffer_size"] >= needed + 100, (baseline, preset)


def test_the_paper_preset_is_the_papers() -> None:
    """Appendix "Benchmark Details", Close-Loop Benchmark; Polyak and update schedule as its authors' code."""
    experiment = resolve("equi_sacfd", "paper", PICKING)
    expected = {
        "learning_rate": 1e-3,
        "ent_coef": "auto_0.01",
        "target_entropy": "auto",
        "gamma": 0.99,
        "batch_size": 64,
        "buffer_size": 100_000,
        "n_envs": 5,
        "expert_episodes": 100,
        "tau": 0.01,
        "train_freq": 1,
        "gradient_steps": 1,
        "n_timesteps": 5 * 10_000,
        "bc_weight": 1.0,
    }
    additions = {"n_steps", "bc_limit", "exploration", "backup_entropy", "pretrain_steps", "value_range"}
    assert not additions & experiment.hyperparams.keys()  # their defaults are the paper's
    assert {key: experiment.hyperparams[key] for key in expected} == expected
    assert experiment.hyperparams["env_kwargs"]["obs_size"] == 128
    assert experiment.flags["eval_freq"] == 5 * 500
    assert experiment.flags["eval_episodes"] == 100


def test_the_cpu_preset_keeps_to_the_papers_budget_with_one_set_of_hyperparameters() -> None:
    """At most 100 demonstrations without noise, 10,000 updates of five environment steps each, no DAgger."""
    experiments = [
        resolve(baseline, "cpu", env_id).hyperparams
        for env_id in CLOSE_LOOP
        for baseline in family_of(PICKING).baselines
        if "fd" in baseline
    ]
    for experiment in experiments:
        assert experiment["expert_episodes"] <= 100
        assert (experiment["n_timesteps"] // experiment["n_envs"]) + experiment["pretrain_steps"] <= 10_000
        assert "expert_noise" not in experiment and "callback" not in experiment
        assert experiment["gamma"] == 0.99
    one_baseline = [resolve("equi_sacfd", "cpu", env_id).hyperparams for env_id in CLOSE_LOOP]
    for experiment in one_baseline:
        experiment.pop("n_timesteps")
        assert experiment == one_baseline[0]


@pytest.mark.parametrize("baseline", [name for name in family_of(PICKING).baselines if "equi" in name])
def test_the_cpu_preset_shows_equivariant_networks_the_angles_between_quarter_turns(baseline: str) -> None:
    hyperparams = resolve(baseline, "cpu", PICKING).hyperparams
    assert hyperparams["policy_kwargs"]["features_extractor_kwargs"]["n"] == 4
    assert "rotation" in hyperparams["augmentation"]


def test_the_cpu_preset_rotates_samples_for_all_baselines_of_images() -> None:
    for name, baseline in family_of(PICKING).baselines.items():
        augmentation = resolve(name, "cpu", PICKING).hyperparams.get("augmentation", {})
        assert ("rotation" in augmentation) == (baseline.network != "state"), name


@pytest.mark.parametrize(("preset", "weight"), [("paper", 1.0), ("cpu", 3.33), ("quick", 10.0)])
@pytest.mark.parametrize("network", ["", "equi_", "rad_", "drq_", "ferm_"])
def test_only_sacfd_imitates(network: str, preset: str, weight: float) -> None:
    assert resolve(f"{network}sac", preset, PICKING).hyperparams["bc_weight"] == 0
    assert resolve(f"{network}sacfd", preset, PICKING).hyperparams["bc_weight"] == weight


@pytest.mark.parametrize("preset", ["cpu", "quick"])
def test_imitation_is_alike_for_all(preset: str) -> None:
    """What is compared differs in nothing but network, augmentation and buffer."""
    imitating = [name for name in family_of(PICKING).baselines if "fd" in name]
    assert len(imitating) == 9
    experiments = [resolve(name, preset, PICKING).hyperparams for name in imitating]
    names = ("bc_weight", "ent_coef", "self_imitation_temperature", "n_steps", "gamma", "exploration")
    assert len({tuple(experiment.get(name) for name in names) for experiment in experiments}) == 1


def test_a_task_may_say_more_of_policies_and_baselines() -> None:
    house = "BulletArm/CloseLoopHouseBuilding-v0"
    equivariant, plain, unguided = (
        resolve(name, "quick", house).hyperparams for name in ("equi_sacfd", "sacfd", "equi_sac")
    )
    here, there = (
        resolve(name, "quick", PICKING).hyperparams["policy_kwargs"]["features_extractor_kwargs"]
        for name in ("equi_sacfd", "sacfd")
    )
    channels = equivariant["policy_kwargs"]["features_extractor_kwargs"].pop("channels")
    assert channels != here.pop("channels")
    assert equivariant["policy_kwargs"]["features_extractor_kwargs"] == here
    assert plain["policy_kwargs"]["features_extractor_kwargs"] == there
    assert [experiment["bc_weight"] for experiment in (equivariant, plain, unguided)] == [30, 30, 0]


SECTIONS = {
    "envs": "*",
    "baselines": {"sacfd": ["sacfd", "cnn"], "rad_sac": ["sac", "cnn", "rad"]},
    "defaults": {"set": {"gamma": 0.9, "env_kwargs": {"obs_size": 64}}},
    "presets": {"cpu": {"set": {"gamma": 0.8}}},
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"networks": {"ccn": {}}}, "'ccn', did you mean 'cnn'"),
        ({"learners": {"sacdf": {}}}, "'sacdf', .*'sacfd'"),
        ({"additions": {"drq": {}}}, "'drq'"),
        ({"benchmarks": {"open_loop": {}}}, "'open_loop'"),
        ({"network": {"cnn": {}}}, "'network'"),
        ({"defaults": [{"set": {}}, {"sets": {}}]}, "'sets', did you mean 'set'"),
        ({"presets": {"cpu": {"flags": {"eval_frq": 3}}}}, "'eval_frq', did you mean 'eval_freq'"),
        ({"presets": {"cpu": {"tasks": {"Any": {"networks": {"ccn": {}}}}}}}, "'ccn', did you mean 'cnn'"),
        ({"algorithms": {"frem": "sacfd"}}, "'frem', did you mean 'ferm'"),
        ({"algorithms": {"ferm": ["sacdf"]}}, "'sacdf', .*'sacfd'"),
        ({"baselines": {"sac": ["sac"]}}, "'sac' .*additions"),
    ],
)
def test_unknown_names_in_a_file_raise(change: dict[str, Any], message: str) -> None:
    with pytest.raises(CommandError, match=message):
        parse_family("mine", yaml.safe_dump({**SECTIONS, **change}))


def test_layers_have_a_fixed_order() -> None:
    """The order of the keys in a file does not matter."""
    values = [{"set": {"gamma": number / 10}} for number in range(9)]
    tasks = {"tasks": {"Toy": {**values[7], "networks": {"cnn": values[8]}}}}
    preset = {**tasks, "additions": {"rad": values[6]}, "networks": {"cnn": values[5]}, **values[4]}
    content = {
        **SECTIONS,
        "presets": {"cpu": preset},
        "tasks": {"Toy": values[3]},
        "learners": {"sac": values[2]},
        "networks": {"cnn": values[1]},
        "defaults": [values[0]],
    }
    family = parse_family("mine", yaml.safe_dump(content, sort_keys=False))
    layers = list(family.layers(Case("cpu", "Any/Toy-v0", None, family.baselines["rad_sac"])))
    assert [layer.hyperparams["gamma"] for layer in layers[1:]] == [number / 10 for number in range(9)]
    assert layers[-1].source == "mine.yml, presets.cpu.tasks.Toy.networks.cnn"
    other = list(family.layers(Case("cpu", "Any/Other-v0", None, family.baselines["sacfd"])))
    assert [layer.hyperparams["gamma"] for layer in other[1:]] == [0.0, 0.1, 0.4, 0.5]


@pytest.mark.parametrize("family", families(), ids=lambda family: family.name)
def test_every_value_has_a_source(family: Family) -> None:
    env_id = PICKING if family.serves(PICKING) else STACKING
    for baseline, parts in family.baselines.items():
        if parts.network.endswith(("6d", "deictic_asr")):
            continue
        overrides = {"gamma": 0.5, "env_kwargs": {"half_rotation": False} if env_id == STACKING else {}}
        experiment, sources = explain(baseline, "cpu", env_id, overrides)
        assert experiment == resolve(baseline, "cpu", env_id, overrides)
        assert sources["hyperparams.gamma"].source == "command line"
        assert sources["hyperparams.expert_episodes"].source.startswith("bulletarm_gym.benchmarks")
        assert sources["flags.eval_freq"].source.endswith("presets.cpu")
        lines = explained_yaml(experiment, TrainingOptions.of(experiment).plain(), {}).splitlines()
        assert all("  # " in line or line.endswith(":") for line in lines)
        content = parse_yaml("\n".join(lines))
        assert (content["algo"], content[env_id]) == (experiment.algo, experiment.hyperparams)
        assert content["options"] == TrainingOptions.of(experiment).plain()


def test_a_grid_of_actions_lies_over_what_the_environments_range_over() -> None:
    workspace = [[0.3, 0.6], [-0.15, 0.15], [0.01, 0.25]]
    env_kwargs = {"half_rotation": False, "workspace": workspace, "random_orientation": True}
    hyperparams = resolve("sdqfd_equi_asr", "cpu", STACKING, {"env_kwargs": env_kwargs}).hyperparams
    codec = SpatialActionCodec(64, "pxyr", **hyperparams["policy_kwargs"]["codec_kwargs"])
    assert codec.workspace_size == pytest.approx(0.3)
    pick = codec.decode(np.array([[32, 32, 8]]), np.array([False]))[0]
    # Where half a turn is none, -1 and 1 are half a turn to either side (docs/environments.md)
    assert pick[3] * np.pi == pytest.approx(8 * np.pi / codec.shape[2])
    given = {"env_kwargs": env_kwargs, "policy_kwargs": {"codec_kwargs": {"theta_bounds": [-4.0, 4.0]}}}
    hyperparams = resolve("sdqfd_equi_asr", "cpu", STACKING, given).hyperparams
    assert hyperparams["policy_kwargs"]["codec_kwargs"]["theta_bounds"] == [-4.0, 4.0]
    plain = resolve("sdqfd_equi_asr", "cpu", STACKING).hyperparams
    assert plain["policy_kwargs"]["codec_kwargs"] == {}


@pytest.mark.parametrize("family", families(), ids=lambda family: family.name)
def test_an_algorithm_alone_stands_for_a_baseline_of_its_own(family: Family) -> None:
    assert family.algorithms
    for algo in family.algorithms:
        for env_id in filter(family.serves, our_env_ids()):
            experiment = experiment_of("--algo", algo, "--env", env_id)
            assert experiment.algo == algo and experiment.baseline in family.algorithms[algo]


@pytest.mark.parametrize(
    ("words", "baseline"),
    [
        (["ferm", "--env", PICKING], "ferm_sacfd"),
        (["tqcfd", "--env", PICKING], "tqcfd"),
        (["sac", "--env", PICKING], "sac"),
        (["spatial_dqn", "--env", STACKING], "dqn_equi_asr"),
        (["sdqfd", "--env", STACKING], "sdqfd_equi_asr"),
        (["adet", "--env", STACKING, "--benchmark", "open_loop_2d"], "adet_equi_fcn"),
        (["dqfd", "--env", "BulletArm/OpenLoopBlockSorting-v0"], "dqfd_equi_asr"),
        (["dqfd", "--env", "BulletArm/OpenLoopRampBlockStacking-v0"], "dqfd_equi_deictic_asr"),
        (["spatial_dqn", "--env", "BulletArm/OpenLoopBumpBoxPalletizing-v0"], "dqn_equi_deictic_asr"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_the_baseline_of_an_algorithm_serves_the_task(words: list[str], baseline: str) -> None:
    assert experiment_of("--algo", *words).baseline == baseline


def test_the_name_of_a_task() -> None:
    assert task_name(PICKING) == "CloseLoopBlockPicking"
    assert task_name("Pendulum-v1") == "Pendulum"


@pytest.mark.parametrize(("preset", "obs_size", "size"), [("paper", 142, 128), ("cpu", 71, 64)])
@pytest.mark.parametrize("baseline", ["rad_sac", "rad_sacfd", "ferm_sac", "ferm_sacfd"])
def test_crops_are_in_the_papers_proportion(baseline: str, preset: str, obs_size: int, size: int) -> None:
    hyperparams = resolve(baseline, preset, PICKING).hyperparams
    assert hyperparams["env_kwargs"]["obs_size"] == obs_size
    assert hyperparams["augmentation"]["rad"] == {"size": size}


@pytest.mark.parametrize("preset", ["cpu", "paper"])
def test_prioritized_replay_is_the_papers(preset: str) -> None:
    """Exponents and bonus of the appendix "Benchmark Details"; four of five samples are rotated."""
    hyperparams = resolve("equi_sacfd_per_aug", preset, PICKING).hyperparams
    sampler = make_sampler(hyperparams["replay_buffer_kwargs"]["sampler"])
    assert isinstance(sampler, PrioritizedSampler)
    assert (sampler.exponent, sampler.beta_start, sampler.expert_bonus) == (0.6, 0.4, 1.0)
    assert hyperparams["augmentation"] == {"rotation": {"probability": 0.8}}


def test_overrides_win_and_merge() -> None:
    overrides = {"learning_rate": 0.5, "env_kwargs": {"action_sequence": "pxyz"}}
    hyperparams = resolve("equi_sacfd", "cpu", PICKING, overrides).hyperparams
    assert hyperparams["learning_rate"] == 0.5
    assert hyperparams["env_kwargs"].items() >= {"action_sequence": "pxyz", "obs_size": 64}.items()


def test_the_policy_follows_the_action_sequence() -> None:
    overrides = {"env_kwargs": {"action_sequence": "xyzp"}}
    hyperparams = resolve("equi_sacfd_per_aug", "cpu", PICKING, overrides).hyperparams
    assert hyperparams["policy_kwargs"]["action_sequence"] == "xyzp"


def test_experiments_share_nothing() -> None:
    resolve("sacfd", "cpu", PICKING).hyperparams["env_kwargs"]["obs_size"] = 1
    assert resolve("sacfd", "cpu", PICKING).hyperparams["env_kwargs"]["obs_size"] == 64


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("equi_sacdf", "cpu", PICKING), "unknown baseline 'equi_sacdf', did you mean 'equi_sacfd'?"),
        (("sacfd", "papre", PICKING), "unknown preset 'papre', did you mean 'paper'?"),
        (("sacfd", "cpu", "CartPole-v1"), "no baselines for 'CartPole-v1'"),
    ],
)
def test_unknown_names_are_told(names: tuple[str, str, str], message: str) -> None:
    with pytest.raises(CommandError) as error:
        resolve(*names)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            {"learnin_rate": 1},
            "unknown hyperparameter of sacfd 'learnin_rate', did you mean 'learning_rate'?",
        ),
        ({"seed": 1}, "unknown hyperparameter of sacfd 'seed'"),
        ({"policy": "EquivarantPolicy"}, "did you mean 'EquivariantPolicy'?"),
        ({"policy": "no_package.Policy"}, "policy 'no_package.Policy' cannot be imported"),
        ({"replay_buffer_kwargs": {"samplr": "uniform"}}, "did you mean 'sampler'?"),
        ({"replay_buffer_kwargs": {"sampler": "priority"}}, "sampler must be None, one of uniform, shares"),
        (
            {"replay_buffer_kwargs": {"gamma": 0.5}},
            "unknown replay_buffer_kwargs of ExpertReplayBuffer 'gamma'",
        ),
        (
            {"replay_buffer_class": "no_package.Buffer"},
            "replay buffer 'no_package.Buffer' cannot be imported",
        ),
        ({"augmentation": "rda"}, "one of rotation, rad, drq, or names"),
        ({"policy_kwargs": {"net_arc": []}}, "did you mean 'net_arch'?"),
        ({"policy_kwargs": {"features_extractor_kwargs": {"chanels": []}}}, "did you mean 'channels'?"),
    ],
)
def test_unknown_keys_are_told(overrides: dict[str, object], message: str) -> None:
    with pytest.raises(CommandError) as error:
        check_experiment(resolve("equi_sacfd", "cpu", PICKING, overrides))
    assert message in str(error.value)


def test_missing_keys_are_told() -> None:
    with pytest.raises(CommandError, match="'n_timesteps' is missing"):
        check_experiment(ExperimentConfig("sacfd", PICKING, {"policy": "MultiInputPolicy"}))


def test_merge_copies_and_replaces_lists() -> None:
    base = {"a": {"b": [1], "c": 2}}
    merged = merge(base, {"a": {"b": [3]}})
    assert merged == {"a": {"b": [3], "c": 2}}
    assert base == {"a": {"b": [1], "c": 2}}


def test_constructor_keys_follow_kwargs_to_the_parents() -> None:
    class Parent:
        def __init__(self, deep: int, hidden: int) -> None: ...

    class Child(Parent):
        def __init__(self, top: int, **kwargs: int) -> None: ...

    class Closed(Child):
        def __init__(self, only: int) -> None: ...

    assert constructor_keys(Child) == {"top", "deep", "hidden"}
    assert constructor_keys(Closed) == {"only"}


def test_classes_are_imported_where_a_key_says_class() -> None:
    value = {"extractor_class": "collections.OrderedDict", "name": "collections.OrderedDict"}
    assert import_classes(value)["extractor_class"].__name__ == "OrderedDict"
    assert import_classes(value)["name"] == "collections.OrderedDict"


def test_nearest_name_ignores_case() -> None:
    assert nearest_name("bulletarm/closeloopblockpicking-v0", [PICKING, "CartPole-v1"]) == PICKING
    assert nearest_name("qqq", [PICKING]) is None


def test_family_of_an_id() -> None:
    assert family_of(PICKING).name == "close_loop"
    assert np.isin(["sac", "equi_sac", "sacfd", "equi_sacfd"], list(family_of(PICKING).baselines)).all()


@pytest.mark.parametrize("algo", ["ppo", "a2c", "sac", "td3", "ddpg", "tqc", "trpo"])
def test_stock_algorithms_take_a_policy_for_images_on_our_ids(algo: str) -> None:
    for size in (128, 64, 32):
        experiment = experiment_of("--algo", algo, "--env", STACKING, "--env-kwargs", f"obs_size:{size}")
        check_experiment(experiment)
        assert experiment.hyperparams["policy"] == "MultiInputPolicy"
        extractor = experiment.hyperparams["policy_kwargs"]
        assert extractor["features_extractor_class"].endswith(".CnnExtractor")


def test_stock_algorithms_take_no_extractor_for_images_on_states() -> None:
    words = ["--algo", "ppo", "--env", PICKING, "--env-kwargs", "observation:'state'"]
    experiment = experiment_of(*words)
    assert (
        experiment.hyperparams["policy"] == "MultiInputPolicy"
        and "policy_kwargs" not in experiment.hyperparams
    )


def test_a_chosen_policy_and_its_arguments_win() -> None:
    words = ["--algo", "ppo", "--env", PICKING, "-params"]
    assert experiment_of(*words, "policy:'CnnPolicy'").hyperparams["policy"] == "CnnPolicy"
    chosen = experiment_of(*words, "policy_kwargs:{'features_extractor_kwargs': {'strided': 2}}").hyperparams
    assert chosen["policy_kwargs"]["features_extractor_kwargs"] == {"strided": 2}
    assert chosen["policy_kwargs"]["features_extractor_class"].endswith(".CnnExtractor")


def test_stock_algorithms_keep_their_policy_on_other_ids() -> None:
    assert experiment_of("--algo", "ppo", "--env", "Pendulum-v1").hyperparams["policy"] == "MlpPolicy"


@pytest.mark.parametrize("size", [16, 32, 48, 64, 84, 128, 224])
@pytest.mark.parametrize("baseline", ["sacfd", "equi_sacfd", "drq_sac"])
def test_presets_fit_the_image_size(baseline: str, size: int) -> None:
    words = ["--baseline", baseline, "--env", PICKING, "--preset", "cpu", "--env-kwargs", f"obs_size:{size}"]
    experiment = experiment_of(*words)
    check_experiment(experiment)
    encoder = experiment.hyperparams["policy_kwargs"]["features_extractor_kwargs"]
    plan_stages(size, len(encoder["channels"]), encoder["strided"])
    own = resolve(baseline, "cpu", PICKING).hyperparams["policy_kwargs"]["features_extractor_kwargs"]
    assert set(encoder["channels"]) == set(own["channels"]) and (size != 64 or encoder == own)


def test_a_fitted_value_has_the_source_of_the_image_size() -> None:
    _, sources = explain("sacfd", "cpu", PICKING, {"env_kwargs": {"obs_size": 128}})
    name = "hyperparams.policy_kwargs.features_extractor_kwargs"
    assert sources[f"{name}.channels"] is sources["hyperparams.env_kwargs.obs_size"]
    assert sources[f"{name}.autocast"].source.startswith("close_loop.yml")


def test_chosen_arguments_of_the_encoder_are_kept() -> None:
    chosen = {"policy_kwargs": {"features_extractor_kwargs": {"strided": 2, "channels": [8, 8, 8, 8]}}}
    experiment = resolve("sacfd", "cpu", PICKING, {"env_kwargs": {"obs_size": 128}, **chosen})
    encoder = experiment.hyperparams["policy_kwargs"]["features_extractor_kwargs"]
    assert (encoder["strided"], encoder["channels"]) == (2, [8, 8, 8, 8])
