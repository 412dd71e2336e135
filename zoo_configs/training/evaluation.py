"""Periodic evaluation during training."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_extensions.equivariant.layers import expanded_filters
from zoo_configs.training.runs import BEST_MODEL_FILE, EVALUATIONS_FILE
from zoo_configs.training.seeds import SeedStream, stream_seed
from zoo_configs.training.training_log import training_time

# Files are written here first, then moved into the run folder.
SCRATCH_FOLDER = ".evaluation"


class PeriodicEvaluation(EvalCallback):
    """
    Evaluates on scenes of its own, fresh at every evaluation, and keeps the best model.

    The scenes depend on the seed and the time step alone: a resumed run is evaluated on the same ones. Of two
    equally good models the later one is kept. Files appear whole in the run folder; what an earlier part of
    the run evaluated is carried on. Pretraining is evaluated as well, at as many time steps before 0 as
    gradient steps of it are left.

    :param eval_env: Environments for evaluation
    :param run_folder: Folder for ``evaluations.npz`` and ``best_model.zip``
    :param seed: Seed of the run
    :param kwargs: Passed on to Stable-Baselines3's ``EvalCallback``
    """

    def __init__(self, eval_env: VecEnv, run_folder: Path, seed: int, **kwargs: Any) -> None:
        scratch = run_folder / SCRATCH_FOLDER
        super().__init__(eval_env, log_path=str(scratch), best_model_save_path=str(scratch), **kwargs)
        self.run_folder = run_folder
        self.seed = seed
        self._evaluated_pretraining = 0  # gradient steps at the latest evaluation of the pretraining

    def _init_callback(self) -> None:
        super()._init_callback()
        self.n_calls = self.model.num_timesteps // self.training_env.num_envs
        self._carry_on()

    def _carry_on(self) -> None:
        """Take over the evaluations made before the checkpoint that training goes on from."""
        path = self.run_folder / EVALUATIONS_FILE
        if not path.is_file():
            return
        with np.load(path) as saved:
            known = saved["timesteps"] <= training_time(self)
            self.evaluations_timesteps = saved["timesteps"][known].tolist()
            self.evaluations_results = saved["results"][known].tolist()
            self.evaluations_length = saved["ep_lengths"][known].tolist()
            if "successes" in saved:
                self.evaluations_successes = saved["successes"][known].tolist()
        if self.evaluations_timesteps and self.evaluations_timesteps[-1] == training_time(self):
            self._evaluated_pretraining = getattr(self.model, "n_pretrained", 0)
        if self.evaluations_results:
            self.best_mean_reward = float(np.mean(self.evaluations_results, axis=1).max())

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True
        return self._evaluate(stream_seed(self.seed, SeedStream.EVALUATION, self.num_timesteps))

    def _on_rollout_start(self) -> None:
        pretrained: int = getattr(self.model, "n_pretrained", 0)
        if self.model.num_timesteps or not pretrained or pretrained == self._evaluated_pretraining:
            return
        if pretrained % self.eval_freq == 0 or training_time(self) == 0:
            self._evaluated_pretraining = pretrained
            self.num_timesteps = training_time(self)
            self._evaluate(stream_seed(self.seed, SeedStream.PRETRAINING, pretrained))
            self.num_timesteps = 0

    def _evaluate(self, seed: int) -> bool:
        """Evaluate now, on the scenes of a seed; returns whether training shall go on."""
        self.eval_env.seed(seed)
        self.best_mean_reward = float(np.nextafter(self.best_mean_reward, -np.inf))  # a tie is a new best
        calls, self.n_calls = self.n_calls, 0  # the parent evaluates when the calls divide by its frequency
        with expanded_filters(self.model.policy):
            proceed = super()._on_step()
        self.n_calls = calls
        for name in (EVALUATIONS_FILE, BEST_MODEL_FILE):
            self._publish(name)
        return proceed

    def _publish(self, name: str) -> None:
        written = self.run_folder / SCRATCH_FOLDER / name
        if written.exists():
            os.replace(written, self.run_folder / name)

    def _on_training_end(self) -> None:
        scratch = self.run_folder / SCRATCH_FOLDER
        if scratch.is_dir() and not any(scratch.iterdir()):
            scratch.rmdir()
