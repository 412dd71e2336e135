"""The five benchmarks of the paper as data: the tables of its section Benchmark."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bulletarm_gym.registry import NAMESPACE

OPEN_LOOP_EPISODES = 200
"""Number of expert episodes (paper, Open-Loop 3D and, on bumps, 6D Benchmark)."""
COVID_EPISODES = 500
"""Number of expert episodes of Covid Test (paper, Open-Loop 3D Benchmark)."""
RAMP_EPISODES = 1000
"""Number of expert episodes on ramps (paper, Open-Loop 6D Benchmark)."""
CLOSE_LOOP_EPISODES = 100
"""Number of expert episodes in closed-loop control (paper, Close-Loop 4D Benchmark)."""
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


OPEN_LOOP = """
BlockStacking 4 6 10
HouseBuilding1 4 6 10
HouseBuilding2 3 4 10
HouseBuilding3 4 6 10
HouseBuilding4 6 10 20
ImproviseHouseBuilding2 3 4 10
ImproviseHouseBuilding3 4 6 10
BinPacking 8 16 20
BottleArrangement 6 12 20
BoxPalletizing 18 36 40
CovidTest 6 18 30
ObjectGrasping 15 1 1
"""
"""Name, number of objects, optimal and maximum number of steps (paper, Open-Loop 3D Benchmark)."""
CLOSE_LOOP = """
BlockReaching 1 3 50
BlockPicking 1 7 50
BlockPushing 1 7 50
BlockPulling 2 7 50
BlockInBowl 2 11 50
BlockStacking 2 12 50
HouseBuilding 2 12 50
CornerPicking 1 14 50
DrawerOpening 1 9 50
ObjectGrasping 5 7 50
"""
"""Name, number of objects, optimal and maximum number of steps (paper, Close-Loop 4D Benchmark)."""
RAMP = "\n".join(OPEN_LOOP.strip().splitlines()[:7])
"""Block structure tasks, with the numbers of the 3D benchmark (paper, Open-Loop 6DoF Environments)."""
BUMP = """
HouseBuilding4 6 12 20
BoxPalletizing 18 36 40
"""
"""The same on bumps. House Building 4 has 12 steps, as no cube starts on the platform."""


def _environments(
    prefix: str, table: str, episodes: int, in_hand_size: int | None = None
) -> tuple[BenchmarkEnv, ...]:
    found = []
    for name, *numbers in map(str.split, table.strip().splitlines()):
        objects, optimal, most = map(int, numbers)
        experts = COVID_EPISODES if name == "CovidTest" else episodes
        env_id = f"{NAMESPACE}/{prefix}{name}-v0"
        found.append(BenchmarkEnv(env_id, objects, optimal, most, experts, in_hand_size))
    return tuple(found)


_BASIC = _environments("OpenLoop", OPEN_LOOP, OPEN_LOOP_EPISODES, IN_HAND)
_DELTA = _environments("CloseLoop", CLOSE_LOOP, CLOSE_LOOP_EPISODES)
_SLOPING = (
    *_environments("OpenLoopRamp", RAMP, RAMP_EPISODES, IN_HAND),
    *_environments("OpenLoopBump", BUMP, OPEN_LOOP_EPISODES, BUMP_IN_HAND),
)

open_loop_2d = Benchmark("open_loop_2d", _BASIC, "pxy", False)
"""Twelve basic tasks, objects with fixed orientation, actions A_g x A^xy."""

open_loop_3d = Benchmark("open_loop_3d", _BASIC, "pxyr", True)
"""Twelve basic tasks, objects with random orientation, actions A_g x A^xytheta."""

open_loop_6d = Benchmark("open_loop_6d", _SLOPING, "pxyzrrr", True)
"""Seven tasks on ramps and two on bumps, actions A_g x A^SE(3)."""

close_loop_3d = Benchmark("close_loop_3d", _DELTA, "pxyz", False)
"""Ten closed-loop tasks, objects with fixed orientation, actions A_lambda x A_delta^xyz."""

close_loop_4d = Benchmark("close_loop_4d", _DELTA, "pxyzr", True)
"""Ten closed-loop tasks, objects with random orientation, actions A_lambda x A_delta^xyztheta."""

BENCHMARKS: Mapping[str, Benchmark] = {
    made.name: made for made in (open_loop_2d, open_loop_3d, open_loop_6d, close_loop_3d, close_loop_4d)
}
"""All benchmarks, by name."""
