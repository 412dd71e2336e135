"""The environment: task, control, surface, arm and sensors put together."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike, NDArray

from bulletarm_gym.assembly import find_types, make_config, make_scene, take_objects
from bulletarm_gym.config import CLOSE_LOOP
from bulletarm_gym.control import Control, RobotInterface
from bulletarm_gym.copies import reduce_env
from bulletarm_gym.experts.tracking import Tracker
from bulletarm_gym.extensions import by_path
from bulletarm_gym.feasibility import (
    check_base,
    check_heights,
    check_home,
    check_room,
    check_spans,
    checked_facts,
    checked_options,
    finite_reward,
    reward_function,
)
from bulletarm_gym.geometry import PlacementError
from bulletarm_gym.observations import Observer, View
from bulletarm_gym.observations.cameras import RENDER, render_frame
from bulletarm_gym.observations.renderer import measure
from bulletarm_gym.rehearsal import REHEARSAL
from bulletarm_gym.scene import Scene
from bulletarm_gym.simulation import has_display
from bulletarm_gym.state import EnvState, check_fits, scene_facts
from bulletarm_gym.tasks import Task
from bulletarm_gym.viewer import Viewer
from bulletarm_gym.wrapped_expert import querying_wrappers, wrapped_expert

Observation = dict[str, NDArray[Any]]
Action = NDArray[np.float32]

GROUNDS = 30
"""Drawn before the workspace counts as too small for the task."""
MOVE_STEPS = 10
"""Close-loop steps for which a plan of picks and places draws the same, so that it stays what it is."""
ARRANGEMENT, AFTER_ACTION, PLAN = range(3)
"""Streams of an episode's randomness: what one of them draws does not move the others."""
UNKNOWN_SEED = -1
"""Gymnasium's value of ``np_random_seed`` for a generator that no known seed has produced."""


class ManipulationEnv(gymnasium.Env[Observation, Action]):
    """A manipulation task.

    Registered ids name the task, the control and the surface; all else are parameters, see
    :class:`~bulletarm_gym.config.EnvConfig`. An episode ends with reward 1 on success, with reward 0 when the
    scene has become invalid, and is truncated at ``max_steps``.

    :param task: ``"module:Class"`` of the task
    :param control: ``"close_loop"``, ``"open_loop"``, or a user's by name or path
    :param surface: one of :data:`~bulletarm_gym.surfaces.SURFACES`, or a user's by name or path
    :param defaults: of parameters, in place of the task's; an id's own
    :param parameters: of :class:`~bulletarm_gym.config.EnvConfig`, by name
    :raises ValueError: a parameter has a value it cannot take, or is unknown (a ``TypeError``, too); task and
        control do not fit
    :raises RuntimeError: ``render_mode="human"`` without a display
    """

    metadata = {"render_modes": ["rgb_array", "depth_array", "human"], "render_fps": 5}  # noqa: RUF012
    """Of the class all there is, as ``gymnasium.make`` asks it; of an instance what can be had here."""

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
        task_type, control_type = find_types(task, control)
        self.objects, robots = take_objects(parameters)
        config_of = partial(make_config, task_type, control_type, tuple(robots), surface, defaults)
        self.config, own = config_of(parameters), config_of({})
        recipe: dict[str, Any] = {"task": task, "control": control, "surface": surface}
        self.recipe = recipe | ({"defaults": dict(defaults)} if defaults else {})
        self.render_mode = self.config.render_mode
        if not has_display():
            self.metadata = {**self.metadata, "render_modes": ["rgb_array", "depth_array"]}
        self.task = task_type(self.config)
        # A generator takes as long to make as an image: most tasks need none after an action.
        self._acts_after = task_type.after_action is not Task.after_action
        check_heights(self.config, own, self.task)
        self._reward = self.objects.get("reward") or reward_function(self.config.reward) or self.task.reward
        self.scene = make_scene(self.config, robots, surface, self.task)
        check_base(self.config, self.scene.robot.model)
        check_home(self.config, self.scene)
        check_spans(self.config, own, self.scene, self.task)
        robot = RobotInterface(self.scene.robot, self.scene.settle)
        self.control: Control[Any] = control_type(self.config, robot, self.task.grasp_params)
        self.tracker = Tracker(
            self.control, self.scene, self.task.grasp_params.opening if self.task.plans_moves else None
        )
        check_room(self.config, own, self.scene, self.task, self.control)
        self.action_space = self.control.action_space
        self._observer = Observer(self.config, self.scene)
        self.cameras = self._observer.cameras
        """Cameras by name: ``"render"``, and those of sensors by the names of the sensors."""
        self._view: View | None = None
        # Gymnasium types a Dict space by its parts instead of its samples.
        self.observation_space = self._observer.space  # type: ignore[assignment]
        self._steps = 0
        self._ended = False
        self._episode_seed: int | None = None
        if self.render_mode == "human":
            self.viewer.face_workspace()
        REHEARSAL.run(ManipulationEnv)

    # Gymnasium

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        :param seed: the same seed gives the same episode and, from then on, the same episodes
        :param options: ``{"new_scene": True}`` arranges a new scene where a task keeps what an episode left,
            as a seed does; ``{"start": "goal"}`` arranges the task's finished structure, to take it apart;
            ``{"state": state}`` begins at a state as :meth:`set_state` does
        :raises ValueError: an unknown option, the task has no structure to start from, or the state is of
            another environment or after the end of its episode
        :raises PlacementError: the workspace is too small for the task
        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        self.scene.world.check_open()
        options = checked_options(options, self.task)
        if "state" in options:
            self.set_state(options["state"])
            super().reset(seed=seed)  # decides the later episodes
            return self.observe(), self._evaluate(ignored=False)
        super().reset(seed=seed)
        anew = seed is not None or any(options.values()) or self._episode_seed is None
        arrange = self.task.arrange_goal if "start" in options else self.task.arrange
        self._episode_seed = int(self.np_random.integers(np.iinfo(np.int64).max))
        self._steps, self._ended = 0, False
        self.task.memory = self.control.memory = None
        rng = self._rng(ARRANGEMENT)
        if anew or not self.task.continue_scene(self.scene, rng):
            self._arrange(arrange, rng)
        else:
            self.control.start()
        self._observer.set_memory({})
        self.scene.begin()
        self.scene.settle()
        return self.observe(), self._evaluate(ignored=False)

    @property
    def keeps_scene(self) -> bool:
        """Whether an episode without a seed begins with what the last one left."""
        return self.task.keeps_scene

    def _arrange(
        self, arrange: Callable[[Scene, np.random.Generator], None], rng: np.random.Generator
    ) -> None:
        """Draw the ground and what lies on it; where that finds no room, other ground.

        :raises PlacementError: there is no room on any
        """
        for attempt in range(GROUNDS):
            self.scene.clear(rng)
            self.control.start()
            try:
                arrange(self.scene, rng)
                return
            except PlacementError:
                if attempt == GROUNDS - 1:
                    raise

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Carry out an action.

        :param action: (n,) numbers, clipped to [-1, 1]
        :raises ValueError: the action has the wrong shape or is not finite, or the user's reward is no number
        :raises gymnasium.error.ResetNeeded: no episode has begun, or it has ended
        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        self._check_running()
        if self._ended:
            raise gymnasium.error.ResetNeeded("the episode has ended. Call reset() before the next step().")
        view = self._view if self._view is not None and self._view.is_current else self.look()
        move = self.control.decode_action(action, view)
        if self._observer.follows or self.control.follows:
            _ = view.heights  # drawn while they are what was seen before the move
        self.scene.begin()
        outcome = self.control.apply(move)
        self.scene.settle()
        if not outcome.ignored:
            self._observer.follow(view, outcome.pick)
        self._steps += 1
        if self._acts_after:
            self.task.after_action(self.scene, self._rng(AFTER_ACTION))
            if self.scene.world.unsettled:
                self.scene.begin()
                self.scene.settle()
        info = self._evaluate(outcome.ignored)
        success, valid = info["is_success"], info["is_valid"]
        reward = finite_reward(self._reward(self.scene, info), self._reward) if valid else 0.0
        terminated = success or not valid or self.task.single_step
        truncated = not terminated and self._steps >= self.config.max_steps
        self._ended = terminated or truncated
        self._view = self.look()
        if not outcome.ignored:
            self.control.follow(view, self._view, outcome)
        return self._observer.read(self._view), reward, terminated, truncated, info

    def render(self) -> Any:
        """Return an image (height, width, 3) uint8, distances (height, width) float32 in metres, or None.

        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        self.scene.world.check_open()
        return render_frame(self.cameras[RENDER], self.render_mode, self.spec.id if self.spec else "ID")

    def close(self) -> None:
        """Release the simulation; a second call does nothing."""
        self.scene.world.close()

    # Ours besides

    @property
    def task_description(self) -> str:
        """One sentence that describes the task, an instruction for policies that take language."""
        return self.task.description

    @property
    def _max_episode_steps(self) -> int:
        """Number of steps after which episodes are truncated; LeRobot's evaluation reads it by this name."""
        return self.config.max_steps

    @property
    def action_sequence(self) -> str:
        """What each number of an action is, a character each."""
        return self.config.action_sequence

    @property
    def action_ranges(self) -> dict[str, tuple[float, float]]:
        """What -1 and 1 of an action's numbers stand for (m, rad), by name, without p: x, y, z and r in close
        loop, or theta, phi, psi in open loop. Empty for a control of a user's that does not tell.
        """
        return dict(self.control.ranges)

    @cached_property
    def viewer(self) -> Viewer:
        """Close-up pictures, the window's keys and a mark in it, for people who look and play."""
        return Viewer(self.scene)

    def observe(self) -> Observation:
        """Return the observation of the present moment; it changes nothing."""
        self._view = self.look()
        return self._observer.read(self._view)

    def look(self) -> View:
        """Return what is seen from above at present.

        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        self.scene.world.client.check_open()
        return View(
            self.scene, self.control.frame(), self.task.overlays(self.scene), self._observer.needs_labels
        )

    def decode_action(self, action: ArrayLike) -> Any:
        """Return an action in metres and radians: a ``DeltaMove``, a ``PickPlace``, or the control's own."""
        return self.control.decode_action(action, self.look())

    def encode_action(self, move: Any) -> Action:
        """Return the action for a move in metres and radians."""
        return self.control.encode_action(move)

    def expert_action(self) -> Action:
        """Return what the task's expert would do now; it depends on the state alone and changes nothing.

        The plan is made anew from the present scene each time, so the expert recovers from what happened
        before (paper, Expert Demonstrations: the waypoint planner).

        :raises gymnasium.error.ResetNeeded: no episode has begun
        :raises ValueError: the task's plan has no waypoint
        """
        self._check_running()
        lasts = MOVE_STEPS if self.task.plans_moves and self.config.control == CLOSE_LOOP else 1
        plan = iter(self.task.plan(self.scene, self._rng(PLAN, self._steps // lasts)) or ())
        return self.control.encode_action(self.tracker.next_move(plan))

    def get_wrapper_attr(self, name: str) -> Any:
        """Return an attribute; ``expert_action`` returns actions of the outermost wrapper that was queried.

        :raises ValueError: a wrapper changes actions in a way that cannot be inverted
        """
        if name == "expert_action":
            return wrapped_expert(self.expert_action, querying_wrappers(self))
        return super().get_wrapper_attr(name)

    def measure(self) -> dict[str, float]:
        """Return a dict whose values grow by the seconds of simulation steps and of heightmaps from now on.

        Its keys are ``"physics"`` and ``"rendering"``. Nothing is measured before the first call.
        """
        return measure(self.scene)

    def get_state(self) -> EnvState:
        """Return the present moment; it can be pickled, and set in any environment with the same parameters.

        :raises gymnasium.error.ResetNeeded: no episode has begun
        """
        self._check_running()
        assert self._episode_seed is not None
        return EnvState(
            self.scene.world.get_state(),
            self.scene.robot.get_state(),
            self.scene.get_variants(),
            self._observer.get_memory(),
            self.task.memory,
            self.control.memory,
            self._steps,
            self._ended,
            self._episode_seed,
            dict(self.np_random.bit_generator.state),
            dict(self._made_of),
        )

    def set_state(self, state: EnvState) -> None:
        """Return to a moment of this environment or of another with the same parameters, exactly.

        What only observes, judges or ends an episode (``obs_size``, ``reward``, ``max_steps``) may differ.
        A state after the end keeps :meth:`step` from acting until the next reset.

        :raises ValueError: it is of another task, arm, workspace or other objects; nothing has changed then
        :raises gymnasium.error.ClosedEnvironmentError: the environment is closed
        """
        self.scene.world.check_open()
        check_fits(state, self._made_of)
        self.scene.world.set_state(state.world)
        self.scene.robot.set_state(state.robot)
        self.scene.set_variants(state.cast)
        self._observer.set_memory(state.sensors)
        self.task.memory = state.memory
        self.control.memory = state.control
        self._steps, self._ended = state.steps, state.ended
        self._episode_seed = state.episode_seed
        self.np_random.bit_generator.state = state.generator
        self._np_random_seed = UNKNOWN_SEED

    @cached_property
    def _made_of(self) -> dict[str, Any]:
        """Names and JSON values that a state must have in common with the environment."""
        return {**self.recipe, **scene_facts(self.scene), **self._observer.shapes(["in_hand"])}

    def _evaluate(self, ignored: bool) -> dict[str, bool]:
        """Return the info; ``is_success`` is the task's goal in a valid scene."""
        facts = checked_facts(self.task.evaluate(self.scene), self.task)
        valid = bool(self.task.is_valid(self.scene))
        success = facts.pop("success") and valid
        return {"is_success": success, "is_valid": valid, "ignored": ignored, **facts}

    def _rng(self, stream: int, time: int | None = None) -> np.random.Generator:
        """Return the generator of a stream at a time of this episode, by default this step."""
        assert self._episode_seed is not None
        time = self._steps if time is None else time
        return np.random.default_rng((self._episode_seed, time, stream))

    def _check_running(self) -> None:
        self.scene.world.check_open()
        if self._episode_seed is None:
            raise gymnasium.error.ResetNeeded("no episode has begun. Call reset() first.")

    # Copies

    @property
    def spec(self) -> EnvSpec | None:
        """The spec the environment was made from, its parameters as JSON values.

        Its ``max_episode_steps`` is what the environment truncates at.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Keep a spec, its parameters as this environment keeps them."""
        if spec is not None:
            known = {**self.recipe, **self._parameters}
            kwargs = {name: known.get(name, value) for name, value in spec.kwargs.items()}
            spec = replace(spec, kwargs=kwargs, max_episode_steps=self.config.max_steps)
        self._spec = spec

    _spec: EnvSpec | None = None

    def limit_steps(self, max_steps: int) -> None:
        """Truncate episodes after other than the ``max_steps`` that the environment was made with."""
        self.config = replace(self.config, max_steps=max_steps)
        self.task.config = self.scene.config = self.config

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the parameters, the generators and, within an episode, the state."""
        state = None if self._episode_seed is None else self.get_state()
        return reduce_env(self, {**self.recipe, **self._parameters}, state)

    @property
    def _parameters(self) -> dict[str, Any]:
        """What the environment can be made from again: JSON values, and objects that have no import path."""
        return {**self.config.parameters(), **self.objects}
