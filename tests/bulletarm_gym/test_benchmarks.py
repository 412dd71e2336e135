"""The benchmarks say what the paper's tables say, and the registered environments agree."""

import dataclasses
from collections.abc import Callable

import gymnasium
import pytest

import bulletarm_gym
from bulletarm_gym.benchmarks import BENCHMARKS, Benchmark
from bulletarm_gym.env import ManipulationEnv

# The paper's rows, transcribed: number of objects, optimal and maximal number of steps.
OPEN_LOOP_3D = """
BlockStacking HouseBuilding1 HouseBuilding2 HouseBuilding3 HouseBuilding4 ImproviseHouseBuilding2
ImproviseHouseBuilding3 BinPacking BottleArrangement BoxPalletizing CovidTest ObjectGrasping
4 4 3 4 6 3 4 8 6 18 6 15
6 6 4 6 10 4 6 16 12 36 18 1
10 10 10 10 20 10 10 20 20 40 30 1
"""
CLOSE_LOOP_4D = """
BlockReaching BlockPicking BlockPushing BlockPulling BlockInBowl BlockStacking HouseBuilding CornerPicking
DrawerOpening ObjectGrasping
1 1 1 2 2 2 2 1 1 5
3 7 7 7 11 12 12 14 9 7
50 50 50 50 50 50 50 50 50 50
"""
PARAMETERS = {
    "open_loop_2d": ("pxy", False),
    "open_loop_3d": ("pxyr", True),
    "open_loop_6d": ("pxyzrrr", True),
    "close_loop_3d": ("pxyz", False),
    "close_loop_4d": ("pxyzr", True),
}


def _rows(table: str) -> list[tuple[str, int, int, int]]:
    words = table.split()
    count = len(words) // 4
    names, *numbers = (words[count * row : count * (row + 1)] for row in range(4))
    return [(name, int(a), int(b), int(c)) for name, a, b, c in zip(names, *numbers, strict=True)]


def _listed(benchmark: Benchmark, prefix: str) -> list[tuple[str, int, int, int]]:
    chosen = [env for env in benchmark.environments if env.env_id.startswith(f"BulletArm/{prefix}")]
    return [
        (
            env.env_id.removeprefix(f"BulletArm/{prefix}").removesuffix("-v0"),
            env.num_objects,
            env.optimal_steps,
            env.max_steps,
        )
        for env in chosen
    ]


@pytest.mark.parametrize("name", PARAMETERS)
def test_action_spaces_and_orientations(name: str) -> None:
    sequence, turned = PARAMETERS[name]
    assert BENCHMARKS[name].name == name
    assert (BENCHMARKS[name].action_sequence, BENCHMARKS[name].random_orientation) == (sequence, turned)


def test_the_papers_tables() -> None:
    for name in ("open_loop_2d", "open_loop_3d"):
        assert _listed(BENCHMARKS[name], "OpenLoop") == _rows(OPEN_LOOP_3D)
    for name in ("close_loop_3d", "close_loop_4d"):
        assert _listed(BENCHMARKS[name], "CloseLoop") == _rows(CLOSE_LOOP_4D)
    assert _listed(BENCHMARKS["open_loop_6d"], "OpenLoopRamp") == _rows(OPEN_LOOP_3D)[:7]
    bumps = _listed(BENCHMARKS["open_loop_6d"], "OpenLoopBump")
    assert bumps == [("HouseBuilding4", 6, 12, 20), ("BoxPalletizing", 18, 36, 40)]
    assert len(BENCHMARKS["open_loop_6d"].environments) == 9


def test_expert_episodes() -> None:
    for benchmark in BENCHMARKS.values():
        for env in benchmark.environments:
            expected = next(
                number
                for part, number in (
                    ("CovidTest", 500),
                    ("Ramp", 1000),
                    ("OpenLoop", 200),
                    ("CloseLoop", 100),
                )
                if part in env.env_id
            )
            assert env.expert_episodes == expected


def test_in_hand_images() -> None:
    for benchmark in BENCHMARKS.values():
        for env in benchmark.environments:
            size = 40 if "Bump" in env.env_id else 24 if "OpenLoop" in env.env_id else None
            assert benchmark.make_kwargs(env).get("in_hand_size") == size


@pytest.mark.parametrize("name", BENCHMARKS)
def test_registered_environments_have_these_defaults(make: Callable[..., ManipulationEnv], name: str) -> None:
    benchmark = BENCHMARKS[name]
    for row in benchmark.environments:
        if row.env_id in bulletarm_gym.ENV_IDS:
            config = make(row.env_id, **benchmark.make_kwargs(row)).config
            assert (config.num_objects, config.max_steps) == (row.num_objects, row.max_steps)


def test_every_environment_of_the_benchmarks_is_registered() -> None:
    listed = {env.env_id for benchmark in BENCHMARKS.values() for env in benchmark.environments}
    assert set(bulletarm_gym.PAPER_IDS) == listed and len(listed) == 31


def test_they_cannot_be_changed() -> None:
    benchmark = BENCHMARKS["close_loop_4d"]
    with pytest.raises(dataclasses.FrozenInstanceError):
        benchmark.name = "mine"  # type: ignore[misc]
    with pytest.raises(dataclasses.FrozenInstanceError):
        benchmark.environments[0].max_steps = 5  # type: ignore[misc]


def test_make_takes_the_parameters() -> None:
    benchmark = BENCHMARKS["close_loop_3d"]
    env = gymnasium.make(benchmark.environments[0].env_id, **benchmark.make_kwargs(benchmark.environments[0]))
    assert env.action_space.shape == (4,)
    env.close()
