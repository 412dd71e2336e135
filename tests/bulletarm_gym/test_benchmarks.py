"""Benchmarks: the numbers of the paper's tables are the defaults of the registered environments."""

import pytest

import bulletarm_gym
from bulletarm_gym.benchmarks import BENCHMARKS
from bulletarm_gym.config import Context, EnvConfig
from bulletarm_gym.registry import PAPER, load

EPISODES = {"CovidTest": 500, "Ramp": 1000, "OpenLoop": 200, "CloseLoop": 100}
"""Number of expert episodes by the first word that is in an id."""
SEQUENCES = {
    "open_loop_2d": "pxy",
    "open_loop_3d": "pxyr",
    "open_loop_6d": "pxyzrrr",
    "close_loop_3d": "pxyz",
    "close_loop_4d": "pxyzr",
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_benchmarks_have_the_papers_numbers(name):
    benchmark = BENCHMARKS[name]
    rotates = "r" in SEQUENCES[name]
    assert (benchmark.action_sequence, benchmark.random_orientation) == (SEQUENCES[name], rotates)
    for row in benchmark.environments:
        assert row.expert_episodes == next(count for word, count in EPISODES.items() if word in row.env_id)
        size = 40 if "Bump" in row.env_id else 24 if "OpenLoop" in row.env_id else None
        assert benchmark.make_kwargs(row).get("in_hand_size") == size
        recipe = PAPER[row.env_id]
        context = Context(recipe["control"], load(recipe["task"]).defaults, recipe["surface"])
        config = EnvConfig.of(context, benchmark.make_kwargs(row), recipe.get("defaults"))
        assert (config.num_objects, config.max_steps) == (row.num_objects, row.max_steps)
        assert row.optimal_steps <= row.max_steps


def test_every_environment_of_the_benchmarks_is_registered():
    listed = {env.env_id for benchmark in BENCHMARKS.values() for env in benchmark.environments}
    assert set(bulletarm_gym.PAPER_IDS) == listed and len(listed) == 31
