"""Our experiment manager: rl_zoo3's, with what it gets wrong mended."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rl_zoo3.callbacks import SaveVecNormalizeCallback
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.common.checkpoint import DirectoryCheckpointCallback, resume, save_checkpoint
from zoo_configs.algorithms import class_from_path
from zoo_configs.cells.validation import policy_class
from zoo_configs.environments import CheckedDemonstrations, load_expert_data
from zoo_configs.errors import CommandError, reason, refused
from zoo_configs.files import whole_file
from zoo_configs.training.evaluation import PeriodicEvaluation
from zoo_configs.training.progress import TrainingBar
from zoo_configs.training.runs import Run, load_run
from zoo_configs.training.seeds import SeedStream, stream_seed
from zoo_configs.training.state import NothingToDo
from zoo_configs.training.training_log import TrainingLog

# Hyperparameters that rl_zoo3 evaluates as Python code if they are strings.
EVALUATED_KEYS = ("policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs")
DOTTED_PATH = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+")
# What algorithms raise at arguments, or an environment, that they cannot learn with.
UNFIT = (AssertionError, MemoryError, RuntimeError, TypeError, ValueError)


class ZooManager(ExperimentManager):
    """
    Trains one run in its folder.

    What differs from rl_zoo3: the folder is given; the environment's parameters reach the evaluation
    environments, which get seeds of their own; classes in the YAML are named by dotted paths, without
    evaluation of code; checkpoints are whole directories with replay buffer, from which a run can go on;
    files are written whole or not at all.

    :param run: The run; its folder holds its resolved hyperparameters
    :param checkpoint: The checkpoint to go on from, None for a new run
    :param callbacks: At work beside those of the options
    :param progress: Whether to show a progress bar
    :param done: Whether the run was done before: there is nothing to do then but for more time steps. One
        that was killed at its very end is saved again
    """

    def __init__(
        self,
        run: Run,
        checkpoint: Path | None,
        callbacks: Sequence[BaseCallback] = (),
        progress: bool = False,
        done: bool = False,
    ) -> None:
        options = run.options
        super().__init__(
            _as_arguments(run),
            run.cell.algo,
            run.cell.env_id,
            str(run.folder.parent),
            options.tensorboard_log,
            options.n_timesteps,
            options.eval_freq,
            options.eval_episodes,
            options.save_freq,
            eval_env_kwargs=dict(options.eval_env_kwargs) or None,
            trained_agent=options.trained_agent,
            truncate_last_trajectory=options.truncate_last_trajectory,
            seed=run.seed,
            log_interval=options.log_interval,
            save_replay_buffer=options.save_replay_buffer,
            verbose=options.verbose,
            vec_env_type=options.vec_env,
            n_eval_envs=options.n_eval_envs,
            device=run.device,
            config=str(run.resolved_file),
            show_progress=progress,
        )
        self.run = run
        self.checkpoint = checkpoint
        self.more_callbacks = callbacks
        self.done = done
        self.interrupted = False
        self.continue_training = self.continue_training or checkpoint is not None
        self.log_path = str(run.folder.parent)
        self.save_path = str(run.folder)
        self.params_path = str(run.params_folder)

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        Build environments and model.

        :return: The model, and the hyperparameters as they are saved
        :raises CommandError: if they refuse what they are given
        """
        printed = contextlib.nullcontext() if self.verbose else contextlib.redirect_stdout(io.StringIO())
        with printed, refused(f"{self.algo} cannot be built for {self.env_name.gym_id}"):
            return super().setup_experiment()

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        for key in EVALUATED_KEYS:
            if key in hyperparams:
                hyperparams[key] = import_classes(hyperparams[key], is_class=key.endswith("_class"))
        if self.checkpoint is None:  # what is resumed has them in its replay buffer
            hyperparams = load_expert_data(hyperparams)
            if (episodes := hyperparams.get("expert_data")) is not None:
                hyperparams["expert_data"] = CheckedDemonstrations(episodes)
        processed = super()._preprocess_hyperparams(hyperparams)
        self.eval_env_kwargs = {**self.env_kwargs, **(self._eval_env_kwargs_args or {})}
        if "info_keywords" in self.monitor_kwargs:  # YAML has lists only
            self.monitor_kwargs["info_keywords"] = tuple(self.monitor_kwargs["info_keywords"])
        if self.checkpoint is not None:
            self.monitor_kwargs["override_existing"] = False
        return processed

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        Create environments; those for evaluation get another seed than those for training.

        :param n_envs: How many
        :param eval_env: Whether they are for evaluation
        :param no_log: Whether to write no monitor files
        :return: The wrapped environments
        """
        env = super().create_envs(n_envs, eval_env, no_log)
        if eval_env:
            env.seed(stream_seed(self.seed, SeedStream.EVALUATION))
        return env

    def create_callbacks(self) -> None:
        """Progress bar, checkpoints and periodic evaluation, as far as they are asked for."""
        if self.show_progress:
            self.callbacks.append(TrainingBar())
        if self.eval_freq > 0 and not self.optimize_hyperparameters:
            self.callbacks.append(TrainingLog(self.run.training_log, self.eval_freq))
            self.callbacks.append(self._periodic_evaluation())
        if self.save_freq > 0:
            self.callbacks.append(self._checkpoints())
        self.callbacks.extend(self.more_callbacks)

    def _periodic_evaluation(self) -> BaseCallback:
        return PeriodicEvaluation(
            self.create_envs(self.n_eval_envs, eval_env=True),
            run_folder=self.run.folder,
            seed=self.seed,
            callback_on_new_best=SaveVecNormalizeCallback(save_freq=1, save_path=self.params_path),
            n_eval_episodes=self.n_eval_episodes,
            eval_freq=self._calls(self.eval_freq),
            deterministic=self.deterministic_eval,
            verbose=self.verbose,
        )

    def _checkpoints(self) -> BaseCallback:
        return DirectoryCheckpointCallback(self.save_freq, self.run.checkpoint_folder)

    def _calls(self, timesteps: int) -> int:
        """How many steps of the vector environment make that many time steps."""
        return max(timesteps // self.n_envs, 1)

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.checkpoint is None:
            self._check_trained_agent(hyperparams["policy"])
            # What the hyperparameters do not name would be the model's, and the buffer's arguments are theirs
            if (default := getattr(ALGOS[self.algo], "default_replay_buffer_class", None)) is not None:
                hyperparams.setdefault("replay_buffer_class", default)
            model = super()._load_pretrained_agent(hyperparams, env)
            self._discard_foreign_buffer(model)
            return model
        model = resume(self.checkpoint, env, self.device)
        if self.done and model.num_timesteps >= self.n_timesteps:
            done = f"{self.run.folder} has done {model.num_timesteps} time steps of {self.n_timesteps}"
            raise NothingToDo(f"{done}; to go on, give more by -n")
        return model

    def _discard_foreign_buffer(self, model: BaseAlgorithm) -> None:
        """Empty a replay buffer that was not recorded in this run's environment."""
        buffer: ReplayBuffer | None = getattr(model, "replay_buffer", None)
        if buffer is None or not buffer.size():
            return
        cell = self.run.cell
        with contextlib.suppress(CommandError):
            found = load_run(Path(self.trained_agent).parent).cell
            same = found.hyperparams.get("env_kwargs") == cell.hyperparams.get("env_kwargs")
            if found.env_id == cell.env_id and same:
                return
        buffer.reset()
        print(f"The replay buffer next to {self.trained_agent} is not of this environment: left out")

    def _check_trained_agent(self, policy: str | type[Any]) -> None:
        """The model keeps its policy, whatever the hyperparameters say."""
        data, _, _ = load_from_zip_file(self.trained_agent, device="cpu")
        wanted = policy_class(ALGOS[self.algo], policy) if isinstance(policy, str) else policy
        found = (data or {}).get("policy_class", type(None))
        if found is not wanted:
            names = [f"{cls.__module__}.{cls.__qualname__}" for cls in (found, wanted)]
            raise CommandError(f"the policy in {self.trained_agent} is {names[0]}, this run's {names[1]}")

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train; an interruption by Ctrl-C ends training early and without an error.

        :param model: The model, new or from a checkpoint
        :raises CommandError: if it turns out before the first update that it cannot learn
        """
        updates = getattr(model, "_n_updates", 0)
        options: dict[str, Any] = {} if self.show_progress else {"progress_bar": False}
        if self.log_interval != -1:
            options["log_interval"] = max(self.log_interval, 0) or None
        try:
            model.learn(
                self.n_timesteps - (model.num_timesteps if self.checkpoint else 0),
                callback=self.callbacks,
                reset_num_timesteps=self.checkpoint is None,
                **options,
            )
            if self.save_freq > 0:
                save_checkpoint(model, self.run.checkpoint_folder)
        except KeyboardInterrupt:
            self.interrupted = True
            self._close_progress_bars()
        except UNFIT as error:
            if getattr(model, "_n_updates", 0) > updates:
                raise
            where = f"{self.algo} cannot train on {self.env_name.gym_id}"
            raise CommandError(f"{where}: {reason(error)}") from error
        finally:
            self._close_envs(model)

    def _close_progress_bars(self) -> None:
        for callback in self.callbacks:
            if isinstance(callback, TrainingBar) and hasattr(callback, "pbar"):
                callback.pbar.close()

    def _close_envs(self, model: BaseAlgorithm) -> None:
        evaluations = (item for item in self.callbacks if isinstance(item, PeriodicEvaluation))
        for env in (model.env, *(evaluation.eval_env for evaluation in evaluations)):
            if env is not None:
                with contextlib.suppress(EOFError, BrokenPipeError):  # a worker that Ctrl-C has ended already
                    env.close()

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Save the model, as whole files.

        :param model: The model at the end of training
        """
        with whole_file(self.run.last_model) as partial:
            model.save(partial)
        if self.save_replay_buffer and hasattr(model, "save_replay_buffer"):
            with whole_file(self.run.folder / "replay_buffer.pkl") as partial:
                model.save_replay_buffer(partial)
        statistics = model.get_vec_normalize_env()
        if statistics is not None:
            statistics.save(str(self.run.params_folder / "vecnormalize.pkl"))


def _as_arguments(run: Run) -> argparse.Namespace:
    """The command line that rl_zoo3 keeps beside a run."""
    where = {"algo": run.cell.algo, "env": run.cell.env_id, "seed": run.seed, "device": run.device}
    options = run.options.plain()
    return argparse.Namespace(**where, log_folder=str(run.folder.parent), env_kwargs=None, **options)


def import_classes(value: Any, is_class: bool = False) -> Any:
    """
    Replace dotted paths by the classes they name, wherever a key ends in ``_class``.

    :param value: A value from a YAML file
    :param is_class: Whether the value stands under such a key
    :return: The value with classes in it
    """
    if isinstance(value, dict):
        return {key: import_classes(item, str(key).endswith("_class")) for key, item in value.items()}
    if is_class and isinstance(value, str) and DOTTED_PATH.fullmatch(value):
        return class_from_path(value)
    return value
