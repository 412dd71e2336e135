"""Periodic evaluation during training, and the table of the values that an algorithm logs."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_extensions.equivariant.layers import expanded_filters
from zoo_configs.drawing.curves import TIMESTEPS, read_training_log
from zoo_configs.environments import SeedStream, stream_seed
from zoo_configs.errors import refused
from zoo_configs.files import whole_file
from zoo_configs.training.runs import Run

PREFIX = "train/"


class PeriodicEvaluation(BaseCallback):
    """
    Evaluates the policy on new scenes every ``eval_freq`` time steps and saves the best model.

    The scenes depend only on the seed and the time step, so that a resumed run has the same ones. Of two
    equally good models the later one is kept. Files have Stable-Baselines3's format and are written
    atomically. A resumed run keeps the evaluations before its checkpoint. The pretraining is evaluated as
    well, with a negative time step: minus the number of its remaining gradient steps.

    :param verbose: 1 prints a line for each evaluation
    """

    def __init__(self, run: Run, env: VecEnv, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.run, self.env = run, env
        self.episodes, self.freq = run.options.eval_episodes, run.options.eval_freq
        self._arrays: dict[str, list[Any]] = {"timesteps": [], "results": [], "ep_lengths": []}
        self._best = -np.inf
        self._evaluated_pretraining = 0
        """Gradient steps of the pretraining at its latest evaluation."""

    def _init_callback(self) -> None:
        self._calls = max(self.freq // self.training_env.num_envs, 1)
        if not self.run.evaluations_file.is_file():
            return
        path = self.run.evaluations_file
        with refused(f"{path} is damaged"), np.load(path) as saved:
            known = saved["timesteps"] <= training_time(self)
            self._arrays = {name: list(saved[name][known]) for name in saved}
        if self._arrays["timesteps"] and self._arrays["timesteps"][-1] == training_time(self):
            self._evaluated_pretraining = getattr(self.model, "n_pretrained", 0)
        self._best = max((float(np.mean(returns)) for returns in self._arrays["results"]), default=-np.inf)

    def _on_step(self) -> bool:
        if (self.num_timesteps // self.training_env.num_envs) % self._calls == 0:
            self._evaluate(stream_seed(self.run.seed, SeedStream.EVALUATION, self.num_timesteps))
        return True

    def _on_rollout_start(self) -> None:
        pretrained: int = getattr(self.model, "n_pretrained", 0)
        if self.model.num_timesteps or not pretrained or pretrained == self._evaluated_pretraining:
            return
        if pretrained % self._calls == 0 or training_time(self) == 0:
            self._evaluated_pretraining = pretrained
            self._evaluate(stream_seed(self.run.seed, SeedStream.PRETRAINING, pretrained))

    def _evaluate(self, seed: int) -> None:
        self.env.seed(seed)
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.env)
        successes: list[bool] = []

        def note(local: dict[str, Any], _: dict[str, Any]) -> None:
            if local["done"] and "is_success" in local["info"]:
                successes.append(bool(local["info"]["is_success"]))

        with expanded_filters(self.model.policy):
            returns, lengths = evaluate_policy(
                self.model, self.env, self.episodes, return_episode_rewards=True, callback=note
            )
        assert isinstance(returns, list) and isinstance(lengths, list)
        self._record(returns, lengths, successes)

    def _record(self, returns: list[float], lengths: list[int], successes: list[bool]) -> None:
        """Log an evaluation, append it to the file, and save the model if it is the best."""
        time, mean = training_time(self), float(np.mean(returns))
        row = {"timesteps": time, "results": returns, "ep_lengths": lengths}
        figures = {"mean_reward": mean, "mean_ep_length": float(np.mean(lengths))}
        if successes:
            row["successes"] = successes
            figures["success_rate"] = float(np.mean(successes))
        for name, value in row.items():
            self._arrays.setdefault(name, []).append(value)
        with whole_file(self.run.evaluations_file) as partial:
            arrays: dict[str, Any] = {name: np.asarray(values) for name, values in self._arrays.items()}
            np.savez(partial, **arrays)
        for name, value in figures.items():
            self.logger.record(f"eval/{name}", value)
        self.logger.record("time/total_timesteps", time, exclude="tensorboard")
        self.logger.dump(time)
        is_best = mean >= self._best
        if self.verbose >= 1:
            text = ", ".join(f"{name} {value:.2f}" for name, value in figures.items())
            print(f"Evaluation at time step {time}: {text}{', the best so far' if is_best else ''}")
        if is_best:
            self._best = mean
            save_model(self.run, self.model, self.run.best_model)


def save_model(run: Run, model: BaseAlgorithm, path: Path) -> None:
    """Save a model, and its normalisation statistics to the run's file, atomically."""
    with whole_file(path) as partial:
        model.save(partial)
    if (statistics := model.get_vec_normalize_env()) is not None:
        with whole_file(run.statistics_file) as partial:
            statistics.save(str(partial))


class TrainingLog(BaseCallback):
    """
    Callback that writes the means of all values logged under ``train/``.

    Rows with a negative time step belong to the pretraining. The file is written atomically. A resumed run
    keeps the rows before its checkpoint.

    :param freq: Time steps of all environments between two rows
    """

    def __init__(self, path: Path, freq: int) -> None:
        super().__init__()
        self.path, self.freq = path, freq
        self._rows: list[dict[str, float]] = []
        self._values: defaultdict[str, list[float]] = defaultdict(list)
        self._last: int | None = None

    def _init_callback(self) -> None:
        if self.path.is_file():
            known = read_training_log(self.path)
            rows = known[known[TIMESTEPS] <= training_time(self)].to_dict("records")
            self._rows = [{str(name): value for name, value in row.items()} for row in rows]

    def _on_rollout_start(self) -> None:
        # Between two rollouts, the logger still has the values of the latest updates.
        for name, value in self.logger.name_to_value.items():
            if name.startswith(PREFIX):
                self._values[name.removeprefix(PREFIX)].append(float(value))
        now = training_time(self)
        if self._last is None:  # only now the model has its number of pretraining steps
            self._last = now
        if now // self.freq > self._last // self.freq:
            self._write()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._write()

    def _write(self) -> None:
        if not self._values:
            return
        now = self._last = training_time(self)
        means = {name: sum(values) / len(values) for name, values in self._values.items()}
        self._rows.append({TIMESTEPS: now, **means})
        self._values.clear()
        with whole_file(self.path) as partial:
            pd.DataFrame(self._rows).to_csv(partial, index=False)


def training_time(callback: BaseCallback) -> int:
    """Return the time steps so far, minus the remaining gradient steps of the pretraining."""
    left: int = getattr(callback.model, "pretraining_left", 0)
    return callback.model.num_timesteps - left
