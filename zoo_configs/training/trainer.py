"""Training of one run: environments, model and callbacks from its hyperparameters."""

import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecEnv
from tqdm.rich import tqdm

from sb3_extensions.common.checkpoint import DirectoryCheckpointCallback, resume, save_checkpoint
from sb3_extensions.common.entropy import replace_ent_coef
from zoo_configs.algorithms import algorithm_classes
from zoo_configs.environments import SeedStream, load_expert_data, stream_seed
from zoo_configs.errors import CommandError, reason, refused
from zoo_configs.training.certificate import Certificate
from zoo_configs.training.evaluation import PeriodicEvaluation, TrainingLog
from zoo_configs.training.objects import NOISES, TRAINER_KEYS, build_vec_env, described_callables, parsed
from zoo_configs.training.runs import Run, cut_monitor_files, env_folder_name
from zoo_configs.training.validation import policy_class

REJECTIONS = (AssertionError, MemoryError, RuntimeError, TypeError, ValueError)
"""Errors of algorithms for arguments, or environments, with which they cannot learn."""


class TrainingBar(ProgressBarCallback):
    """Stable-Baselines3's progress bar on the standard error."""

    def _on_training_start(self) -> None:
        # On a terminal, printed lines appear above the bar.
        options = {"console": Console(stderr=True), "redirect_stdout": sys.stdout.isatty()}
        left = self.locals["total_timesteps"] - self.model.num_timesteps
        self.pbar = tqdm(total=left, options=options)

    def close(self) -> None:
        """End the bar, also after an error."""
        if hasattr(self, "pbar"):
            self.pbar.close()


class Trainer:
    """
    Environments, model and callbacks of one run.

    :param checkpoint: The checkpoint to resume from, None for a new run
    :param progress: Whether to show a progress bar instead of tables
    :raises CommandError: if the algorithm, the environment or a callback rejects its arguments
    """

    def __init__(
        self,
        run: Run,
        checkpoint: Path | None = None,
        more_callbacks: Sequence[BaseCallback] = (),
        progress: bool = False,
    ) -> None:
        self.run, self.checkpoint, self.progress = run, checkpoint, progress
        self.options, self.hyperparams = run.options, run.experiment.hyperparams
        self.algorithm = algorithm_classes()[run.experiment.algo]
        self.verbose = 0 if progress and self.options.verbose == 1 else self.options.verbose
        self.callbacks: list[BaseCallback] = []
        self.envs: list[VecEnv] = []
        try:
            with refused(f"{run.experiment.algo} cannot be built for {run.experiment.env_id}"):
                self.callbacks = [*self._callbacks(), *more_callbacks]
                n_envs = self.hyperparams.get("n_envs", 1)
                is_new = len(list(run.folder.glob("*.monitor.csv"))) < n_envs  # or none were copied
                env = self._build_env(n_envs, monitor_dir=run.folder, override_existing=is_new)
                self.model = self._model(env)
        except BaseException:
            self.close()
            raise

    def learn(self) -> bool:
        """Train, save a last checkpoint, and return False if Ctrl-C ended the training."""
        updates = getattr(self.model, "_n_updates", 0)
        steps = self.run.n_timesteps - (self.model.num_timesteps if self.checkpoint else 0)
        # By default our algorithms show bars for demonstrations and pretraining on a terminal.
        options: dict[str, Any] = {} if self.progress else {"progress_bar": False}
        options["tb_log_name"] = self._tensorboard_name
        try:
            self.model.learn(
                steps, callback=self.callbacks, reset_num_timesteps=self.checkpoint is None, **options
            )
            if self.options.save_freq:
                save_checkpoint(self.model, self.run.checkpoint_folder)
        except KeyboardInterrupt:
            return False
        except REJECTIONS as error:
            if getattr(self.model, "_n_updates", 0) > updates:
                raise
            # The arguments are the reason for an error before the first update.
            where = f"{self.run.experiment.algo} cannot train on {self.run.experiment.env_id}"
            raise CommandError(f"{where}: {reason(error)}") from error
        return True

    def close(self) -> None:
        """Close the progress bar and all environments."""
        for callback in self.callbacks:
            if isinstance(callback, TrainingBar):
                callback.close()
        for env in self.envs:
            with contextlib.suppress(EOFError, BrokenPipeError):  # Ctrl-C has ended a worker process
                env.close()

    def _build_env(self, n_envs: int, **kwargs: Any) -> VecEnv:
        names = self.run.experiment.env_id, self.hyperparams, n_envs, self.run.seed
        kwargs["statistics"] = self.run.statistics_file  # also of a model that training starts from
        env = build_vec_env(*names, vec_env=self.options.vec_env, **kwargs)
        self.envs.append(env)
        return env

    def _callbacks(self) -> list[BaseCallback]:
        """Build the callbacks of the hyperparameters, then progress bar, log, evaluation and checkpoints."""
        options, described = self.options, described_callables(self.hyperparams.get("callback"))
        found: list[BaseCallback] = [cls(**kwargs) for cls, kwargs in described]
        if self.progress:
            found.append(TrainingBar())
        if not options.trained_agent:
            found.append(Certificate(self.run))
        if options.eval_freq > 0:
            env = self._build_env(options.n_eval_envs, for_evaluation=True)
            env.seed(stream_seed(self.run.seed, SeedStream.EVALUATION))
            found.append(TrainingLog(self.run.training_log, options.eval_freq))
            found.append(PeriodicEvaluation(self.run, env, self.verbose))
        if options.save_freq:
            freq = options.save_freq if options.save_freq > 0 else -(-self.run.n_timesteps // 10)
            found.append(DirectoryCheckpointCallback(freq, self.run.checkpoint_folder))
        return found

    def _model(self, env: VecEnv) -> BaseAlgorithm:
        """Load the model of a checkpoint or file, or build a new one."""
        if self.checkpoint is not None:
            resumed = resume(self.checkpoint, env, self.run.device)
            resumed.verbose, resumed.tensorboard_log = self.verbose, self._tensorboard_folder
            cut_monitor_files(self.run, env.get_attr("total_steps"))
            return resumed
        kwargs = self._constructor_kwargs(env)
        if not self.options.trained_agent:
            model: BaseAlgorithm = self.algorithm(env=env, **kwargs)
            return model
        self._check_policy(kwargs.pop("policy"))
        kwargs.pop("policy_kwargs", None)
        # Arguments that are not named would be the file's, but those of the buffer are the run's.
        if (default := getattr(self.algorithm, "default_replay_buffer_class", None)) is not None:
            kwargs.setdefault("replay_buffer_class", default)
            kwargs["_had_expert_data"] = False  # demonstrations are the run's, too
        # Stable-Baselines3's load() keeps the entropy coefficient of the file.
        is_off_policy = issubclass(self.algorithm, OffPolicyAlgorithm)
        ent_coef = kwargs.pop("ent_coef", None) if is_off_policy else None
        loaded: BaseAlgorithm = self.algorithm.load(self.options.trained_agent, env=env, **kwargs)
        if ent_coef is not None:
            replace_ent_coef(loaded, ent_coef)
        return loaded

    def _constructor_kwargs(self, env: VecEnv) -> dict[str, Any]:
        values = load_expert_data(parsed(self.hyperparams))
        if (episodes := values.get("expert_data")) is not None:
            episodes.env_id = self.run.experiment.env_id  # checked, or allowed to differ
        if values.get("noise_type") is not None:
            ones = np.ones(env.action_space.shape or ())
            noise = NOISES[values["noise_type"]]
            values["action_noise"] = noise(mean=0 * ones, sigma=values["noise_std"] * ones)
        return {
            **{key: value for key, value in values.items() if key not in TRAINER_KEYS},
            "seed": self.run.seed,
            "device": self.run.device,
            "verbose": self.verbose,
            "tensorboard_log": self._tensorboard_folder,
        }

    @property
    def _tensorboard_folder(self) -> str | None:
        folder = self.options.tensorboard_log
        return str(Path(folder) / env_folder_name(self.run.experiment.env_id)) if folder else None

    @property
    def _tensorboard_name(self) -> str:
        """Name of the run's log. A resumed run continues the latest one of its name, not another run's."""
        folder, env_name = self.run.folder.absolute(), env_folder_name(self.run.experiment.env_id)
        return f"{folder.parent.name}_{folder.name.removeprefix(f'{env_name}_')}"

    def _check_policy(self, policy: str | type[Any]) -> None:
        """Check that the model file has the policy of the hyperparameters."""
        data = load_from_zip_file(self.options.trained_agent, device="cpu")[0] or {}
        wanted = policy_class(self.algorithm, policy) if isinstance(policy, str) else policy
        found = data.get("policy_class", type(None))
        if found is not wanted:
            names = [f"{cls.__module__}.{cls.__qualname__}" for cls in (found, wanted)]
            raise CommandError(f"the policy of the model file is {names[0]}, this run's {names[1]}")
