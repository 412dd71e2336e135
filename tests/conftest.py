"""Settings of the whole suite: one compute thread a worker, no display.

They are environment variables, set before any test imports a library, so that child processes inherit them.
"""

import os

for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"  # PyTorch, too, takes its thread count from OMP_NUM_THREADS
os.environ["MPLBACKEND"] = "Agg"

import gc  # noqa: E402

import gymnasium  # noqa: E402
import pytest  # noqa: E402

from bulletarm_gym.registry import VARIABLE  # noqa: E402


@pytest.fixture(scope="session", autouse=True)
def quick_collections():
    """Leave what was imported to collect tests out of the garbage collector's rounds, half a second each."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def announcements(monkeypatch):
    """Tell later processes nothing of what a test registers."""
    monkeypatch.setenv(VARIABLE, "{}")


@pytest.fixture
def own_registrations():
    """Remove the environments of ``my_...`` modules and of ``door`` from Gymnasium's registry."""
    yield
    for env_id, spec in list(gymnasium.registry.items()):
        if any(
            str(spec.kwargs.get(part, "")).startswith(("my_", "door:"))
            for part in ("task", "control", "surface")
        ):
            del gymnasium.registry[env_id]
