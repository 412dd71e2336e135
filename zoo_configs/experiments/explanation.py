"""An experiment as YAML in which a comment on each line names the source of the value and its reason."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from zoo_configs.experiments.config import OVERRIDES, ExperimentConfig, explain
from zoo_configs.experiments.rules import Layer
from zoo_configs.yaml_files import format_yaml

DEFAULT = Layer("default")


def explained_yaml(experiment: ExperimentConfig, options: Mapping[str, Any], given: Mapping[str, Any]) -> str:
    """
    Format an experiment with the sources of its values.

    :param experiment: The experiment
    :param options: Options of the training by name
    :param given: Those that the command line defines
    :return: YAML, which ``train --conf-file`` reads as well
    """
    sources: dict[str, Layer] = {}
    if experiment.baseline is not None and experiment.preset is not None:
        names = (
            experiment.baseline,
            experiment.preset,
            experiment.env_id,
            experiment.overrides,
            experiment.benchmark,
        )
        _, sources = explain(*names)
    elsewhere = {f"hyperparams.{name}": OVERRIDES for name in experiment.overrides}
    flags = {
        f"flags.{name}": OVERRIDES if name in given else sources.get(f"flags.{name}", DEFAULT)
        for name in options
    }
    sources = {"hyperparams": DEFAULT, "algo": OVERRIDES, **elsewhere, **sources, **flags}
    lines = [_line("algo", experiment.algo, sources["algo"]), f"{experiment.env_id}:"]
    lines += _lines(experiment.hyperparams, "hyperparams", sources)
    return "\n".join([*lines, "options:", *_lines(options, "flags", sources)])


def _lines(
    values: Mapping[str, Any], name: str, sources: Mapping[str, Layer], indent: str = "  "
) -> Iterator[str]:
    for key, value in values.items():
        inner = f"{name}.{key}"
        if isinstance(value, Mapping) and value:
            yield f"{indent}{key}:"
            yield from _lines(value, inner, sources, f"{indent}  ")
        else:
            yield indent + _line(key, value, _source(inner, sources))


def _source(name: str, sources: Mapping[str, Layer]) -> Layer:
    """Return the layer of a dotted name, or of the nearest name around it."""
    while name not in sources:
        name = name.rpartition(".")[0]
    return sources[name]


def _line(key: str, value: Any, layer: Layer) -> str:
    text = f"{format_yaml({key: value}, inline=True)[1:-1]}  # {layer.source}"
    return f"{text}: {layer.why}" if layer.why else text
