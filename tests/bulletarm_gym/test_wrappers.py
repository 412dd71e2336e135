"""Wrappers and vector environments: images, action spaces of the expert, goals for HER, several tasks."""

import math
import pickle
import warnings
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from gymnasium.utils.env_checker import check_env as check_gymnasium
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from rollouts import TYPICAL, advance
from stable_baselines3.common.env_checker import check_env as check_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import bulletarm_gym  # noqa: F401
from bulletarm_gym.geometry import Pose
from bulletarm_gym.vector import CommonSpaces, make_multi_task_vec, reset_to_states
from bulletarm_gym.wrappers import GoalObservation, ImageObservation

CLOSE, OPEN = "BulletArm/CloseLoopBlockPicking-v0", "BulletArm/OpenLoopRampBlockStacking-v0"
HALF_A_COUNT = 0.5 / 255


class Sensors(gymnasium.Env[dict[str, Any], Any]):
    """Observes an image of bytes, a smaller one of numbers, and two numbers."""

    observation_space: Any = spaces.Dict(
        colour=spaces.Box(0, 255, (3, 8, 8), np.uint8),
        depth=spaces.Box(-1.0, 1.0, (1, 4, 4), np.float32),
        pair=spaces.Box(np.array([0, -2], np.float32), np.array([1, 2], np.float32)),
    )
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def reset(self, **_):
        colour = np.arange(192, dtype=np.uint8).reshape(3, 8, 8)
        return {"colour": colour, "depth": np.full((1, 4, 4), 0.5), "pair": np.array([1.0, -1.0])}, {}


def test_every_image_and_number_is_a_channel():
    env, last = ImageObservation(Sensors()), ImageObservation(Sensors(), channels_last=True)
    assert env.channels == ("colour_0", "colour_1", "colour_2", "depth", "pair_0", "pair_1")
    image, seen = env.reset()[0], Sensors().reset()[0]
    assert image in env.observation_space
    np.testing.assert_array_equal(image[:3], seen["colour"])
    np.testing.assert_array_equal(image[3:], np.broadcast_to([[[191]], [[255]], [[64]]], (3, 8, 8)))
    assert last.reset()[0] in last.observation_space
    np.testing.assert_array_equal(last.reset()[0], image.transpose(1, 2, 0))
    images = env.images({key: np.stack([value, 0 * value]) for key, value in seen.items()})
    np.testing.assert_array_equal(images[0], image)
    np.testing.assert_array_equal(images[1][:, 0, 0], [0, 0, 0, 128, 0, 128])


@pytest.mark.parametrize("env_id", [CLOSE, OPEN])
def test_image_of_an_environment(env_id):
    env = ImageObservation(gymnasium.make(env_id, obs_size=48))
    check(env)
    image, _ = env.reset(seed=0)
    inner = env.unwrapped
    heightmap = inner.observe()["heightmap"][0]
    assert np.abs(image[env.channels.index("heightmap")] / 255 - heightmap / 0.4).max() < 1.01 * HALF_A_COUNT
    assert wrappers.FrameStackObservation(env, 2).reset(seed=0)[0].shape == (2, *image.shape)


def test_resizing_keeps_means_and_positions():
    large, small = gymnasium.make(OPEN), ImageObservation(gymnasium.make(OPEN), 32)
    observation, _ = large.reset(seed=3)
    image, _ = small.reset(seed=3)
    blocks = observation["heightmap"][0].reshape(32, 4, 32, 4).mean(axis=(1, 3)) / 0.4
    assert np.corrcoef(blocks.ravel(), image[0].ravel())[0, 1] > 0.98
    assert abs(blocks.mean() - image[0].mean() / 255) < HALF_A_COUNT
    again = gymnasium.make(small.spec)
    assert again.observation_space == small.observation_space
    assert pickle.loads(pickle.dumps(again)).observation_space == small.observation_space


class Doubled(gymnasium.ActionWrapper):
    """A user's wrapper with an inverse."""

    def action(self, action):
        return 2.0 * action

    def revert_action(self, action):
        return action / 2.0


rescale = partial(wrappers.RescaleAction, min_action=np.float32(-3.0), max_action=np.float32(1.0))
INVERTIBLE = {
    "observed": [wrappers.RecordEpisodeStatistics],
    "rescaled twice": [rescale, partial(rescale, max_action=np.float32(5.0))],
    "clipped": [wrappers.ClipAction],
    "own": [Doubled, rescale],
}
OTHERS = {
    "TransformAction": [partial(wrappers.TransformAction, func=np.negative, action_space=None)],
    "StickyAction": [partial(wrappers.StickyAction, repeat_action_probability=0.5)],
    "DiscretizeAction": [rescale, partial(wrappers.DiscretizeAction, bins=3)],
}


def wrapped(*layers):
    env = gymnasium.make(CLOSE, obs_size=16)
    for layer in layers:
        env = layer(env)
    return env


@pytest.mark.parametrize("name", INVERTIBLE)
def test_expert_acts_in_the_outermost_action_space(name, monkeypatch):
    env = wrapped(*INVERTIBLE[name])
    core = env.unwrapped
    expert, step, executed = env.get_wrapper_attr("expert_action"), core.step, []
    env.reset(seed=3)
    monkeypatch.setattr(core, "step", lambda action: executed.append(action) or step(action))
    for _ in range(4):
        wanted, action = core.expert_action(), expert()
        env.step(action)
        assert action in env.action_space
        np.testing.assert_allclose(executed[-1], wanted, atol=1e-6)


@pytest.mark.parametrize("name", OTHERS)
def test_expert_names_the_wrapper_without_an_inverse(name):
    env = wrapped(*OTHERS[name])
    with pytest.raises(ValueError, match=rf"expert_action .*, got {name}\."):
        wrappers.RecordEpisodeStatistics(env).get_wrapper_attr("expert_action")
    assert env.has_wrapper_attr("expert_action")


class Residual(gymnasium.Wrapper):
    """Adds actions to those of the expert."""

    def step(self, action):
        self.expected = self.unwrapped.expert_action()
        self.found = self.env.get_wrapper_attr("expert_action")()
        return self.env.step(np.clip(self.found + action, -1.0, 1.0))


def test_a_wrapper_queries_the_expert_of_the_environment_inside():
    env = wrapped(Residual, rescale)
    env.reset(seed=3)
    env.step(env.action_space.sample())
    np.testing.assert_array_equal(env.get_wrapper_attr("found"), env.get_wrapper_attr("expected"))


TASKS = ("BlockReaching", "BlockPushing", "BlockPulling", "BlockStacking")


def goal_env(task, **parameters):
    parameters = {"observation": "state", **parameters}
    return GoalObservation(gymnasium.make(f"BulletArm/CloseLoop{task}-v0", **parameters))


def check(env):
    """Run the checks of Gymnasium and Stable-Baselines3. They warn only of what wrappers and goals need."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sb3(env)
        warnings.filterwarnings("ignore", ".*(unwrapped version|infinity).*")
        check_gymnasium(env, skip_render_check=True)


@pytest.mark.parametrize(("task", "size"), [*zip(TASKS, (3, 2, 1, 4), strict=True)])
def test_goals_of_the_tasks_are_positions_and_gaps(task, size):
    env = goal_env(task)
    check(env)
    observation, _ = env.reset(seed=0)
    assert observation["achieved_goal"].shape == observation["desired_goal"].shape == (size,)
    if task == "BlockReaching":
        tool, cube = env.unwrapped.scene.robot.pose, env.unwrapped.scene["cube"].pose
        distance = np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"])
        assert distance == pytest.approx(math.dist(tool.position, cube.position))


@pytest.mark.parametrize("task", TASKS)
def test_rewards_are_the_success_of_the_task_in_valid_scenes(task):
    """In every step of the expert, and for all steps at once."""
    env, rng = goal_env(task), np.random.default_rng(0)
    env.action_space.seed(0)
    for seed in range(2):
        observation, info = env.reset(seed=seed)
        steps, rewards, terminated, truncated = [], [], False, False
        while not (terminated or truncated or sum(rewards) > 2.0):
            expert = env.get_wrapper_attr("expert_action")()
            action = env.action_space.sample() if rng.random() < 0.2 else expert
            observation, reward, terminated, truncated, info = env.step(action)
            assert reward == float(info["is_success"]) or not info["is_valid"]
            steps.append((observation["achieved_goal"], observation["desired_goal"]))
            assert terminated == env.compute_terminated(*steps[-1], info)
            rewards.append(reward)
        batch = map(np.stack, zip(*steps, strict=True))
        assert env.compute_reward(*batch, [info] * len(steps)).tolist() == rewards
        assert terminated or sum(rewards) > 0.0


class Truncated(gymnasium.Wrapper):
    """A user's limit of steps, which every step exceeds."""

    def step(self, action):
        observation, reward, terminated, _, info = self.env.step(action)
        return observation, reward, terminated, True, info


def test_episode_continues_after_success_until_the_limit_of_steps():
    env = goal_env("BlockReaching", max_steps=7)
    env.reset(seed=0)
    expert = env.get_wrapper_attr("expert_action")
    rewards, *ends = zip(*(env.step(expert())[1:4] for _ in range(7)), strict=True)
    assert ends == [(False,) * 7, (False,) * 6 + (True,)]
    assert rewards[-1] == 1.0 and 0.0 < sum(rewards) < 7.0 and env.unwrapped.np_random_seed == 0
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())
    limited = GoalObservation(Truncated(env.env))
    limited.reset(seed=0)
    assert {limited.step(expert())[2:4] for _ in range(7)} == {(False, True)}


def test_stack_above_the_surface_is_no_goal():
    env = goal_env("BlockStacking")
    env.reset(seed=0)
    core = env.unwrapped
    for height, reward in ((0.0, 1.0), (0.05, 0.0)):
        for number, cube in enumerate(core.scene.objects):
            cube.place(Pose.planar(0.45, 0.0, height + 0.025 + 0.05 * number))
        assert env.compute_reward(*core.task.goals(core.scene), {}) == reward


def test_experts_of_stable_baselines3_members_solve_the_task():
    for make, env_id in ((DummyVecEnv, TYPICAL[0]), (partial(SubprocVecEnv, start_method="fork"), CLOSE)):
        vec_env = make([partial(gymnasium.make, f"bulletarm_gym:{env_id}", obs_size=32)] * 2)
        vec_env.seed(0)
        vec_env.reset()
        solved = np.zeros(2, bool)
        for _ in range(25):
            _, _, dones, infos = vec_env.step(np.stack(vec_env.env_method("expert_action")))
            solved |= dones & np.array([info["is_success"] for info in infos])
        vec_env.close()
        assert solved.all()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_members_begin_at_states(make, mode):
    """The last state is within an episode."""
    env = make(CLOSE, obs_size=32)
    states = [advance(env, 40 + seed, steps) for seed, steps in enumerate((0, 0, 1))]
    expected = [env.reset(options={"state": state})[0]["heightmap"] for state in states]
    vector = gymnasium.make_vec(CLOSE, 3, mode, obs_size=32)
    vector.reset(seed=0)
    for _ in range(2):
        observations, infos = reset_to_states(vector, states)
        np.testing.assert_array_equal(observations["heightmap"], expected)
        assert infos["is_valid"].tolist() == [True] * 3
        assert list(vector.call("get_state")) == states
        ended = False
        # Afterwards Gymnasium resets some members at the next step, unless they begin at states.
        while not ended:
            *_, terminations, truncations, _ = vector.step(np.stack(vector.call("expert_action")))
            ended = bool((terminations | truncations).any())
    reset_to_states(vector, states)
    vector.step(np.zeros((3, 5), np.float32))
    assert [state.steps for state in vector.call("get_state")] == [state.steps + 1 for state in states]
    with pytest.raises(ValueError, match=r"^states must be 3 states, one per member, got 2"):
        reset_to_states(vector, states[:2])
    vector.close()
    apart = gymnasium.make_vec(CLOSE, 3, "async", vector_kwargs={"shared_memory": False}, obs_size=32)
    with pytest.raises(ValueError, match=r"^envs must have shared_memory=True, got shared_memory=False$"):
        reset_to_states(apart, states)
    apart.close()


CLOSE_LOOP = [f"BulletArm/CloseLoop{name}-v0" for name in ("BlockPicking", "BlockStacking", "BlockSorting")]
OPEN_LOOP = ["BulletArm/OpenLoopBlockStacking-v0", "BulletArm/OpenLoopRampBlockStacking-v0"]


@pytest.mark.parametrize(
    ("ids", "kwargs", "sequence"),
    [
        (CLOSE_LOOP, {}, "pxyzr"),
        (OPEN_LOOP, {"in_hand_size": 24, "observation": ["heightmap", "holding"]}, "pxyzrrr"),
    ],
    ids=["close loop", "open loop"],
)
def test_experts_solve_several_tasks_in_common_spaces(ids, kwargs, sequence):
    vector = make_multi_task_vec(ids, obs_size=32, **kwargs)
    space = vector.single_observation_space
    assert vector.call("action_sequence") == (sequence,) * len(ids)
    assert vector.single_action_space.shape == (len(sequence),)
    observations, _ = vector.reset(seed=0)
    np.testing.assert_array_equal(observations["task_id"], np.eye(len(ids)))
    solved = np.zeros(len(ids), bool)
    for _ in range(60):
        actions = np.stack(vector.call("expert_action"))
        observations, rewards, *_ = vector.step(actions)
        assert actions in vector.action_space and observations in vector.observation_space
        solved |= rewards == 1.0
    vector.close()
    assert solved.all()
    if ids is CLOSE_LOOP:
        assert space["color"].shape == (3, 32, 32) and observations["color"][2].any()
        assert not observations["color"][:2].any()


def test_infos_are_those_of_the_states():
    mass = "randomization/object_mass"
    vector = make_multi_task_vec([CLOSE, CLOSE], obs_size=32, randomization={"object_mass": [0.5, 1.5]})
    plain = gymnasium.make(CLOSE, obs_size=32).unwrapped
    vector.reset(seed=0)
    plain.reset(seed=0)
    states = [plain.get_state(), vector.call("get_state")[1]]
    expected = dict(states[1].sampled)["object_mass"]
    for _ in range(2):
        _, infos = reset_to_states(vector, states)
        assert infos["_" + mass].tolist() == [False, True] and infos[mass].tolist() == [0.0, expected]
        _, infos = reset_to_states(vector, states[::-1])
        assert infos["_" + mass].tolist() == [True, False] and infos["_is_valid"].all()
    vector.close()
    plain.close()


def test_numbers_of_other_tasks_do_not_change_the_result():
    """The flat task has pxyr, the ramp pxyzrrr; vectors are padded at the end."""
    vector = make_multi_task_vec(OPEN_LOOP, obs_size=32, observation=["heightmap", "holding"])
    flat = vector.envs[0]
    known, results = np.array([-1.0, 0.1, 0.2, 0.3], np.float32), []
    for others in (0.0, 0.5):
        flat.reset(seed=1)
        action = np.insert(known, [3, 4, 4], others)
        results.append(flat.step(action)[0])
    np.testing.assert_equal(*results)
    core = flat.unwrapped
    core.reset(seed=1)
    np.testing.assert_array_equal(core.step(known)[0]["heightmap"], results[0]["heightmap"])
    np.testing.assert_array_equal(flat.revert_action(known)[[0, 1, 2, 4]], known)
    with pytest.raises(ValueError, match=r"^action must have the shape \(7,\), got \(4,\)"):
        flat.step(known)


def test_members_of_several_tasks_run_in_processes_and_begin_at_states():
    """Equal to those of one process; vectors are padded at the end."""
    results = []
    for kind in (SyncVectorEnv, AsyncVectorEnv):
        vector = make_multi_task_vec(CLOSE_LOOP[:2], 2, vec_env_cls=kind, observation=["state"])
        found = [vector.reset(seed=5)[0]["state"]]
        states = vector.call("get_state")
        found.append(vector.step(np.stack(vector.call("expert_action")))[0]["state"])
        _, infos = reset_to_states(vector, states)
        assert vector.call("get_state") == states
        assert infos["_is_held"].tolist() == [True] * 2 + [False] * 2
        assert infos["_is_stacked"].tolist() == [False] * 2 + [True] * 2
        results.append(found)
        vector.close()
    np.testing.assert_equal(*results)
    assert not found[0][:2, -3:].any() and found[0][2:, -3:].any()


def test_a_member_passes_the_checks_and_is_made_again_from_its_spec():
    vector = make_multi_task_vec([CLOSE_LOOP[0], CLOSE_LOOP[2]], obs_size=36)  # its end closes the members
    env = vector.envs[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_gymnasium(env, skip_render_check=True)
        check_sb3(env)
    again = gymnasium.make(env.spec)
    assert again.observation_space == env.observation_space and again.action_space == env.action_space
    np.testing.assert_equal(again.reset(seed=2)[0], env.reset(seed=2)[0])


def common_spaces(env, sequence, task):
    """Return an environment of two tasks with the spaces of this one."""
    space = spaces.Dict({**env.observation_space, "task_id": spaces.Box(0.0, 1.0, (2,), np.float32)})
    return CommonSpaces(env, space, sequence, task)


TASK_ID = [{"name": "task_id", "sensor": "holding"}]
REFUSED = [
    (lambda env: ImageObservation(gymnasium.make(CLOSE, observation="state")), "env must .*, got 'state'"),
    (lambda env: ImageObservation(ImageObservation(Sensors())), "env must observe a Dict .*, got Box"),
    (lambda env: ImageObservation(env, 0), "size must .*, got 0"),
    (lambda env: goal_env("BlockPicking"), ".*BlockPicking is not goal-conditioned"),
    (lambda env: goal_env("DrawerOpening"), ".*DrawerOpening is not goal-conditioned"),
    (lambda env: goal_env("BlockReaching", observation="image"), r"env must observe vectors, got Dict\("),
    (lambda env: common_spaces(env, "pxyz", 0), "action_sequence must be .*, got "),
    (lambda env: common_spaces(env, "pxyzr", -1), "task must be .*, got "),
    (lambda env: make_multi_task_vec([]), r"ids must be a list of at least one id, got \[\]"),
    (lambda env: make_multi_task_vec(CLOSE), "ids must be a list of at least one id, got 'BulletArm"),
    (lambda env: make_multi_task_vec([CLOSE, OPEN]), "ids must .* one kind of control, got close_loop, open"),
    (lambda env: make_multi_task_vec(OPEN_LOOP), r"ids must observe 'in_hand' .*, got .*\(1, 24, 24\)"),
    (lambda env: make_multi_task_vec([CLOSE], envs_per_task=0), "envs_per_task .*, got 0"),
    (lambda env: make_multi_task_vec([CLOSE], observation=TASK_ID), ".*names than 'task_id'"),
]


@pytest.mark.parametrize(("wrap", "message"), REFUSED)
def test_environments_that_a_wrapper_cannot_serve_are_refused(wrap, message, picking):
    with pytest.raises(ValueError, match=f"^{message}"):
        wrap(picking)
