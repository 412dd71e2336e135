"""Learners that extend SACfD take all that it takes, by name, and pass it on as it was given."""

import inspect
from typing import Any

import pytest

from sb3_extensions.ferm import FERM
from sb3_extensions.sacfd import SACfD
from sb3_extensions.tqcfd import TQCfD

OTHER_DEFAULTS = {FERM: {"augmentation": "rad"}, TQCfD: {}}
PARAMETERS = inspect.signature(SACfD).parameters


class Reached(Exception):
    """The parent's constructor was called."""


@pytest.mark.parametrize("learner", [FERM, TQCfD])
def test_takes_what_sacfd_takes(learner: type[SACfD]) -> None:
    own = inspect.signature(learner).parameters
    defaults = {name: own[name].default for name in PARAMETERS}
    expected = {name: parameter.default for name, parameter in PARAMETERS.items()}
    assert defaults == expected | OTHER_DEFAULTS[learner]
    assert all(parameter.kind is parameter.POSITIONAL_OR_KEYWORD for parameter in own.values())


@pytest.mark.parametrize("learner", [FERM, TQCfD])
def test_passes_on_what_it_is_given(learner: type[SACfD], monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(self: SACfD, *args: Any, **kwargs: Any) -> None:
        raise Reached(args, kwargs)

    given = {name: object() for name in PARAMETERS}
    monkeypatch.setattr(SACfD, "__init__", stop)
    with pytest.raises(Reached) as reached:
        learner(**given)  # type: ignore[arg-type]
    args, kwargs = reached.value.args
    expected: dict[str, Any] = {**given, "_init_setup_model": False}
    assert args == (expected.pop("policy"), expected.pop("env"))
    assert kwargs == expected
