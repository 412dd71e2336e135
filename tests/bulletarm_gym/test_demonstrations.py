"""Collections of expert episodes: true, repeatable, and kept whole or not at all."""

import io
import json
import pickle
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
from rollouts import idle

from bulletarm_gym.demonstrations import (
    Demonstrations,
    Episode,
    RecordDemonstrations,
    collect,
    export_minari,
    load,
    replay,
)
from bulletarm_gym.demonstrations import episodes as files
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.simulation.shapes import Box, Piece, wavefront

Make = Callable[..., ManipulationEnv]

PICKING = "BulletArm/CloseLoopBlockPicking-v0"
STACKING = "BulletArm/OpenLoopBlockStacking-v0"
PACKING = "BulletArm/OpenLoopBinPacking-v0"
BUMPS = "BulletArm/OpenLoopBumpHouseBuilding4-v0"
HOUSE = "BulletArm/OpenLoopHouseBuilding1-v0"
QUANTUM = 0.5e-4 + 1e-7
"""Half of what is stored of a height (m), and what float32 adds to it."""
BASKETS = {
    "close loop": (PICKING, "waypoint", {"obs_size": 32}),
    "state": (PICKING, "waypoint", {"observation": "state"}),
    "open loop": (STACKING, "waypoint", {"num_objects": 2}),
    "deconstruction": (HOUSE, "deconstruction", {"num_objects": 3}),
}


@pytest.fixture(scope="module", params=BASKETS)
def basket(request: pytest.FixtureRequest) -> Demonstrations:
    """Two episodes of each kind."""
    env_id, planner, env_kwargs = BASKETS[request.param]
    return collect(env_id, 2, planner, seed=3, env_kwargs=env_kwargs)


def replayed(basket: Demonstrations, make: Make, episode: Episode) -> list[tuple[Any, ...]]:
    """What the environment answers to an episode's actions from its first state."""
    parameters = {name: value for name, value in basket.about["configuration"].items() if name != "robot"}
    env = make(basket.env_id, **parameters)
    env.set_state(episode.state)
    return [env.step(action) for action in episode.actions]


def test_a_function_that_no_file_can_name_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^env_kwargs must have import paths .*reward=<function"):
        collect("BulletArm/CloseLoopBlockPicking-v0", 1, env_kwargs={"reward": lambda scene, outcome: 0.0})


def test_episodes_are_what_the_environment_does(basket: Demonstrations, make: Make) -> None:
    assert len(basket) == 2 and basket.attempts >= 2
    for episode in basket:
        for k, (observation, reward, terminated, truncated, _) in enumerate(replayed(basket, make, episode)):
            assert observation.keys() == episode.observations.keys()
            for key, values in observation.items():
                np.testing.assert_allclose(episode.observations[key][k + 1], values, rtol=0.0, atol=QUANTUM)
            assert (reward, terminated, truncated) == (
                episode.rewards[k],
                episode.terminations[k],
                episode.truncations[k],
            )


def test_shapes_and_success(basket: Demonstrations) -> None:
    for episode in basket:
        n = len(episode)
        assert all(len(values) == n + 1 for values in episode.observations.values())
        assert all(values.dtype == np.float32 for values in episode.observations.values())
        assert episode.actions.shape == (n, len(basket.about["configuration"]["action_sequence"]))
        assert episode.terminations[-1] and episode.rewards[-1] == 1.0
        assert not episode.terminations[:-1].any() and not episode.truncations.any()


def test_equal_seeds_give_equal_files() -> None:
    first, second, other = (
        collect(HOUSE, 1, "deconstruction", seed=seed, env_kwargs={"num_objects": 2, "obs_size": 32})
        for seed in (5, 5, 6)
    )
    assert first.image == second.image != other.image


def test_episodes_begin_with_their_seeds(make: Make) -> None:
    demonstrations = collect(PICKING, 2, seed=0, env_kwargs={"obs_size": 32})
    env = make(PICKING, obs_size=32)
    for episode in demonstrations:
        observation, _ = env.reset(seed=episode.seed)
        first = episode.observations["heightmap"][0]
        np.testing.assert_allclose(first, observation["heightmap"], rtol=0.0, atol=QUANTUM)


def test_only_successes_count(monkeypatch: pytest.MonkeyPatch) -> None:
    expert, resets = ManipulationEnv.expert_action, []
    monkeypatch.setattr(ManipulationEnv, "reset", _counting(ManipulationEnv.reset, resets))
    monkeypatch.setattr(
        ManipulationEnv, "expert_action", lambda env: idle(env) if len(resets) % 2 else expert(env)
    )
    demonstrations = collect(PICKING, 2, seed=0, env_kwargs={"max_steps": 20, "obs_size": 32})
    assert (len(demonstrations), demonstrations.attempts) == (2, 4)
    monkeypatch.setattr(ManipulationEnv, "expert_action", idle)
    with pytest.raises(RuntimeError, match="0 of 3 attempts succeeded, 1 needed"):
        collect(PICKING, 1, seed=0, env_kwargs={"max_steps": 2}, max_attempts=3)


def _counting(method: Callable[..., Any], calls: list[int]) -> Callable[..., Any]:
    def counted(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        return method(*args, **kwargs)

    return counted


# Files


def test_files_come_back_whole(basket: Demonstrations, tmp_path: Path) -> None:
    path = tmp_path / "new" / "demonstrations.h5"
    basket.save(path)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    back = load(path)
    assert back.image == basket.image and back.about == basket.about
    assert pickle.loads(pickle.dumps(back))[1].initial_state == basket[1].initial_state
    assert basket[-1].seed == basket[1].seed
    with pytest.raises(IndexError):
        basket[2]


def test_any_reader_finds_everything(basket: Demonstrations) -> None:
    with h5py.File(io.BytesIO(basket.image)) as file:
        for number, episode in enumerate(basket):
            group = file[f"episodes/{number}"]
            assert group["seed"][()] == episode.seed
            assert json.loads(group["configuration"][()]) == basket.about["configuration"]
            assert "pybullet" in json.loads(group["versions"][()])
            assert json.loads(bytes(group["initial_state"][:])) == json.loads(episode.initial_state)
            for key in files.HEIGHTS:
                if key in group["observations"]:
                    stored = group["observations"][key]
                    assert stored.dtype == np.uint16 and stored.attrs["metres_per_count"] == 1e-4
                    assert stored.compression == "gzip"


def test_a_slice_holds_its_episodes(basket: Demonstrations, tmp_path: Path) -> None:
    part = basket[1:]
    part.save(tmp_path / "part.h5")
    (episode,) = load(tmp_path / "part.h5")
    assert _content(episode) == _content(basket[1]) and part.attempts == 1
    assert part.about == basket.about and len(basket[:50]) == 2 and not len(basket[2:])


def test_noise_changes_actions() -> None:
    plain, noisy = (
        collect(PICKING, 1, seed=0, noise=noise, env_kwargs={"obs_size": 32}) for noise in (0, 0.2)
    )
    assert np.abs(noisy[0].actions).max() <= 1.0 and noisy[0].actions.dtype == np.float32
    assert not np.array_equal(noisy[0].actions[0], plain[0].actions[0])
    assert noisy[0].state == plain[0].state and noisy.about["noise"] == 0.2
    with closing(noisy.make_env()) as env:
        assert list(replay(noisy, 0, env.unwrapped))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="noise must be 0"):
        collect(STACKING, 1, "deconstruction", noise=0.1)


def test_environments_are_made_again(basket: Demonstrations) -> None:
    env = basket.make_env(max_steps=7)
    assert env.unwrapped.config.max_steps == 7
    assert env.unwrapped.config.num_objects == basket.about["configuration"]["num_objects"]
    env.close()


def test_a_folder_of_objects_is_found_from_other_folders_and_after_a_move(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    objects = tmp_path / "objects"
    objects.mkdir()
    (objects / "box.obj").write_text(wavefront([Piece(Box((0.04, 0.05, 0.04)))]))
    monkeypatch.chdir(tmp_path)
    kwargs = {"object_set": "objects", "num_objects": 1, "obs_size": 16}
    recorded = collect("BulletArm/CloseLoopObjectGrasping-v0", 1, seed=0, env_kwargs=kwargs)
    recorded.save("episodes.h5")
    monkeypatch.chdir("/")
    recorded.make_env().close()
    objects.rename(tmp_path / "moved")
    must = rf"^object_set must be .*, got '{objects}', .* load\(path, object_set="
    with pytest.raises(ValueError, match=must):
        recorded.make_env()
    moved = load(tmp_path / "episodes.h5", object_set=tmp_path / "moved")
    with closing(moved.make_env()) as env:
        assert list(replay(moved, 0, env.unwrapped))  # type: ignore[arg-type]


def test_interrupted_collections_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step, calls = ManipulationEnv.step, []

    def interrupted(env: ManipulationEnv, action: Any) -> Any:
        calls.append(action)
        if len(calls) > 10:
            raise KeyboardInterrupt
        return step(env, action)

    monkeypatch.setattr(ManipulationEnv, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        collect(PICKING, 5, seed=0, path=tmp_path / "a.h5", env_kwargs={"obs_size": 32})
    assert len(calls) > 10 and not list(tmp_path.iterdir())


def test_interrupted_writes_leave_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    demonstrations = collect(PICKING, 1, seed=0, env_kwargs={"obs_size": 32})
    path = tmp_path / "a.h5"
    path.write_bytes(b"older")

    def half(path: Path, content: bytes) -> None:
        path.open("wb").write(content[:100])
        raise OSError("no space left")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match="no space"):
        demonstrations.save(path)
    assert path.read_bytes() == b"older" and list(tmp_path.iterdir()) == [path]


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    path.write_text("text")
    with pytest.raises(ValueError, match="not a file of demonstrations"):
        load(path)
    with h5py.File(path, "w") as file:
        file["something"] = 1
    with pytest.raises(ValueError, match="not a file of demonstrations"):
        load(path)


def test_a_flipped_bit_is_noticed(tmp_path: Path) -> None:
    """Wherever it is, nothing else is read than was written, or the error names the file."""
    whole = collect("BulletArm/CloseLoopBlockReaching-v0", 1, seed=0, env_kwargs={"obs_size": 16}).image
    expected = _content(Demonstrations(whole)[0])
    path, refused = tmp_path / "damaged.h5", 0
    rng = np.random.default_rng(0)
    for position in rng.integers(len(whole), size=300).tolist():
        damaged = bytearray(whole)
        damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            assert _content(load(path)[0]) == expected
        except ValueError as error:
            refused += 1
            assert str(error).startswith(f"{path}: a file of demonstrations, but damaged")
    assert refused > 280


def _content(episode: Episode) -> list[Any]:
    arrays = [*episode.observations.values(), episode.actions, episode.rewards, episode.terminations]
    return [episode.seed, episode.initial_state, *(array.tobytes() for array in arrays)]


def test_load_rejects_files_without_a_checksum(basket: Demonstrations) -> None:
    with pytest.raises(ValueError, match=r"^other\.h5: not a file of demonstrations$"):
        Demonstrations(bytes(512) + basket.image[512:], "other.h5")


def test_loading_a_file_imports_nothing(basket: Demonstrations, tmp_path: Path) -> None:
    basket.save(tmp_path / "a.h5")
    before = set(sys.modules)
    assert all(episode.state.made_of for episode in load(tmp_path / "a.h5"))
    assert set(sys.modules) == before


# Refusals


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((PICKING, 0), "^episodes must be an integer of at least 1, got 0"),
        ((PICKING, "3"), "^episodes must be an integer of at least 1, got '3'"),
        ((PICKING, 1, "magic"), "^planner must be one of .*, got 'magic'"),
        ((PICKING, 1, "deconstruction"), "close-loop"),
        ((PACKING, 1, "deconstruction"), "BinPacking builds no structure"),
        ((BUMPS, 1, "deconstruction"), "blocks do not stay"),
        (("CartPole-v1", 1), "env_id"),
    ],
    ids=str,
)
def test_wrong_arguments_are_refused(arguments: tuple[Any, ...], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        collect(*arguments)


@pytest.mark.parametrize(
    ("name", "value", "must"),
    [
        ("seed", -1, "an integer of at least 0"),
        ("seed", "a", "an integer of at least 0"),
        ("max_attempts", 0, "an integer of at least 1"),
        ("env_kwargs", "obs_size", "a dict"),
        ("noise", -0.1, "a number from 0 to 1"),
    ],
)
def test_collect_names_the_wrong_argument(name: str, value: Any, must: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name} must be {must}, got {value!r}"):
        collect(PICKING, 1, **{name: value})


def test_folders_are_no_files(tmp_path: Path) -> None:
    must = f"^path must be a file such as .*, got the folder {tmp_path}"
    with pytest.raises(ValueError, match=must):
        collect(PICKING, 1, path=tmp_path)
    with closing(gymnasium.make(PICKING, obs_size=16)) as env, pytest.raises(ValueError, match=must):
        RecordDemonstrations(env, tmp_path)


# Minari


def test_minari_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    demonstrations = collect(PICKING, 1, seed=0, env_kwargs={"obs_size": 32})
    with pytest.raises(ImportError, match=r"bulletarm-gym\[minari\]"):
        export_minari(demonstrations, "bulletarm/picking/expert-v0")


def test_minari_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    demonstrations = collect(PICKING, 2, seed=0, env_kwargs={"obs_size": 32})
    dataset = export_minari(demonstrations, "bulletarm/picking/expert-v0", description="Picks a block")
    assert len(dataset) == 2
    for ours, theirs in zip(demonstrations, dataset, strict=True):
        np.testing.assert_array_equal(ours.actions, theirs.actions)
        for key, values in ours.observations.items():
            np.testing.assert_array_equal(values, theirs.observations[key])
