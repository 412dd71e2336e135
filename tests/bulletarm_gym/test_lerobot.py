"""Demonstrations for LeRobot: what its frames hold, by replays that go exactly as was recorded."""

import dataclasses
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from bulletarm_gym.demonstrations import Demonstrations, ReplayError, collect, export_lerobot, replay
from bulletarm_gym.demonstrations import exports as lerobot
from bulletarm_gym.env import ManipulationEnv

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
DRAWER = "BulletArm/CloseLoopDrawerOpening-v0"
RAMP = "BulletArm/OpenLoopRampBlockStacking-v0"
CAMERA = {"size": 32, "position": [1.0, 0.2, 0.6]}


@pytest.fixture(scope="module")
def picking() -> Demonstrations:
    return collect(PICKING, 2, seed=1, env_kwargs={"obs_size": 32})


@pytest.fixture
def env_of() -> Iterator[Callable[[Demonstrations], ManipulationEnv]]:
    made: list[ManipulationEnv] = []

    def make(demonstrations: Demonstrations) -> ManipulationEnv:
        made.append(lerobot.unwrapped_env(demonstrations))
        return made[-1]

    yield make
    for env in made:
        env.close()


def test_frames_are_what_a_camera_in_the_environment_would_have_seen(
    picking: Demonstrations, env_of: Callable[[Demonstrations], ManipulationEnv]
) -> None:
    env, episode = env_of(picking), picking[1]
    features = lerobot.make_features(env, episode, {"side": CAMERA}, object_poses=True)
    frames = list(lerobot.frames(picking, 1, env, features))
    assert len(frames) == len(episode)
    seen: list[dict[str, Any]] = []
    sensors = ["heightmap", "holding", "state", {"name": "side", "sensor": "rgb", **CAMERA}]
    with closing(gymnasium.make(PICKING, obs_size=32, observation=sensors)) as other:
        observation, _ = other.reset(seed=episode.seed)
        for action in episode.actions:
            seen.append(observation)
            observation, *_ = other.step(action)
    for k, (frame, observation) in enumerate(zip(frames, seen, strict=True)):
        np.testing.assert_array_equal(
            frame["observation.images.side"], observation["side"].transpose(1, 2, 0)
        )
        state = np.concatenate([observation["state"][:6], observation["holding"]])
        np.testing.assert_array_equal(frame["observation.state"], state)
        np.testing.assert_array_equal(frame["observation.environment_state"], observation["state"][6:])
        image = episode.observations["heightmap"][k].transpose(1, 2, 0)
        np.testing.assert_array_equal(frame["observation.heightmap"], image)
        np.testing.assert_array_equal(frame["action"], episode.actions[k])
    assert [bool(frame["next.done"][0]) for frame in frames] == [False] * (len(frames) - 1) + [True]
    assert [float(frame["next.reward"][0]) for frame in frames] == episode.rewards.tolist()


def test_frames_are_of_the_features_that_are_announced(
    env_of: Callable[[Demonstrations], ManipulationEnv],
) -> None:
    sensors = ["state", "color", "segmentation", "holding"]
    kinds = [(DRAWER, {"observation": sensors, "obs_size": 32}), (RAMP, {"num_objects": 2, "obs_size": 48})]
    for env_id, env_kwargs in kinds:
        demonstrations = collect(env_id, 1, seed=0, env_kwargs=env_kwargs)
        env = env_of(demonstrations)
        features = lerobot.make_features(env, demonstrations[0], {"front": {"size": 16}}, True)
        for frame in lerobot.frames(demonstrations, 0, env, features):
            assert frame.keys() == features.keys()
            for name, (dtype, shape, names, _) in features.items():
                assert frame[name].shape == shape and (
                    len(shape) == 3 or names is None or len(names) == shape[0]
                )
                assert frame[name].dtype == (np.uint8 if dtype == "image" else np.dtype(dtype))
        if env_id == DRAWER:
            assert features["observation.images.color"].dtype == "image"
            assert features["observation.environment_state"].names[-1] == "drawer.joint_0"
            assert env.task_description == "Pull a drawer open by its handle."
        else:
            assert features["action"].names == ("p", "x", "y", "z", "theta", "phi", "psi")


def test_an_episode_that_goes_otherwise_is_refused(
    picking: Demonstrations,
    env_of: Callable[[Demonstrations], ManipulationEnv],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = env_of(picking)
    assert list(replay(picking, 0, env)) == list(range(len(picking[0]) + 1))
    other = dataclasses.replace(picking[0], actions=picking[0].actions[::-1])
    monkeypatch.setattr(Demonstrations, "__getitem__", lambda self, index: other)
    monkeypatch.setitem(picking.about["versions"], "numpy", "0.1")
    with pytest.raises(
        ReplayError, match=r"episode 0, step \d+: heightmap differs .*recorded with numpy 0\.1, here"
    ):
        list(replay(picking, 0, env))


@pytest.mark.parametrize(
    ("cameras", "reason"),
    [
        ({"top": {"fov": 500}}, "cameras: top: fov must be .* got 500"),
        ({"top": {"zoom": 2}}, "cameras: top: .*zoom"),
    ],
)
def test_cameras_that_cannot_be(
    picking: Demonstrations,
    env_of: Callable[[Demonstrations], ManipulationEnv],
    cameras: dict[str, Any],
    reason: str,
) -> None:
    with pytest.raises(ValueError, match=reason):
        lerobot.make_features(env_of(picking), picking[0], cameras)


def test_images_have_their_channels_last(env_of: Callable[[Demonstrations], ManipulationEnv]) -> None:
    sensors = ["heightmap", "in_hand", "color", "holding"]
    env_kwargs = {"num_objects": 2, "obs_size": 48, "observation": sensors}
    demonstrations = collect(RAMP, 1, seed=0, env_kwargs=env_kwargs)
    features = lerobot.make_features(env_of(demonstrations), demonstrations[0], {"front": {"size": 16}})
    shapes = {name: feature.shape for name, feature in features.items() if len(feature.shape) == 3}
    assert shapes == {
        "observation.images.front": (16, 16, 3),
        "observation.images.color": (48, 48, 3),
        "observation.heightmap": (48, 48, 1),
        "observation.in_hand": (24, 24, 3),
    }
    assert all(features[name].names == ("height", "width", "channels") for name in shapes)


def test_object_poses_are_exported_on_request_only(
    env_of: Callable[[Demonstrations], ManipulationEnv],
) -> None:
    demonstrations = collect(PICKING, 1, seed=1, env_kwargs={"observation": "state"})
    env = env_of(demonstrations)
    plain, full = (lerobot.make_features(env, demonstrations[0], {}, poses) for poses in (False, True))
    assert full.keys() - plain.keys() == {"observation.environment_state"}
    assert set(plain) == {
        "observation.state", "observation.holding", "action", "next.reward", "next.done", "next.success"
    }  # fmt: skip


def test_two_features_of_one_name(env_of: Callable[[Demonstrations], ManipulationEnv]) -> None:
    sensors = ["color", "holding"]
    demonstrations = collect(PICKING, 1, seed=1, env_kwargs={"observation": sensors, "obs_size": 32})
    with pytest.raises(ValueError, match=r"observation\.images\.color"):
        lerobot.make_features(env_of(demonstrations), demonstrations[0], {"color": {}})


def test_folders_are_whole_or_not_at_all(tmp_path: Path) -> None:
    with lerobot.atomic_folder(tmp_path / "new" / "set") as partial:
        partial.mkdir()
        (partial / "file").touch()
    assert [path.name for path in (tmp_path / "new" / "set").iterdir()] == ["file"]
    with pytest.raises(FileExistsError, match="which exists"), lerobot.atomic_folder(tmp_path / "new"):
        pass
    with pytest.raises(KeyError), lerobot.atomic_folder(tmp_path / "failed") as partial:
        partial.mkdir()
        raise KeyError
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_lerobot_missing(picking: Demonstrations, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lerobot", None)
    with pytest.raises(ImportError, match=r"bulletarm-gym\[lerobot\]"):
        export_lerobot(picking, "bulletarm/picking")


def test_lerobot_dataset(picking: Demonstrations, tmp_path: Path) -> None:
    pytest.importorskip("lerobot")
    dataset = export_lerobot(picking, "bulletarm/picking", tmp_path / "set", task="Pick it up", fps=10)
    assert (len(dataset), dataset.num_episodes, dataset.fps) == (sum(map(len, picking)), 2, 10)
    assert dataset.meta.info["codebase_version"] == "v3.0"
    last = dataset[len(dataset) - 1]
    assert last["task"] == "Pick it up" and bool(last["next.success"]) and float(last["next.reward"]) == 1.0
    np.testing.assert_array_equal(last["action"], picking[1].actions[-1])
    image = picking[1].observations["heightmap"][-2].transpose(1, 2, 0)
    np.testing.assert_array_equal(last["observation.heightmap"], image)
    assert last["observation.images.front"].shape == (3, 240, 240)
    assert "observation.environment_state" not in last
    for name in ("next.reward", "next.done", "next.success", "observation.holding"):
        assert last[name].shape == ()
    statistics = dataset.meta.stats
    assert statistics["observation.heightmap"]["mean"].shape == (1,)
    assert statistics["observation.images.front"]["mean"].shape == (3, 1, 1)
    with pytest.raises(FileExistsError):
        export_lerobot(picking, "bulletarm/picking", tmp_path / "set")
    with pytest.raises(ValueError, match="cameras"):
        export_lerobot(picking, "bulletarm/picking", tmp_path / "other", cameras={"top": {"zoom": 2}})
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


@pytest.mark.slow
def test_a_policy_of_lerobot_trains_one_step(picking: Demonstrations, tmp_path: Path) -> None:
    pytest.importorskip("lerobot")
    from lerobot.configs.types import FeatureType
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.datasets.utils import dataset_to_policy_features
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from torch.optim import Adam
    from torch.utils.data import DataLoader

    export_lerobot(picking, "bulletarm/picking", tmp_path / "set", cameras={"front": {"size": 64}}, fps=5)
    steps = {"action": [0.0, 0.2]}
    dataset = LeRobotDataset("bulletarm/picking", root=tmp_path / "set", delta_timestamps=steps)
    features = dataset_to_policy_features(dataset.features)
    assert FeatureType.ENV not in [feature.type for feature in features.values()]
    inputs = ("observation.images.front", "observation.state")
    small = {"dim_model": 32, "dim_feedforward": 32, "n_heads": 2, "pretrained_backbone_weights": None}
    config = ACTConfig(
        input_features={name: features[name] for name in inputs},
        output_features={"action": features["action"]},
        chunk_size=2,
        n_action_steps=2,
        device="cpu",
        **small,
    )
    policy = ACTPolicy(config)
    optimizer = Adam(policy.parameters())
    loss, _ = policy.forward(next(iter(DataLoader(dataset, batch_size=4))))
    loss.backward()
    optimizer.step()
    assert np.isfinite(loss.item())
