"""Benchmarks: the numbers of the paper's tables, and the defaults of the registered environments."""

import pytest

import bulletarm_gym
from bulletarm_gym.benchmarks import BENCHMARKS
from bulletarm_gym.config import Context, EnvConfig
from bulletarm_gym.registry import PAPER, load

# The paper's tables, transcribed by column: number of objects, optimal and maximum number of steps.
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
EPISODES = {"CovidTest": 500, "Ramp": 1000, "OpenLoop": 200, "CloseLoop": 100}
"""Number of expert episodes by the first word that is in an id."""
PARAMETERS = {
    "open_loop_2d": ("pxy", False),
    "open_loop_3d": ("pxyr", True),
    "open_loop_6d": ("pxyzrrr", True),
    "close_loop_3d": ("pxyz", False),
    "close_loop_4d": ("pxyzr", True),
}


def _rows(table, prefix):
    words = table.split()
    count = len(words) // 4
    names, *numbers = (words[count * row : count * (row + 1)] for row in range(4))
    columns = (map(int, column) for column in numbers)
    return [(f"BulletArm/{prefix}{name}-v0", *row) for name, *row in zip(names, *columns, strict=True)]


BUMPS = _rows("HouseBuilding4 BoxPalletizing 6 18 12 36 20 40", "OpenLoopBump")
ROWS = {name: _rows(OPEN_LOOP_3D, "OpenLoop") for name in ("open_loop_2d", "open_loop_3d")}
ROWS |= {name: _rows(CLOSE_LOOP_4D, "CloseLoop") for name in ("close_loop_3d", "close_loop_4d")}
ROWS["open_loop_6d"] = _rows(OPEN_LOOP_3D, "OpenLoopRamp")[:7] + BUMPS


@pytest.mark.parametrize("name", PARAMETERS)
def test_benchmarks_have_the_papers_numbers(name):
    benchmark, entries = BENCHMARKS[name], {entry.env_id: entry for entry in PAPER}
    assert (benchmark.action_sequence, benchmark.random_orientation) == PARAMETERS[name]
    rows = benchmark.environments
    assert [(row.env_id, row.num_objects, row.optimal_steps, row.max_steps) for row in rows] == ROWS[name]
    for row in rows:
        assert row.expert_episodes == next(count for word, count in EPISODES.items() if word in row.env_id)
        size = 40 if "Bump" in row.env_id else 24 if "OpenLoop" in row.env_id else None
        assert benchmark.make_kwargs(row).get("in_hand_size") == size
        entry = entries[row.env_id]
        context = Context(entry.control, load(entry.task).defaults, entry.surface)
        config = EnvConfig.of(context, benchmark.make_kwargs(row), entry.defaults)
        assert (config.num_objects, config.max_steps) == (row.num_objects, row.max_steps)


def test_every_environment_of_the_benchmarks_is_registered():
    listed = {env.env_id for benchmark in BENCHMARKS.values() for env in benchmark.environments}
    assert set(bulletarm_gym.PAPER_IDS) == listed and len(listed) == 31
