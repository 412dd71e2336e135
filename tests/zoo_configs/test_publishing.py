"""Published agents: small files, cards and pages, in the package, in a folder or on a hub."""

import json
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from sb3_contrib import RecurrentPPO
from scipy import stats
from stable_baselines3 import SAC
from torch import nn

from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd import SACfD
from zoo_configs.agents import Agent, AgentQuery, find_agent
from zoo_configs.cards import published_agents, read_card
from zoo_configs.cli import main
from zoo_configs.evaluating import EvalOptions, Outcome, evaluate_agent
from zoo_configs.experiments.families import task_name
from zoo_configs.provenance import arithmetic
from zoo_configs.publishing import packing
from zoo_configs.publishing.compact import save_compact, stored_weights
from zoo_configs.recording import agent_actor

FILE = "sacfd-BulletArm-CloseLoopToy-v0.zip"
FILES = {FILE, "card.json", "README.md"}
SNIPPET = re.compile(r"```python\n(.*?)```", re.DOTALL)
AGENTS = {f"{task_name(card.env)}-{card.label}": card for card in published_agents()}
GOALS = dict.fromkeys(("CloseLoopBlockStacking", "CloseLoopHouseBuilding", "CloseLoopObjectGrasping"), 0.85)
GOALS |= dict.fromkeys(("OpenLoopHouseBuilding4", "OpenLoopBinPacking"), 0.8)
GOALS |= dict.fromkeys(("OpenLoopCovidTest", "OpenLoopRampHouseBuilding3"), 0.8)
GOALS |= {"OpenLoopRampImproviseHouseBuilding3": 0.8, "OpenLoopBumpBoxPalletizing": 0.7}
MAX_BYTES, MAX_TOTAL = 1_200_000, 14_500_000
"""Maximum size of a file of a published agent, and of all files: a wheel has at most 15 MB."""
FEW = 4  # episodes
UNLIKELY = 1e-4
every_agent = pytest.mark.parametrize("card", AGENTS.values(), ids=AGENTS)


def test_weights_that_are_too_large_for_float16_are_not_rounded():
    layer = nn.Linear(2, 2)
    assert stored_weights(layer, half=True)["weight"].dtype == th.float16
    nn.init.constant_(layer.weight, 1e6)
    assert {weights.dtype for weights in stored_weights(layer, half=True).values()} == {th.float32}


@pytest.mark.parametrize("scale", [0.0, 1e-3, 1.0, 1e3])
def test_matrices_have_few_values_and_vectors_are_unchanged(scale):
    layer = nn.Linear(64, 64)
    nn.init.normal_(layer.weight, std=scale)
    stored = stored_weights(layer, half=True)
    assert stored["weight"].unique().numel() < 256 and th.equal(stored["bias"], layer.bias)
    assert (stored["weight"].float() - layer.weight).abs().max() <= scale / 8


def make_model(name, toy_id, **more):
    if name == "sac":
        return SAC("MlpPolicy", "Pendulum-v1", seed=0)
    env = gym.make(toy_id, obs_size=48)
    if name == "ferm":
        extractor = {"channels": [4, 8, 8, 8, 8], "features_dim": 6, "autocast": "bf16"}
        kwargs = {"features_extractor_kwargs": extractor, "actor_tau": 0.1, "net_arch": [8]}
        return FERM("MultiInputPolicy", env, seed=0, augmentation="drq", policy_kwargs=kwargs)
    kwargs = {"features_extractor_kwargs": {"n": 4, "channels": [1, 2, 2, 2, 2]}, "actor_tau": None}
    kwargs |= {"shared": {"share_features_extractor": True}, "average": {"actor_tau": 0.1}}.get(name, {})
    return SACfD("EquivariantPolicy", env, policy_kwargs=kwargs, seed=0, **more)


@pytest.mark.parametrize(
    ("name", "half"),
    [("sac", False), *((name, True) for name in ("sac", "sacfd", "shared", "average", "ferm"))],
)
def test_a_loaded_agent_acts_as_before(name, half, toy_id, tmp_path):
    model = make_model(name, toy_id)
    if getattr(model.policy, "actor_average", None) is not None:
        with th.no_grad():  # an average that differs from the weights, as after a training
            for parameter in model.policy.get_submodule("actor").parameters():
                parameter.mul_(1.5)
    types = "bfloat16, float16" if name == "ferm" else "float16"
    assert save_compact(model, tmp_path / "agent.zip", half) == (types if half else "float32")
    save_compact(model, tmp_path / "again.zip", half)
    assert (tmp_path / "agent.zip").read_bytes() == (tmp_path / "again.zip").read_bytes()
    loaded = type(model).load(tmp_path / "agent.zip")
    (space := model.observation_space).seed(0)
    observations = [space.sample() for _ in range(5)]

    def actions(agent):
        return np.array([agent.predict(each, deterministic=True)[0] for each in observations])

    np.testing.assert_allclose(actions(loaded), actions(model), atol=0.1 if half else 0.0)
    model.policy.load_state_dict(stored_weights(model.policy, half))
    np.testing.assert_array_equal(actions(loaded), actions(model))
    assert all(np.isfinite(loaded.predict(each)[0]).all() for each in observations)


def test_a_file_is_small_without_traces_of_the_machine_and_can_be_trained(toy_id, tmp_path):
    schedule = {"learning_rate": lambda progress: 1e-3 * progress, "batch_size": 4}
    model = make_model("sacfd", toy_id, expert_episodes=2, learning_starts=0, pretrain_steps=1, **schedule)
    model.learn(2).save(tmp_path / "whole.zip")
    save_compact(model, tmp_path / "small.zip")
    assert (tmp_path / "small.zip").stat().st_size < (tmp_path / "whole.zip").stat().st_size / 4
    with zipfile.ZipFile(tmp_path / "small.zip") as archive:
        data = archive.read("data").decode()
    assert str(tmp_path) not in data and json.loads(data)["_last_obs"] is None
    loaded = SACfD.load(tmp_path / "small.zip", env=gym.make(toy_id, obs_size=48))
    assert not loaded.actor.optimizer.state_dict()["state"] and loaded.learning_rate == 1e-3
    before = loaded.policy.parameters_to_vector()
    after = loaded.learn(3).policy.parameters_to_vector()
    assert np.isfinite(after).all() and not np.array_equal(before, after)


def check_first_episodes(card, episodes):
    """They end as on the card. On another machine, enough of them succeed for the card's success rate."""
    query = AgentQuery(published=card.env, baseline=card.label, device="cpu")
    options = EvalOptions(episodes, card.test_seed, progress=False)
    successes = evaluate_agent(find_agent(query), options).successes
    if {key: card.measured[key] for key in arithmetic()} == arithmetic():
        assert successes == [outcome == "1" for outcome in card.outcomes[:episodes]]
    assert stats.binom.cdf(sum(successes), episodes, card.interval[0]) > UNLIKELY


def test_agents_are_small_and_listed(capsys):
    sizes = [path.stat().st_size for card in AGENTS.values() for path in card.folder.iterdir()]
    assert max(sizes) < MAX_BYTES and sum(sizes) < MAX_TOTAL
    assert main(["list", "--published"]) == 0
    printed = capsys.readouterr().out
    assert all(card.env in printed for card in AGENTS.values())


@every_agent
def test_an_agent_reaches_its_goal_and_has_its_page(card):
    task = task_name(card.env)
    assert card.model_file.is_file() and card.folder.parts[-2:] == (task, card.label)
    assert card.episodes == 100
    assert card.interval[0] <= card.success == card.outcomes.count("1") / 100 <= card.interval[1]
    assert all(getattr(card, name) for name in ("command", "commit", "date", "machine", "versions"))
    assert card.success >= GOALS.get(task, 0.95 if task.startswith("CloseLoop") else 0.9)
    assert (card.folder / "README.md").read_text(encoding="utf-8") == packing.render_readme(card)


@pytest.mark.parametrize("name", ["CloseLoopBlockReaching-equi_sacfd", "CloseLoopBlockPicking-equi_sacfd"])
def test_first_episodes_end_as_on_the_card(name):
    check_first_episodes(AGENTS[name], FEW)


@pytest.mark.slow
@every_agent
def test_success_is_that_of_the_card(card):
    check_first_episodes(card, card.episodes)


class Hub:
    """Stand-in for ``huggingface_hub.HfApi``."""

    uploaded: ClassVar[dict[str, Any]] = {}
    reachable = True

    def whoami(self):
        if not self.reachable:
            raise ConnectionError("Name or service not known")
        return {"name": "someone"}

    def create_repo(self, repo_id, exist_ok):
        assert exist_ok
        return f"https://huggingface.co/{repo_id}"

    def upload_folder(self, repo_id, folder_path, commit_message):
        files = {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}
        self.uploaded.update(repo_id=repo_id, message=commit_message, files=files)


@pytest.fixture
def hub(monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    monkeypatch.setattr("huggingface_hub.HfApi", Hub)
    monkeypatch.setattr(Hub, "uploaded", {})
    return Hub


@pytest.fixture(scope="module")
def pushed(run_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("agents") / "toy"
    words = ["push", str(run_folder), "--folder", str(folder), "-n", "4", "--device", "cpu"]
    assert main([*words, "--no-progress"]) == 0
    return folder


def test_a_pushed_folder_has_agent_card_and_page(pushed, toy_id):
    assert {path.name for path in pushed.iterdir()} == FILES
    assert [path.name for path in pushed.parent.iterdir()] == ["toy"]
    card = read_card(pushed)
    assert (card.env, card.env_kwargs) == (toy_id, {"action_sequence": "pxyzr", "obs_size": 48})
    assert (card.baseline, card.algo, card.preset) == ("equi_sacfd", "sacfd", "quick")
    assert (card.seed, card.episodes, len(card.outcomes)) == (0, 4, 4)
    assert card.interval[0] <= card.success == card.outcomes.count("1") / 4 <= card.interval[1]
    assert card.evaluations["timesteps"] == [0, 6, 12] and card.versions["torch"]
    assert card.command.startswith("bulletarm-zoo train ") and card.date <= card.measured["date"]
    _, head, _ = (pushed / "README.md").read_text().split("---\n", 2)
    metadata = yaml.safe_load(head)
    assert {toy_id, "reinforcement-learning", "stable-baselines3"} <= set(metadata["tags"])
    [result] = metadata["model-index"][0]["results"]
    measured = {metric["type"]: metric["value"] for metric in result["metrics"]}
    assert measured["success_rate"] == card.success and "+/-" in measured["mean_reward"]


def test_a_pushed_agent_acts_as_that_of_the_run(pushed, run_folder, tmp_path, monkeypatch, capsys):
    printed = []
    for source in ("--published", str(pushed)), (str(run_folder),):
        assert main(["enjoy", *source, "-n", "4", "--device", "cpu"]) == 0
        printed.append(capsys.readouterr().out.splitlines()[-1])
    assert printed[0] == printed[1] == f"success_rate={read_card(pushed).success:.2f} episodes=4"
    video = str(tmp_path / "video.gif")
    assert main(["record", "--published", str(pushed), "-n", "1", "-o", video, "--device", "cpu"]) == 0
    monkeypatch.chdir(pushed)
    [snippet] = SNIPPET.findall((pushed / "README.md").read_text())
    exec(compile(snippet, "README.md", "exec"), {})
    assert capsys.readouterr().out.split()[-1] in ("True", "False")


def test_an_upload_has_the_folder_and_a_video(run_folder, hub, capsys):
    words = ["push", str(run_folder), "-orga", "arms", "-n", "2", "--device", "cpu"]
    assert main(words) == 0
    assert hub.uploaded["repo_id"] == "arms/equi_sacfd-BulletArm-CloseLoopToy-v0"
    assert set(hub.uploaded["files"]) == {*FILES, "replay.mp4"}
    page = hub.uploaded["files"]["README.md"].decode()
    assert f'load_from_hub("{hub.uploaded["repo_id"]}", "{FILE}")' in page
    assert main([*words, "-name", "toy", "--load-last"]) == 0
    assert "https://huggingface.co/arms/toy" in capsys.readouterr().out
    assert json.loads(hub.uploaded["files"]["card.json"])["model"] == "last"


def test_only_the_folder_of_an_agent_is_replaced(pushed, run_folder, tmp_path, refuse):
    shutil.copytree(pushed, folder := tmp_path / "toy")
    (folder / ".git").mkdir()
    assert ".git" in refuse("push", str(run_folder), "--folder", str(folder))
    (folder / ".git").rename(folder / "old.zip")
    assert main(["push", str(run_folder), "--folder", str(folder), "-n", "1", "--device", "cpu"]) == 0
    assert {path.name for path in folder.iterdir()} == FILES and read_card(folder).episodes == 1
    (link := tmp_path / "link").symlink_to(folder)
    assert main(["push", str(run_folder), "--folder", str(link), "-n", "2", "--device", "cpu"]) == 0
    assert link.is_symlink() and read_card(folder).episodes == 2
    assert "'foo'" in refuse("push", str(run_folder), "--folder", "new/agent", "--env-kwargs", "foo:1")
    assert "working directory" in refuse("push", str(run_folder), "--folder", ".")
    assert "an agent" in refuse("push", str(run_folder), "--folder", str(run_folder))
    shutil.copytree(run_folder, copy := tmp_path / "run")
    file = copy / "hyperparams.yml"
    file.write_text(file.read_text().replace("policy:", "frame_stack: 2\n  policy:", 1))
    assert "frame_stack" in refuse("push", str(copy), "--folder", "b")


def test_weights_that_lower_the_success_are_not_halved(run_folder, tmp_path, monkeypatch):
    """The written file always fails, the run's own model never."""

    def evaluate(agent, options):
        rounded = agent.model.actor.mu.linear.weights["0_0"]
        halved = bool((rounded == rounded.half().float()).all())
        return Outcome([not halved] * 20, [0.0] * 20)

    monkeypatch.setattr(packing, "evaluate_agent", evaluate)
    assert main(["push", str(run_folder), "--folder", str(tmp_path / "toy"), "--device", "cpu"]) == 0
    card = read_card(tmp_path / "toy")
    assert (card.weights, card.success) == ("float32", 1.0)


def test_a_hub_that_cannot_be_used_is_one_line(run_folder, refuse, hub, monkeypatch):
    words = ("push", str(run_folder), "-orga")
    assert "--organization" in refuse(*words, "a/b")
    monkeypatch.setattr(hub, "reachable", False)
    assert "Hugging Face" in refuse(*words, "arms")
    assert not hub.uploaded


def test_a_recorded_agent_keeps_the_state_of_its_policy(toy_id):
    env = gym.make(toy_id, obs_size=48)
    model = RecurrentPPO("MultiInputLstmPolicy", env, n_steps=8, batch_size=8)
    actor = agent_actor(Agent(model, Path(), "", toy_id, {"obs_size": 48}), {})
    seen, _ = actor.env.reset(seed=0)
    _, first = actor.act(seen, None)
    _, second = actor.act(seen, first)
    assert not np.array_equal(first[0], second[0])
