"""The five benchmarks of the paper as data: the tables of its section Benchmark."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bulletarm_gym.registry import NAMESPACE

OPEN_LOOP_EPISODES = 200
"""Episodes of expert data before training (paper, Open-Loop 3D and, on bumps, 6D Benchmark)."""
COVID_EPISODES = 500
"""As many for Covid Test (paper, Open-Loop 3D Benchmark)."""
RAMP_EPISODES = 1000
"""As many on ramps (paper, Open-Loop 6D Benchmark)."""
CLOSE_LOOP_EPISODES = 100
"""As many in close loop (paper, Close-Loop 4D Benchmark)."""
IN_HAND = 24
BUMP_IN_HAND = 40
"""Pixels a side of the in-hand image, and on bumps (paper, Benchmark Details)."""


@dataclass(frozen=True)
class BenchmarkEnv:
    """An environment in a benchmark.

    :param num_objects: objects in the scene
    :param optimal_steps: of a best policy, an episode
    :param max_steps: of an episode
    :param expert_episodes: of expert data before training
    :param in_hand_size: pixels a side of the in-hand image, None in close loop
    """

    env_id: str
    num_objects: int
    optimal_steps: int
    max_steps: int
    expert_episodes: int
    in_hand_size: int | None = None


@dataclass(frozen=True)
class Benchmark:
    """Environments to be solved in one action space.

    :param random_orientation: whether objects start with random orientations
    """

    name: str
    environments: tuple[BenchmarkEnv, ...]
    action_sequence: str
    random_orientation: bool

    def make_kwargs(self, environment: BenchmarkEnv) -> dict[str, Any]:
        """Return what :func:`gymnasium.make` takes for one of the environments besides its id."""
        kwargs = {"action_sequence": self.action_sequence, "random_orientation": self.random_orientation}
        size = environment.in_hand_size
        return kwargs if size is None else {**kwargs, "in_hand_size": size}


# Name, number of objects, optimal and maximal number of steps.
_OPEN_LOOP = (
    ("BlockStacking", 4, 6, 10),
    ("HouseBuilding1", 4, 6, 10),
    ("HouseBuilding2", 3, 4, 10),
    ("HouseBuilding3", 4, 6, 10),
    ("HouseBuilding4", 6, 10, 20),
    ("ImproviseHouseBuilding2", 3, 4, 10),
    ("ImproviseHouseBuilding3", 4, 6, 10),
    ("BinPacking", 8, 16, 20),
    ("BottleArrangement", 6, 12, 20),
    ("BoxPalletizing", 18, 36, 40),
    ("CovidTest", 6, 18, 30),
    ("ObjectGrasping", 15, 1, 1),
)
"""Paper, table of the Open-Loop 3D Benchmark."""
_CLOSE_LOOP = (
    ("BlockReaching", 1, 3, 50),
    ("BlockPicking", 1, 7, 50),
    ("BlockPushing", 1, 7, 50),
    ("BlockPulling", 2, 7, 50),
    ("BlockInBowl", 2, 11, 50),
    ("BlockStacking", 2, 12, 50),
    ("HouseBuilding", 2, 12, 50),
    ("CornerPicking", 1, 14, 50),
    ("DrawerOpening", 1, 9, 50),
    ("ObjectGrasping", 5, 7, 50),
)
"""Paper, table of the Close-Loop 4D Benchmark."""
_RAMP = _OPEN_LOOP[:7]
"""Paper, Open-Loop 6DoF Environments: the block structure tasks, with the numbers of the 3D benchmark."""
_BUMP = (("HouseBuilding4", 6, 12, 20), ("BoxPalletizing", 18, 36, 40))
"""Paper, Open-Loop 6DoF Environments: no cube lies on the platform at the start, so House Building 4 takes a
pick and a place an object."""


def _environments(
    prefix: str, rows: tuple[tuple[str, int, int, int], ...], episodes: int, in_hand_size: int | None = None
) -> tuple[BenchmarkEnv, ...]:
    return tuple(
        BenchmarkEnv(
            f"{NAMESPACE}/{prefix}{name}-v0",
            objects,
            optimal,
            most,
            COVID_EPISODES if name == "CovidTest" else episodes,
            in_hand_size,
        )
        for name, objects, optimal, most in rows
    )


_BASIC = _environments("OpenLoop", _OPEN_LOOP, OPEN_LOOP_EPISODES, IN_HAND)
_DELTA = _environments("CloseLoop", _CLOSE_LOOP, CLOSE_LOOP_EPISODES)

open_loop_2d = Benchmark("open_loop_2d", _BASIC, "pxy", False)
"""The twelve basic tasks, objects with fixed orientation, actions A_g x A^xy."""

open_loop_3d = Benchmark("open_loop_3d", _BASIC, "pxyr", True)
"""The twelve basic tasks, objects with random orientation, actions A_g x A^xytheta."""

open_loop_6d = Benchmark(
    "open_loop_6d",
    (
        *_environments("OpenLoopRamp", _RAMP, RAMP_EPISODES, IN_HAND),
        *_environments("OpenLoopBump", _BUMP, OPEN_LOOP_EPISODES, BUMP_IN_HAND),
    ),
    "pxyzrrr",
    True,
)
"""Seven tasks on ramps and two on bumps, actions A_g x A^SE(3)."""

close_loop_3d = Benchmark("close_loop_3d", _DELTA, "pxyz", False)
"""The ten close-loop tasks, objects with fixed orientation, actions A_lambda x A_delta^xyz."""

close_loop_4d = Benchmark("close_loop_4d", _DELTA, "pxyzr", True)
"""The ten close-loop tasks, objects with random orientation, actions A_lambda x A_delta^xyztheta."""

BENCHMARKS: Mapping[str, Benchmark] = {
    made.name: made for made in (open_loop_2d, open_loop_3d, open_loop_6d, close_loop_3d, close_loop_4d)
}
"""All five, by name."""
