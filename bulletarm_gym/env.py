"""The environment: task, control, surface, robot and sensors combined."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.config import CLOSE_LOOP, PROGRESS, Context, EnvConfig
from bulletarm_gym.config_checks import check_argument, instance, instances, mapping, optional
from bulletarm_gym.control import Control, GraspParams, RobotInterface
from bulletarm_gym.episode import AFTER_ACTION, ARRANGEMENT, PLAN, Episode
from bulletarm_gym.experts.approach import Tracker, checked_plan
from bulletarm_gym.geometry.compilation import warm_up
from bulletarm_gym.observations import Observer, Overlay, View
from bulletarm_gym.observations.cameras import RENDER, Viewer
from bulletarm_gym.observations.view import measure
from bulletarm_gym.registry import REWARDS, ROBOTS, SURFACES, by_path, find_combination
from bulletarm_gym.robots import RobotModel
from bulletarm_gym.scene import Scene
from bulletarm_gym.scene.state import EnvState, check_fits, scene_facts
from bulletarm_gym.simulation import has_display
from bulletarm_gym.tasks import Task
from bulletarm_gym.tasks.progress import DISCOUNT, Progress
from bulletarm_gym.tasks.task import (
    arrange_scene,
    check_scene,
    checked_options,
    checked_slots,
    evaluated,
    finite_reward,
)
from bulletarm_gym.wrappers import wrapped_expert

Observation = dict[str, NDArray[Any]]
Action = NDArray[np.float32]

PLAN_STEPS = 10
"""Number of closed-loop steps in which a pick-and-place plan samples the same values and does not change."""
KEPT = ("action_space", "observation_space", "_np_random", "_np_random_seed")
"""Attributes with generators or seeds, which copies of an environment keep."""
OVERLAYS = instances(Overlay, "overlays")
"""Check of what a task draws into the heightmap."""


class ManipulationEnv(gymnasium.Env[Observation, Action]):
    """A manipulation task.

    Registered ids select the task, the control and the surface; everything else are parameters, see
    :class:`~bulletarm_gym.config.EnvConfig`. An episode ends with reward 1 on success, with reward 0 when the
    scene has become invalid, and is truncated at ``max_steps``.

    :param task: import path ``"module:Class"`` of the task
    :param control: ``"close_loop"``, ``"open_loop"``, or the name or path of a user's control
    :param surface: one of :data:`~bulletarm_gym.surfaces.SURFACES`, or the name or path of a user's surface
    :param defaults: values that replace the task's defaults of parameters
    :param parameters: parameters of :class:`~bulletarm_gym.config.EnvConfig`, by name
    :raises ValueError: a parameter is unknown (also a ``TypeError``) or has an invalid value; task and
        control cannot be combined
    :raises RuntimeError: ``render_mode="human"`` without a display
    """

    metadata = {"render_modes": ["rgb_array", "depth_array", "human"], "render_fps": 5}  # noqa: RUF012
    """Render modes of the class. Those of an instance depend on whether there is a display."""
    _spec: EnvSpec | None = None

    def __init__(
        self,
        task: str,
        control: str,
        surface: str = "flat",
        defaults: Mapping[str, Any] | None = None,
        **parameters: Any,
    ) -> None:
        parameters = by_path({**parameters, "control": control, "surface": surface})
        control, surface = parameters.pop("control"), parameters.pop("surface")
        task_type, control_type = find_combination(task, control)
        self.objects = {  # parameters without an import path
            name: parameters.pop(name)
            for name in ("robot", "reward")
            if callable(parameters.get(name)) or isinstance(parameters.get(name), RobotModel)
        }
        model = check_argument("robot", self.objects.get("robot"), optional(ROBOTS.check))
        parameters |= {} if model is None else {"robot": model.name}
        context = Context(control_type.kind, task_type.defaults, surface, control_type.sequences)
        check_argument("defaults", defaults, optional(mapping))
        self.config = EnvConfig.of(context, parameters, defaults)
        default = EnvConfig.of(context, {}, defaults)
        self._changed = self.config.changed(default, "scene")
        self.recipe: dict[str, Any] = {"task": task, "control": control, "surface": surface}
        self.recipe |= {"defaults": dict(defaults)} if defaults else {}
        self.render_mode = self.config.render_mode
        if not has_display():
            self.metadata = {**self.metadata, "render_modes": ["rgb_array", "depth_array"]}
        self._make_scene(task_type, model or ROBOTS.find(self.config.robot), surface, default)
        self._make_control(control_type)
        if self.render_mode == "human":
            self.viewer.face_workspace()
        warm_up(ManipulationEnv)

    def _make_scene(self, task_type: Any, model: RobotModel, surface: str, default: EnvConfig) -> None:
        """Make the task and load its bodies."""
        config = self.config
        self.task: Task = task_type(config)
        self.keeps_scene = task_type.continue_scene is not Task.continue_scene
        """Whether an episode without a seed begins with the objects that the previous one left."""
        # Making a generator is as slow as an image, and most tasks need none after an action.
        self._acts_after = task_type.after_action is not Task.after_action
        path = None if config.reward == PROGRESS else config.reward
        self._reward = self.objects.get("reward") or (REWARDS.find(path) if path else self.task.reward)
        kind = SURFACES.find("tray" if config.close_loop_tray else surface)
        slots = checked_slots(self.task.bodies(config), self.task)
        self.scene = Scene(config, model, kind(config.workspace, self.task.site), slots)
        check_scene(config, default, self.scene, self.task)
        self.instructions = self.task.instruct(self.scene.surface.words)
        """Sentences that describe the task in different words, for policies with language inputs."""
        self.instruction = self.task_description = self.instructions[0]  # the latter for LeRobot

    def _make_control(self, control_type: Any) -> None:
        """Make the control, the expert's tracker and the sensors."""
        params = check_argument("grasp_params", self.task.grasp_params, instance(GraspParams))
        robot = RobotInterface(self.scene.robot, self.scene.settle)
        self.control: Control[Any] = control_type(self.config, robot, params)
        self._episode = Episode(self.task, self.scene, self.control)
        self.tracker = Tracker(self.control, self.scene, params.opening if self.task.plans_moves else None)
        rng = partial(self._episode.rng, PLAN, 0)
        is_shaped = self.config.reward == PROGRESS
        self._progress = Progress(self.task, self.scene, self.tracker, rng) if is_shaped else None
        self.action_space = self.control.action_space
        self.action_sequence = self.config.action_sequence
        """Meaning of each number of an action, one character each."""
        self.action_ranges = dict(self.control.ranges)
        """Values (m, rad) of -1 and 1 in an action, by name without p; empty for a control without ranges."""
        self._observer = Observer(self.config, self.scene)
        self.cameras = self._observer.cameras
        """Cameras by name: ``"render"``, and the cameras of sensors by the names of the sensors."""
        self._view: View | None = None
        # Gymnasium types a Dict space by its parts instead of its samples.
        self.observation_space = self._observer.space  # type: ignore[assignment]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        :param seed: determines this episode and later ones
        :param options: ``{"new_scene": True}`` arranges a new scene if the task keeps the objects of the
            previous episode; a seed does, too. ``{"start": "goal"}`` arranges the task's finished structure,
            to take it apart. ``{"state": state}`` begins at a state as :meth:`set_state` does.
            ``"object_scale_range"``, ``"num_objects"`` and ``"randomization"`` narrow these parameters for
            this episode
        :raises ValueError: an option is unknown or not within its parameter, the task has no structure, or
            the state is that of another environment or of an episode that has ended
        :raises PlacementError: the objects do not fit into the workspace
        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        self.scene.world.check_open()
        options, episode = checked_options(options, self.task), self._episode
        if "state" in options:
            self.set_state(options["state"])
            super().reset(seed=seed)  # decides the later episodes
            return self.observe(), self._evaluate(ignored=False)
        narrowed = episode.checked(options)
        super().reset(seed=seed)
        is_new = seed is not None or episode.seed is None or narrowed != episode.narrowed
        is_new |= bool(options.get("new_scene")) or "start" in options
        arrange = self.task.arrange_goal if "start" in options else self.task.arrange
        episode.seed = int(self.np_random.integers(np.iinfo(np.int64).max))
        episode.steps, episode.ended, episode.last_action = 0, False, ()
        self.task.memory = self.control.memory = None
        rng = episode.rng(ARRANGEMENT)
        if is_new or not self.task.continue_scene(self.scene, rng):
            episode.begin(narrowed)
            try:
                arrange_scene(self.scene, self.control, arrange, rng, self._changed)
            except BaseException:  # also KeyboardInterrupt
                episode.seed = None
                raise
            episode.randomize()
        else:
            self.control.start()
        self._observer.set_memory({})
        self.scene.begin()
        self.scene.settle()
        return self.observe(), self._evaluate(ignored=False)

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action.

        :param action: (n,) numbers, clipped to [-1, 1]
        :raises ValueError: the action has the wrong shape or is not finite, or a reward is not a finite
            number
        :raises gymnasium.error.ResetNeeded: no episode has begun, or it has ended
        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        episode = self._episode
        episode.check_running()
        if episode.ended:
            raise gymnasium.error.ResetNeeded("the episode has ended. Call reset() before the next step().")
        view = self._view if self._view is not None and self._view.is_current else self.look()
        move = self.control.decode_action(episode.executed(action), view)
        if self._observer.follows or self.control.follows:
            _ = view.heights  # computed before the move changes the scene
        before = self._progress.at(view) if self._progress else 0.0
        self.scene.begin()
        outcome = self.control.apply(move)
        self.scene.settle()
        if not outcome.ignored:
            self._observer.follow(view, outcome.pick)
        episode.steps += 1
        if self._acts_after:
            self.task.after_action(self.scene, episode.rng(AFTER_ACTION))
            if self.scene.world.unsettled:
                self.scene.begin()
                self.scene.settle()
        info = self._evaluate(outcome.ignored)
        success, valid = info["is_success"], info["is_valid"]
        reward = finite_reward(self._reward(self.scene, info), self._reward) if valid else 0.0
        terminated = success or not valid or self.task.single_step
        truncated = not terminated and episode.steps >= self.config.max_steps
        episode.ended = terminated or truncated
        self._view = self.look()
        if not outcome.ignored:
            self.control.follow(view, self._view, outcome)
        if self._progress:
            reward += DISCOUNT * (0.0 if terminated else self._progress.at(self._view)) - before
        return self._observer.read(self._view), reward, terminated, truncated, info

    def render(self) -> Any:
        """Return an image (height, width, 3) uint8, distances (height, width) float32 in metres, or None."""
        self.scene.world.check_open()
        return self.cameras[RENDER].render(self.render_mode, self.spec.id if self.spec else "ID")

    def close(self) -> None:
        """Release the simulation; a second call does nothing."""
        self.scene.world.close()

    # Manipulation

    @property
    def _max_episode_steps(self) -> int:
        """Number of steps after which episodes are truncated; LeRobot's evaluation reads this name."""
        return self.config.max_steps

    @cached_property
    def viewer(self) -> Viewer:
        """Close-up images, and keys and marks of the window."""
        return Viewer(self.scene)

    def observe(self) -> Observation:
        """Return the observation of the current state; nothing changes."""
        self._view = self.look()
        return self._observer.read(self._view)

    def look(self) -> View:
        """Return the current view of the scene from above."""
        self.scene.world.check_open()
        overlays = check_argument("overlays()", self.task.overlays(self.scene), OVERLAYS)
        return View(self.scene, self.control.frame(), overlays, self._episode.measure)

    def decode_action(self, action: ArrayLike) -> Any:
        """Return an action in metres and radians: a ``DeltaMove``, a ``PickPlace``, or the control's own."""
        return self.control.decode_action(action, self.look())

    def encode_action(self, move: Any) -> Action:
        """Return the action for a move in metres and radians."""
        return self.control.encode_action(move)

    def expert_action(self) -> Action:
        """Return the action of the task's expert in the current state; nothing changes.

        Each call plans again from the current scene, so the expert recovers from earlier mistakes (paper,
        Expert Demonstrations: the waypoint planner).

        :raises gymnasium.error.ResetNeeded: no episode has begun
        :raises ValueError: the task's plan has no waypoint
        """
        self._episode.check_running()
        period = PLAN_STEPS if self.task.plans_moves and self.config.control == CLOSE_LOOP else 1
        rng = self._episode.rng(PLAN, self._episode.steps // period)
        plan = checked_plan(self.task.plan(self.scene, rng))
        return self.control.encode_action(self.tracker.next_move(plan))

    def get_wrapper_attr(self, name: str) -> Any:
        """Return an attribute; ``expert_action`` returns actions of the outermost wrapper that was queried.

        :raises ValueError: a wrapper changes actions in a way that cannot be inverted
        """
        if name == "expert_action":
            return wrapped_expert(self, self.expert_action)
        return super().get_wrapper_attr(name)

    def measure(self) -> dict[str, float]:
        """Return a dict of seconds of ``"physics"`` and ``"rendering"`` that grow from the first call on."""
        return measure(self.scene)

    def get_state(self) -> EnvState:
        """Return the state, which can be pickled and set in any environment with the same parameters.

        :raises gymnasium.error.ResetNeeded: no episode has begun
        """
        episode = self._episode
        seed = episode.check_running()
        return EnvState(
            self.scene.world.get_state(),
            self.scene.robot.get_state(),
            tuple(obj.variant for obj in self.scene.all_objects),
            *deepcopy((self._observer.get_memory(), self.task.memory, self.control.memory)),
            episode.steps,
            episode.ended,
            seed,
            dict(self.np_random.bit_generator.state),
            dict(self._made_of),
            episode.narrowed,
            episode.sampled,
            episode.last_action,
        )

    def set_state(self, state: EnvState) -> None:
        """Set the state exactly to one of this environment or of another with the same parameters.

        Parameters that only change motions, observations, rewards or the length of episodes may differ. After
        a state after the end of an episode, :meth:`reset` must be called before :meth:`step`.

        :raises ValueError: task, control, surface, robot, workspace, objects or the shape of ``in_hand``
            differ. Then nothing changes
        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        self.scene.world.check_open()
        check_fits(state, self._made_of)
        self.scene.world.set_state(state.world)
        self.scene.robot.set_state(state.robot)
        for obj, variant in zip(self.scene.all_objects, state.variants, strict=True):
            obj.variant = variant
        self._episode.set(state.narrowed, state.sampled, state.last_action)
        sensors, *memories = deepcopy((state.sensors, state.memory, state.control))
        self._observer.set_memory(sensors)
        self.task.memory, self.control.memory = memories
        episode, self._view = self._episode, None
        episode.seed, episode.steps, episode.ended = state.episode_seed, state.steps, state.ended
        self.np_random.bit_generator.state = state.generator
        self._np_random_seed = -1  # Gymnasium's value for an unknown seed

    @cached_property
    def _made_of(self) -> dict[str, Any]:
        """Names and JSON values that a state and the environment must have in common."""
        spaces = self.observation_space.items()  # type: ignore[attr-defined]
        in_hand = {name: list(space.shape) for name, space in spaces if name == "in_hand"}
        return {**self.recipe, **scene_facts(self.scene), **in_hand}

    def _evaluate(self, ignored: bool) -> dict[str, Any]:
        return {**evaluated(self.task, self.scene, ignored), **self._episode.info}

    @property
    def spec(self) -> EnvSpec | None:
        """Spec of the environment, with ``max_steps`` as its ``max_episode_steps``."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Keep a spec with the parameters as JSON values."""
        if spec is not None:
            known = self._arguments
            kwargs = {name: known.get(name, value) for name, value in spec.kwargs.items()}
            spec = replace(spec, kwargs=kwargs, max_episode_steps=self.config.max_steps)
        self._spec = spec

    def limit_steps(self, max_steps: int) -> None:
        """Replace the parameter ``max_steps``."""
        self.config = replace(self.config, max_steps=max_steps)
        self.scene.config = self.config
        self.task.config = replace(self.task.config, max_steps=max_steps)  # may have fewer objects

    def __getstate__(self) -> dict[str, Any]:
        """Return the parameters, the generators and, within an episode, the state."""
        return {
            "arguments": self._arguments,
            "spec": self.spec,
            "state": None if self._episode.seed is None else self.get_state(),
            "kept": {name: vars(self)[name] for name in KEPT if name in vars(self)},
        }

    def __setstate__(self, copied: dict[str, Any]) -> None:
        """Construct the environment with these parameters and set its state."""
        self.__init__(**copied["arguments"])  # type: ignore[misc]
        self.spec = copied["spec"]
        if copied["state"] is not None:
            self.set_state(copied["state"])
        vars(self).update(deepcopy(copied["kept"]))  # copy.copy() passes the generators of the original

    @property
    def _arguments(self) -> dict[str, Any]:
        """Arguments of the constructor by name: JSON values, and objects without an import path."""
        return {**self.recipe, **self.config.parameters(), **self.objects}
