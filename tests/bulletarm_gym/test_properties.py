"""Physical properties that a task changes are part of the state, until the next reset."""

import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rollouts import digest, mixed_action, step_on, transcript

from bulletarm_gym.demonstrations import json_state
from bulletarm_gym.env import ManipulationEnv
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation.state import Properties
from bulletarm_gym.tasks.picking import BlockPicking

CHANGES = {
    "mass": 0.08,
    "friction": 0.7,
    "rolling_friction": 1e-3,
    "spinning_friction": 2e-3,
    "restitution": 0.1,
}
GREEN = (0.1, 0.9, 0.2, 1.0)


class VariedPicking(BlockPicking):
    """Block picking with a cube of another mass, friction and colour in each episode."""

    def arrange(self, scene: Scene, rng: np.random.Generator) -> None:
        """Place the cube and change its properties."""
        super().arrange(scene, rng)
        factor = float(rng.uniform(0.5, 2.0))
        changes = {name: factor * value for name, value in CHANGES.items()}
        scene["cube"].set_properties(**changes, colour=(factor / 2.0, 0.9, 0.2, 1.0))


def varied(surface: str = "flat", **parameters: Any) -> ManipulationEnv:
    observation = ["heightmap", "color", "state"]
    parameters = {"obs_size": 32, "observation": observation, **parameters}
    return ManipulationEnv("test_properties:VariedPicking", "close_loop", surface, **parameters)


def in_engine(env: ManipulationEnv) -> tuple[Any, ...]:
    """Return the engine's dynamics and colour of the cube."""
    client, body = env.scene.world.client, env.scene["cube"].body
    (shape,) = client.getVisualShapeData(body.id)
    return (*client.getDynamicsInfo(body.id, -1)[:8], tuple(np.float32(shape[7]).tolist()))


def test_properties_are_in_effect_until_the_next_reset(picking: ManipulationEnv) -> None:
    expected = transcript(picking, 20, seed=0)
    picking.reset(seed=0)
    item = picking.scene["cube"]
    before = in_engine(picking)
    item.set_properties(**CHANGES, colour=GREEN)
    assert item.properties == Properties(**CHANGES, colour=GREEN)
    mass, friction, inertia, _, _, restitution, rolling, spinning, colour = in_engine(picking)
    assert (mass, friction, restitution, rolling, spinning) == (0.08, 0.7, 0.1, 1e-3, 2e-3)
    np.testing.assert_allclose(inertia, np.array(before[2]) * 0.08 / item.spec.mass)
    assert colour == pytest.approx(GREEN)
    item.set_properties(mass=0.2)
    assert item.properties.mass == 0.2 and item.properties.friction == 0.7
    picking.reset(seed=0)
    assert item.properties == Properties.of(item.spec) and in_engine(picking) == before
    assert transcript(picking, 20, seed=0) == expected


def test_state_keeps_properties() -> None:
    env, other, fresh = varied(), varied(), varied()
    env.reset(seed=0)
    for _ in range(4):
        step_on(env, env.expert_action())
    state = env.get_state()
    assert state.world.properties
    assert json_state.loads(json_state.dumps(state)) == state == pickle.loads(pickle.dumps(state))

    def rollout(env: ManipulationEnv) -> list[str]:
        env.set_state(state)
        rng = np.random.default_rng(0)
        return [digest(env.observe()), *(digest(*step_on(env, mixed_action(env, rng))) for _ in range(12))]

    expected, properties = rollout(env), in_engine(env)
    other.reset(seed=7)
    for one in (other, fresh):
        assert rollout(one) == expected and in_engine(one) == properties
    other.scene.world.reset_properties()
    env.set_state(other.get_state())
    assert env.scene["cube"].properties == Properties.of(env.scene["cube"].spec)
    for one in (env, other, fresh):
        one.close()


def test_colour_in_effect_is_observed_and_rendered() -> None:
    env = varied(render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    red = round(255.0 * env.scene["cube"].properties.colour[0])

    def is_visible(observation: Any) -> bool:
        return bool((observation["color"].reshape(3, -1).T == (red, 230, 51)).all(axis=1).any())

    assert is_visible(observation)
    before = env.render()
    env.scene["cube"].set_properties(colour=(0.0, 0.0, 1.0, 1.0))
    assert not is_visible(env.observe()) and (env.render() != before).any()
    env.close()


@pytest.mark.parametrize(
    ("slot", "name", "value"),
    [
        ("cube", "mass", 0.0),
        ("cube", "friction", -0.1),
        ("cube", "restitution", float("nan")),
        ("cube", "colour", (0.1, 0.2, 0.3)),
        ("cube", "colour", (0.1, 0.2, 0.3, 1.1)),
        ("corner", "mass", 1.0),
    ],
)
def test_property_out_of_range_is_rejected(
    make: Callable[..., ManipulationEnv], slot: str, name: str, value: Any
) -> None:
    env = make("BulletArm/CloseLoopCornerPicking-v0")
    env.reset(seed=0)
    before = env.scene[slot].properties
    with pytest.raises(ValueError, match=rf"^{name} must be .*, got "):
        env.scene[slot].set_properties(**{name: value})
    with pytest.raises(TypeError, match="weight"):
        env.scene[slot].set_properties(weight=1.0)
    assert env.scene[slot].properties == before


def test_cube_with_less_friction_slides_down_a_ramp() -> None:
    env = varied("ramp")
    for seed in range(20):
        env.reset(seed=seed)
        item = env.scene["cube"]
        if item.pose.tilt >= 0.2:
            break
    item.set_properties(friction=0.02)
    before = item.pose
    step_on(env, np.zeros(env.action_space.shape))
    assert before.tilt >= 0.2 and item.pose.position != before.position
    env.close()


def test_surface_without_friction_moves_a_resting_cube() -> None:
    env, other = varied("ramp"), varied("ramp")
    for seed in range(20):
        env.reset(seed=seed)
        if env.scene["cube"].pose.tilt >= 0.2:
            break
    env.scene.set_surface_properties(friction=0.0)
    before, state = env.scene["cube"].pose, env.get_state()
    assert {env.scene.world.get_properties(body).friction for body in env.scene.surface.bodies} == {0.0}
    other.set_state(state)
    results = [digest(*step_on(one, np.zeros(one.action_space.shape))) for one in (env, other)]
    assert results[0] == results[1] and env.scene["cube"].pose.position != before.position
    with pytest.raises(ValueError, match="friction must be "):
        env.scene.set_surface_properties(friction=-1.0)
    env.reset(seed=0)
    assert {env.scene.world.get_properties(body).friction for body in env.scene.surface.bodies} == {1.0}
    env.close()
    other.close()
