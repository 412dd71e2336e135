"""Collections of expert episodes, their files and replays."""

import dataclasses
import io
import itertools
import json
import pickle
import sys
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from rollouts import GRASPING, PICKING, STACKING, core_of, idle

from bulletarm_gym.demonstrations import Demonstrations, ReplayError, collect, load, replay
from bulletarm_gym.demonstrations.episodes import HEIGHTS, atomic_path
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.simulation.shapes import Box, Piece, wavefront

SMALL = {"obs_size": 32}
QUANTUM = 0.5e-4 + 1e-7
"""Half of a count of stored heights (m), and the rounding to float32."""
KINDS = {
    "image": (PICKING, "waypoint", SMALL),
    "state": (PICKING, "waypoint", {"observation": "state", "surface": "ramp"}),
    "deconstruction": (STACKING, "deconstruction", {"num_objects": 2}),
}


@pytest.fixture(scope="module", params=KINDS)
def basket(request):
    """Two episodes of each kind."""
    env_id, planner, env_kwargs = KINDS[request.param]
    return collect(env_id, 2, planner, seed=3, env_kwargs=env_kwargs)


def content(episode):
    arrays = [*episode.observations.values(), episode.actions, episode.rewards, episode.terminations]
    return [episode.seed, episode.initial_state, *(array.tobytes() for array in arrays)]


def test_episodes_are_what_the_environment_does(basket):
    assert len(basket) == 2 and basket.attempts >= 2
    with core_of(basket) as env:
        for episode in basket:
            n = len(episode)
            assert episode.actions.shape == (n, len(basket.action_sequence))
            assert episode.terminations.tolist() == [False] * (n - 1) + [True] and episode.rewards[-1] == 1.0
            env.set_state(episode.state)
            observations, outcomes = [env.observe()], []
            for action in episode.actions:
                observation, *outcome, _ = env.step(action)
                observations.append(observation)
                outcomes.append(outcome)
            recorded = zip(episode.rewards, episode.terminations, episode.truncations, strict=True)
            assert outcomes == list(map(list, recorded))
            for key, values in episode.observations.items():
                expected = np.stack([observation[key] for observation in observations])
                np.testing.assert_allclose(values, expected, rtol=0.0, atol=QUANTUM)
                assert values.dtype == np.float32


def test_equal_seeds_give_equal_files(picked):
    assert collect(PICKING, 2, seed=3, env_kwargs=SMALL).image == picked.image
    with core_of(picked) as env:
        for episode in picked:
            heights = env.reset(seed=episode.seed)[0]["heightmap"]
            np.testing.assert_allclose(episode.observations["heightmap"][0], heights, rtol=0.0, atol=QUANTUM)


def test_only_successes_are_kept(monkeypatch):
    expert, calls = ManipulationEnv.expert_action, itertools.count()
    patch = partial(monkeypatch.setattr, ManipulationEnv, "expert_action")
    patch(lambda env: (idle if next(calls) < 20 else expert)(env))
    found = collect(PICKING, 1, seed=np.int64(0), env_kwargs={"max_steps": 20, "obs_size": 32})
    assert (len(found), found.attempts) == (1, 2)
    patch(idle)
    with pytest.raises(RuntimeError, match="0 of 3 attempts succeeded, 1 needed"):
        collect(PICKING, 1, seed=0, env_kwargs={"max_steps": 2}, max_attempts=3)


def test_noise_changes_actions(picked):
    noisy = collect(PICKING, 1, seed=3, noise=0.2, env_kwargs=SMALL)
    assert np.abs(noisy[0].actions).max() <= 1.0 and noisy[0].state == picked[0].state
    assert not np.array_equal(noisy[0].actions[0], picked[0].actions[0]) and noisy.about["noise"] == 0.2
    with core_of(noisy) as env:
        assert list(replay(noisy, 0, env))


def test_collect_rejects_other_arguments(tmp_path):
    for arguments, options, message in (
        ((PICKING, 0), {}, "^episodes must be .*, got 0"),
        ((PICKING, 1, "magic"), {}, "^planner must be .*, got 'magic'"),
        ((PICKING, 1, "deconstruction"), {}, "^planner must be .*closed-loop"),
        (("BulletArm/OpenLoopBinPacking-v0", 1, "deconstruction"), {}, "^planner must be .*BinPacking"),
        (("BulletArm/OpenLoopBumpHouseBuilding4-v0", 1, "deconstruction"), {}, "^planner .*surface"),
        ((STACKING, 1, "deconstruction"), {"noise": 0.1}, "noise must be 0"),
        (("CartPole-v1", 1), {}, "^env_id must be .*CartPole"),
        ((PICKING, 1), {"seed": -1}, "^seed must be .*, got -1"),
        ((PICKING, 1), {"max_attempts": 0}, "^max_attempts must be .*, got 0"),
        ((PICKING, 1), {"env_kwargs": "obs_size"}, "^env_kwargs must be .*, got 'obs_size'"),
        ((PICKING, 1), {"env_kwargs": {"reward": lambda s, o: 0.0}}, "^env_kwargs must .*reward=<function"),
        ((PICKING, 1), {"noise": -0.1}, "^noise must be .*, got -0.1"),
        ((PICKING, 1), {"path": "/"}, "^path must be a file such as .*, got the folder /"),
    ):
        with pytest.raises(ValueError, match=message):
            collect(*arguments, **options)
    (tmp_path / "taken.h5").touch()
    with pytest.raises(FileExistsError, match=r"^path must be a new file, got .*taken\.h5"):
        collect(PICKING, 1, path=tmp_path / "taken.h5")


def test_files_and_slices_keep_everything(basket, tmp_path):
    path = tmp_path / "new" / "demonstrations.h5"
    basket.save(path)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    before = set(sys.modules)
    back = load(path)
    assert all(episode.state.made_of for episode in back)
    assert set(sys.modules) == before, "loading imports nothing"
    assert back.image == basket.image and back.about == basket.about
    assert content(pickle.loads(pickle.dumps(back))[-1]) == content(basket[1])
    part = basket[1:]
    part.save(path)
    (episode,) = load(path)
    assert content(episode) == content(basket[1]) and part.attempts == 1
    assert part.about == basket.about and len(basket[:50]) == 2 and not len(basket[2:])


def test_any_reader_of_hdf5_finds_everything(basket):
    with h5py.File(io.BytesIO(basket.image)) as file:
        for number, episode in enumerate(basket):
            group = file[f"episodes/{number}"]
            assert int(group["seed"][()]) == episode.seed
            assert json.loads(group["configuration"][()]) == basket.about["configuration"]
            assert "pybullet" in json.loads(group["versions"][()])
            assert json.loads(bytes(group["initial_state"][:])) == json.loads(episode.initial_state)
            for stored in (group["observations"][key] for key in HEIGHTS if key in group["observations"]):
                assert stored.dtype == np.uint16 and stored.attrs["metres_per_count"] == 1e-4
                assert stored.compression == "gzip"


def test_files_find_a_folder_of_objects_after_a_move(tmp_path, monkeypatch):
    objects = tmp_path / "objects"
    objects.mkdir()
    (objects / "box.obj").write_text(wavefront([Piece(Box((0.04, 0.05, 0.04)))]))
    monkeypatch.chdir(tmp_path)
    kwargs = {"object_set": "objects", "num_objects": 1, "obs_size": 16}
    recorded = collect(GRASPING, 1, seed=0, env_kwargs=kwargs, path="episodes.h5")
    monkeypatch.chdir("/")
    recorded.make_env(max_steps=7).close()
    objects.rename(tmp_path / "moved")
    with pytest.raises(ValueError, match=rf"^object_set must be .*, got '{objects}'"):
        recorded.make_env()
    moved = load(tmp_path / "episodes.h5", object_set=tmp_path / "moved")
    with core_of(moved) as env:
        assert list(replay(moved, 0, env))


def test_writes_are_atomic(picked, tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    path.write_bytes(b"older")

    def half(path, content):
        path.open("wb").write(content[:100])
        raise OSError("no space left")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match="no space"):
        picked.save(path)
    with pytest.raises(KeyError), atomic_path(tmp_path / "folder") as temporary:
        temporary.mkdir()
        (temporary / "file").touch()
        raise KeyError
    assert path.read_bytes() == b"older" and list(tmp_path.iterdir()) == [path]


def test_load_names_other_and_damaged_files(picked, tmp_path):
    """Whichever bit is flipped, the content is the same or the error names the file."""
    path, refused, rng = tmp_path / "a.h5", 0, np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file["something"] = 1
    for other in (b"text", path.read_bytes(), bytes(512) + picked.image[512:]):
        path.write_bytes(other)
        with pytest.raises(ValueError, match=f"^{path}: not a file of demonstrations"):
            load(path)
    for position in rng.integers(len(picked.image), size=100).tolist():
        damaged = bytearray(picked.image)
        damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            assert content(load(path)[0]) == content(picked[0])
        except ValueError as error:
            refused += 1
            assert str(error).startswith(f"{path}: a file of demonstrations, but damaged")
    assert refused > 90


def test_replay_notices_another_course(picked, monkeypatch):
    with core_of(picked) as env:
        assert list(replay(picked, 0, env)) == list(range(len(picked[0]) + 1))
        other = dataclasses.replace(picked[0], actions=picked[0].actions[::-1])
        monkeypatch.setattr(Demonstrations, "__getitem__", lambda self, index: other)
        monkeypatch.setitem(picked.about["versions"], "numpy", "0.1")
        with pytest.raises(
            ReplayError, match=r"episode 0, step \d+: heightmap .*recorded with numpy 0\.1, here"
        ):
            list(replay(picked, 0, env))
