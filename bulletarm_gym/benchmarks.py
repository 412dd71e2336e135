"""The five benchmarks of the paper as data: the tables of its section Benchmark."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bulletarm_gym.registry import NAMESPACE

IN_HAND = 24
"""Side length (pixels) of the in-hand image (paper, Benchmark Details)."""
BUMP_IN_HAND = 40
"""Side length (pixels) of the in-hand image on bumps (paper, Benchmark Details)."""


@dataclass(frozen=True)
class BenchmarkEnv:
    """An environment of a benchmark.

    :param num_objects: number of objects in the scene
    :param optimal_steps: number of steps of an optimal policy in an episode
    :param max_steps: maximum number of steps in an episode
    :param expert_episodes: number of expert episodes before training
    :param in_hand_size: side length (pixels) of the in-hand image, None in closed-loop control
    """

    env_id: str
    num_objects: int
    optimal_steps: int
    max_steps: int
    expert_episodes: int
    in_hand_size: int | None = None


@dataclass(frozen=True)
class Benchmark:
    """Environments with one action space.

    :param random_orientation: whether objects start with random orientations
    """

    name: str
    environments: tuple[BenchmarkEnv, ...]
    action_sequence: str
    random_orientation: bool

    def make_kwargs(self, environment: BenchmarkEnv) -> dict[str, Any]:
        """Return the arguments of :func:`gymnasium.make` for one of the environments."""
        kwargs = {"action_sequence": self.action_sequence, "random_orientation": self.random_orientation}
        size = environment.in_hand_size
        return kwargs if size is None else {**kwargs, "in_hand_size": size}


# Each line: name, number of objects, optimal and maximum number of steps, number of expert episodes.
OPEN_LOOP = """
OpenLoopBlockStacking 4 6 10 200
OpenLoopHouseBuilding1 4 6 10 200
OpenLoopHouseBuilding2 3 4 10 200
OpenLoopHouseBuilding3 4 6 10 200
OpenLoopHouseBuilding4 6 10 20 200
OpenLoopImproviseHouseBuilding2 3 4 10 200
OpenLoopImproviseHouseBuilding3 4 6 10 200
OpenLoopBinPacking 8 16 20 200
OpenLoopBottleArrangement 6 12 20 200
OpenLoopBoxPalletizing 18 36 40 200
OpenLoopCovidTest 6 18 30 500
OpenLoopObjectGrasping 15 1 1 200
"""
"""Environments of the paper's Open-Loop 2D and 3D Benchmarks."""
RAMP = """
OpenLoopRampBlockStacking 4 6 10 1000
OpenLoopRampHouseBuilding1 4 6 10 1000
OpenLoopRampHouseBuilding2 3 4 10 1000
OpenLoopRampHouseBuilding3 4 6 10 1000
OpenLoopRampHouseBuilding4 6 10 20 1000
OpenLoopRampImproviseHouseBuilding2 3 4 10 1000
OpenLoopRampImproviseHouseBuilding3 4 6 10 1000
"""
"""Environments on ramps of the paper's Open-Loop 6D Benchmark."""
BUMP = """
OpenLoopBumpHouseBuilding4 6 12 20 200
OpenLoopBumpBoxPalletizing 18 36 40 200
"""
"""Environments on bumps of that benchmark. House Building 4 has 12 steps: no cube starts on the platform."""
CLOSE_LOOP = """
CloseLoopBlockReaching 1 3 50 100
CloseLoopBlockPicking 1 7 50 100
CloseLoopBlockPushing 1 7 50 100
CloseLoopBlockPulling 2 7 50 100
CloseLoopBlockInBowl 2 11 50 100
CloseLoopBlockStacking 2 12 50 100
CloseLoopHouseBuilding 2 12 50 100
CloseLoopCornerPicking 1 14 50 100
CloseLoopDrawerOpening 1 9 50 100
CloseLoopObjectGrasping 5 7 50 100
"""
"""Environments of the paper's Close-Loop 3D and 4D Benchmarks."""


def _environments(table: str, in_hand_size: int | None = None) -> tuple[BenchmarkEnv, ...]:
    rows = []
    for line in table.strip().splitlines():
        name, *numbers = line.split()
        objects, optimal, most, episodes = map(int, numbers)
        rows.append(BenchmarkEnv(f"{NAMESPACE}/{name}-v0", objects, optimal, most, episodes, in_hand_size))
    return tuple(rows)


_BASIC, _DELTA = _environments(OPEN_LOOP, IN_HAND), _environments(CLOSE_LOOP)
_SLOPING = _environments(RAMP, IN_HAND) + _environments(BUMP, BUMP_IN_HAND)

open_loop_2d = Benchmark("open_loop_2d", _BASIC, "pxy", False)
open_loop_3d = Benchmark("open_loop_3d", _BASIC, "pxyr", True)
open_loop_6d = Benchmark("open_loop_6d", _SLOPING, "pxyzrrr", True)
close_loop_3d = Benchmark("close_loop_3d", _DELTA, "pxyz", False)
close_loop_4d = Benchmark("close_loop_4d", _DELTA, "pxyzr", True)

BENCHMARKS: Mapping[str, Benchmark] = {
    made.name: made for made in (open_loop_2d, open_loop_3d, open_loop_6d, close_loop_3d, close_loop_4d)
}
"""All benchmarks, by name."""
