"""Rows of the files in which measured speeds are kept."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from zoo_configs.cells.rules import family_of, task_name
from zoo_configs.measuring.data_files import Record, number
from zoo_configs.measuring.provenance import env_kwargs_words, key_values, provenance
from zoo_configs.measuring.throughput import ReferenceRate, Throughput

if TYPE_CHECKING:
    from zoo_configs.cells.cell import Cell
    from zoo_configs.measuring.overhead import Overhead
    from zoo_configs.measuring.update_speed import UpdateSpeed

PROGRAM = ("bulletarm-zoo", "speed")
TIME_DIGITS, SHARE_DIGITS, LOAD_DIGITS = 2, 3, 1


def throughput_record(
    ours: Throughput, reference: ReferenceRate | None, env_kwargs: Mapping[str, Any], flags: Sequence[str]
) -> Record:
    """
    Keep the speed of an environment.

    :param ours: What was measured
    :param reference: What it is compared with, if anything
    :param env_kwargs: Parameters of the environment
    :param flags: Words of the command besides them and the environment's id
    :return: A row of :data:`~zoo_configs.measuring.data_files.SPEED`
    """
    scaled = reference.scaled_to(ours.yardstick) if reference else float("nan")
    command = [*PROGRAM, "--env", ours.env_id, *flags, *env_kwargs_words(env_kwargs)]
    return {
        "env": task_name(ours.env_id),
        "env_kwargs": " ".join(key_values(env_kwargs)),
        "yardstick_us": number(ours.yardstick.step_us, 1),
        "steps_per_second": number(ours.steps_per_second, 1),
        "step_ms": number(ours.step_ms, TIME_DIGITS),
        "physics_ms": number(ours.physics_ms, TIME_DIGITS),
        "rendering_ms": number(ours.rendering_ms, TIME_DIGITS),
        "rest_ms": number(ours.rest_ms, TIME_DIGITS),
        "without_expert_ms": number(ours.without_expert_ms, TIME_DIGITS),
        "unsimulated": number(ours.unsimulated, SHARE_DIGITS),
        "reset_ms": number(ours.reset_ms, TIME_DIGITS),
        "success": number(ours.success_rate, SHARE_DIGITS),
        "episodes": str(ours.episodes),
        "reference_steps_per_second": number(scaled, 1),
        "times_reference": number(ours.steps_per_second / scaled, 1),
        "load": number(ours.load, LOAD_DIGITS),
        **provenance(command),
    }


def update_record(
    cell: Cell, speed: UpdateSpeed, env_kwargs: Mapping[str, Any], flags: Sequence[str]
) -> Record:
    """
    Keep the time of an update.

    :param cell: Whose update it is
    :param speed: What was measured
    :param env_kwargs: Parameters of the environment that are not the cell's own
    :param flags: Words of the command besides what names the cell
    :return: A row of :data:`~zoo_configs.measuring.data_files.UPDATES`
    """
    ratio = float("nan") if speed.convolution_ratio is None else speed.convolution_ratio
    shares = {part.replace(" ", "_"): number(share, SHARE_DIGITS) for part, share in speed.shares.items()}
    command = [*_naming(cell), *flags, *env_kwargs_words(env_kwargs)]
    return {
        **_names(cell),
        "env_kwargs": " ".join(key_values(env_kwargs)),
        "device": speed.device,
        "network": family_of(cell.env_id).baselines[cell.label].network,
        "threads": str(speed.threads),
        "update_ms": number(speed.update_ms, 1),
        "peak_gigabytes": number(speed.peak_gigabytes, 1),
        **shares,
        "equivariant_over_plain": number(ratio, 2),
        "load": number(speed.load, LOAD_DIGITS),
        **provenance(command, speed.device),
    }


def overhead_record(
    cell: Cell, timesteps: int, measured: Overhead, env_kwargs: Mapping[str, Any], flags: Sequence[str]
) -> Record:
    """
    Keep what the workbench adds to a training.

    :param cell: What is trained
    :param timesteps: Time steps of a training
    :param measured: What was measured
    :param env_kwargs: Parameters of the environment that are not the cell's own
    :param flags: Words of the command besides what names the cell
    :return: A row of :data:`~zoo_configs.measuring.data_files.OVERHEAD`
    """
    shares = measured.shares
    command = [*_naming(cell), "--overhead", str(timesteps), *flags, *env_kwargs_words(env_kwargs)]
    return {
        **_names(cell),
        "env_kwargs": " ".join(key_values(env_kwargs)),
        "timesteps": str(timesteps),
        "bare_seconds": number(statistics.median(measured.bare), 1),
        "train_seconds": number(statistics.median(measured.workbench), 1),
        "overhead": number(statistics.median(shares), SHARE_DIGITS),
        "least": number(shares[0], SHARE_DIGITS),
        "greatest": number(shares[-1], SHARE_DIGITS),
        **provenance(command),
    }


def _names(cell: Cell) -> Record:
    return {"baseline": cell.label, "preset": str(cell.preset), "env": task_name(cell.env_id)}


def _naming(cell: Cell) -> list[str]:
    """Words of the command that name a cell."""
    return [*PROGRAM, "--baseline", cell.label, "--preset", str(cell.preset), "--env", cell.env_id]
