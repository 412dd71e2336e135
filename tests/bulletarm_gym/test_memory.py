"""Memory stays flat and physics servers are released."""

import gc

import psutil
import pybullet
from rollouts import make_env

from bulletarm_gym.env import ManipulationEnv

MEGABYTE = 2**20
PICKING = "BulletArm/CloseLoopBlockPicking-v0"
MOST_SERVERS = 1024


def servers() -> int:
    return sum(bool(pybullet.isConnected(number)) for number in range(MOST_SERVERS))


def used() -> int:
    gc.collect()
    return int(psutil.Process().memory_info().rss)


def play(env: ManipulationEnv, episodes: int) -> None:
    for _ in range(episodes):
        env.reset()
        env.step(env.expert_action())


def test_resets_do_not_grow(env: ManipulationEnv) -> None:
    play(env, 15)
    before = used()
    play(env, 30)
    assert used() - before < 2.5 * MEGABYTE


def test_states_do_not_grow(picking: ManipulationEnv) -> None:
    picking.reset(seed=0)
    for _ in range(50):
        picking.set_state(picking.get_state())
    before = used()
    for _ in range(500):
        picking.set_state(picking.get_state())
    assert used() - before < 4 * MEGABYTE


def test_closing_releases_the_server() -> None:
    before = servers()
    env = make_env(PICKING)
    assert servers() == before + 1
    env.close()
    assert servers() == before


def test_thirty_environments_in_turn() -> None:
    before = servers()
    for _ in range(30):
        make_env(PICKING).close()
    assert servers() == before


def test_what_is_closed_leaves_nothing_for_the_collector(paper_id: str) -> None:
    make_env(paper_id).close()
    gc.collect()
    before = len(gc.get_objects())
    for _ in range(3):
        make_env(paper_id).close()
    gc.collect()
    assert len(gc.get_objects()) - before < 100


def test_forgotten_environment_releases_its_server() -> None:
    gc.collect()
    before = servers()
    env = make_env(PICKING)
    env.reset(seed=0)
    del env
    gc.collect()
    assert servers() == before


def test_refused_environment_leaves_no_server() -> None:
    gc.collect()
    before = servers()
    for parameters in ({"robot": "nobody"}, {"reward": "nowhere:nothing"}):
        try:
            make_env(PICKING, **parameters)
        except ValueError:
            continue
        raise AssertionError("it should have been refused")
    assert servers() == before
