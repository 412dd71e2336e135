"""Exports of demonstrations to the formats of other libraries."""

import json
import shutil
import sys
from contextlib import closing
from functools import partial

import gymnasium
import h5py
import numpy as np
import pytest
from rollouts import PICKING, core_of

from bulletarm_gym.demonstrations import (
    Demonstrations,
    collect,
    export_lerobot,
    export_minari,
    export_rlds,
    exports,
    rlds,
)
from bulletarm_gym.demonstrations.robomimic import export_robomimic

DRAWER = "BulletArm/CloseLoopDrawerOpening-v0"
RAMP = "BulletArm/OpenLoopRampBlockStacking-v0"


def test_exports_name_missing_libraries(picked, monkeypatch):
    exporters = {"minari": export_minari, "lerobot": export_lerobot, "rlds": export_rlds}
    for extra, export in exporters.items():
        monkeypatch.setitem(sys.modules, "tensorflow" if extra == "rlds" else extra, None)
        with pytest.raises(ImportError, match=rf"bulletarm-gym\[{extra}\]"):
            export(picked, "bulletarm/picking/expert-v0")


def test_frames_hold_what_sensors_of_the_environment_read(picked):
    camera = {"size": 32, "position": [1.0, 0.2, 0.6]}
    episode = picked[1]
    with core_of(picked) as env:
        observed = exports.observations(1, picked, env, {"side": camera}, object_poses=True)
        frames = list(exports.frames(episode, observed))
        plain = next(exports.observations(1, picked, env, {"side": camera}))
    assert "observation.environment_state" not in plain
    sensors = ["holding", "state", {"name": "side", "sensor": "rgb", **camera}]
    with closing(gymnasium.make(PICKING, observation=sensors)) as other:
        observation, _ = other.reset(seed=episode.seed)
        for k, frame in enumerate(frames):
            expected = {
                "observation.images.side": observation["side"].transpose(1, 2, 0),
                "observation.state": np.concatenate([observation["state"][:6], observation["holding"]]),
                "observation.environment_state": observation["state"][6:],
                "observation.heightmap": episode.observations["heightmap"][k].transpose(1, 2, 0),
                "observation.holding": episode.observations["holding"][k],
                "action": episode.actions[k],
                "next.reward": episode.rewards[k, None],
                "next.done": episode.terminations[k, None],
                "next.success": episode.terminations[k, None],
            }
            np.testing.assert_equal(frame, expected)
            observation, *_ = other.step(episode.actions[k])


def test_features_describe_the_frames():
    sensors = ["state", "color", "segmentation", "holding"]
    found = []
    for env_id, kwargs in ((DRAWER, {"observation": sensors, "obs_size": 32}), (RAMP, {"num_objects": 2})):
        demonstrations = collect(env_id, 1, seed=0, env_kwargs=kwargs)
        with core_of(demonstrations) as env:
            observed = exports.observations(0, demonstrations, env, {"front": {"size": 16}}, True)
            frame = next(exports.frames(demonstrations[0], observed))
            found.append(exports.features(env, frame))
            if env_id == DRAWER:
                with pytest.raises(ValueError, match=r"cameras must .*observation\.images\.color"):
                    next(exports.observations(0, demonstrations, env, {"color": {}}))
    drawer, ramp = found
    image = {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]}
    assert drawer["observation.images.color"] == image
    assert drawer["observation.segmentation"]["dtype"] == "uint8"
    assert drawer["observation.environment_state"]["names"][-1] == "drawer.joint_0"
    assert ramp["action"]["names"] == ["p", "x", "y", "z", "theta", "phi", "psi"]
    assert ramp["observation.in_hand"]["shape"] == (24, 24, 3) and ramp["next.done"]["dtype"] == "bool"
    for feature in (*drawer.values(), *ramp.values()):
        (*_, last), names = feature["shape"], feature["names"]
        assert names is None or len(names) == (3 if len(feature["shape"]) == 3 else last)


def test_robomimic_file(picked, tmp_path):
    """Structure of robomimic's documentation; obs and next_obs are shifted by a step."""
    side = {"size": [32, 24], "position": [1.0, 0.2, 0.6]}
    cameras = {"side": side, "wrist": {"mount": "wrist", "size": 16}}
    path = tmp_path / "picking.hdf5"
    assert export_robomimic(picked, path, cameras=cameras, object_poses=True, valid_ratio=0.5) == path
    with h5py.File(path, "r") as file, core_of(picked) as env:
        data = file["data"]
        assert sorted(data) == ["demo_0", "demo_1"]
        assert [file[f"mask/{key}"][()].tolist() for key in ("train", "valid")] == [[b"demo_0"], [b"demo_1"]]
        assert data.attrs["total"] == sum(map(len, picked))
        env_args = json.loads(data.attrs["env_args"])
        assert (env_args["env_name"], env_args["type"]) == (PICKING, 2)
        with closing(gymnasium.make(PICKING, **env_args["env_kwargs"])) as again:
            assert again.observation_space == env.observation_space
        for number, episode in enumerate(picked):
            demo = data[f"demo_{number}"]
            n = demo.attrs["num_samples"]
            assert n == len(episode) and json.loads(demo.attrs["ep_meta"]) == {"lang": env.task_description}
            np.testing.assert_array_equal(demo["actions"], episode.actions)
            np.testing.assert_array_equal(demo["rewards"], episode.rewards)
            assert demo["dones"][()].tolist() == [False] * (n - 1) + [True]
            names = {"side_image", "wrist_image", "state", "environment_state", "heightmap", "holding"}
            assert demo["obs"].keys() == demo["next_obs"].keys() == names
            for name in names:
                np.testing.assert_array_equal(demo["obs"][name][1:], demo["next_obs"][name][:-1])
            heightmaps = episode.observations["heightmap"].transpose(0, 2, 3, 1)
            np.testing.assert_array_equal(demo["next_obs/heightmap"], heightmaps[1:])
            assert demo["obs/side_image"].shape == (n, 24, 32, 3) and demo["obs/state"].shape == (n, 7)
    with pytest.raises(ValueError, match=r"valid_ratio must be a number from 0 to 1, got 2"):
        export_robomimic(picked, tmp_path / "other", valid_ratio=2)
    assert_refusals(partial(export_robomimic, picked), path)


def test_robomimic_file_has_the_new_folder_of_the_objects(picked, tmp_path, monkeypatch):
    moved = Demonstrations(picked.image, object_set=tmp_path)
    original = picked.make_env()  # the task has no folder
    monkeypatch.setattr(Demonstrations, "make_env", lambda _: original)
    path = export_robomimic(moved, tmp_path / "picking.hdf5", cameras={})
    with h5py.File(path, "r") as file:
        assert json.loads(file["data"].attrs["env_args"])["env_kwargs"]["object_set"] == str(tmp_path)


def assert_refusals(export, path):
    """Assert that an export keeps an existing file and writes nothing with a wrong camera."""
    with pytest.raises(FileExistsError):
        export(path)
    with pytest.raises(ValueError, match="cameras: top"):
        export(path.with_name("other"), cameras={"top": {"zoom": 2}})
    assert list(path.parent.iterdir()) == [path]


def test_lerobot_dataset(picked, tmp_path):
    pytest.importorskip("lerobot")
    without = export_lerobot(picked, "bulletarm/picking", tmp_path / "small", cameras={})
    assert {"observation.heightmap", "observation.holding"} & {*without.features} == {"observation.holding"}
    shutil.rmtree(tmp_path / "small")
    arguments = {"heightmaps": True, "task": "Pick it up", "fps": 10}
    dataset = export_lerobot(picked, "bulletarm/picking", tmp_path / "set", **arguments)
    assert (len(dataset), dataset.num_episodes, dataset.fps) == (sum(map(len, picked)), 2, 10)
    last = dataset[len(dataset) - 1]
    assert last["task"] == "Pick it up" and bool(last["next.success"]) and float(last["next.reward"]) == 1.0
    np.testing.assert_array_equal(last["action"], picked[1].actions[-1])
    image = picked[1].observations["heightmap"][-2].transpose(1, 2, 0)
    np.testing.assert_array_equal(last["observation.heightmap"], image)
    assert last["observation.images.front"].shape == (3, 240, 240)
    assert dataset.meta.stats["observation.heightmap"]["mean"].shape == (1,)
    assert_refusals(partial(export_lerobot, picked, "bulletarm/picking"), tmp_path / "set")


def test_rlds_steps(picked):
    """The last step has the last observation and no action."""
    with core_of(picked) as env:
        observed = list(exports.observations(1, picked, env, {"front": {"size": 16}}))
        found = list(rlds.steps(picked[1], iter(observed), env.instruction))
        n = len(picked[1])
        assert len(found) == n + 1 and {step["language_instruction"] for step in found} == {env.instruction}
    assert [step["reward"] for step in found] == [*picked[1].rewards, 0]
    assert [step["discount"] for step in found] == [1] * (n - 1) + [0, 0]
    assert [step["is_last"] for step in found] == [False] * n + [True]
    np.testing.assert_array_equal([step["action"] for step in found], [*picked[1].actions, np.zeros(5)])
    heightmaps = [step["observation"]["heightmap"][..., 0] for step in found]
    np.testing.assert_array_equal(heightmaps, picked[1].observations["heightmap"][:, 0])
    assert found[0]["observation"].keys() == {"front_image", "state", "heightmap", "holding"}


def test_rlds_dataset(picked, tmp_path):
    pytest.importorskip("tensorflow")
    tfds = pytest.importorskip("tensorflow_datasets")
    cameras = {"front": {"size": [32, 24]}}
    folder = export_rlds(picked, tmp_path / "set", name="picking", cameras=cameras, object_poses=True)
    episodes = list(tfds.as_numpy(tfds.builder_from_directory(folder).as_dataset(split="train")))
    read = [list(episode["steps"]) for episode in episodes]
    assert [len(steps) for steps in read] == [len(episode) + 1 for episode in picked]
    for steps, episode in zip(read, picked, strict=True):
        np.testing.assert_array_equal([step["action"] for step in steps[:-1]], episode.actions)
        heightmaps = [step["observation"]["heightmap"][..., 0] for step in steps]
        np.testing.assert_array_equal(heightmaps, episode.observations["heightmap"][:, 0])
        assert steps[0]["observation"]["front_image"].shape == (24, 32, 3)
    assert_refusals(partial(export_rlds, picked), tmp_path / "set")
