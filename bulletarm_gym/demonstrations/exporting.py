"""Demonstrations in the formats of other libraries."""

from contextlib import closing
from typing import TYPE_CHECKING, Any

from bulletarm_gym.demonstrations.episodes import Demonstrations

if TYPE_CHECKING:
    from minari import MinariDataset


def export_minari(demonstrations: Demonstrations, dataset_id: str, **metadata: Any) -> "MinariDataset":
    """Store demonstrations as a dataset of Minari, in its own folder for datasets.

    :param dataset_id: such as ``"bulletarm/block-picking/expert-v0"``
    :param metadata: more for ``minari.create_dataset_from_buffers()``, such as ``author``
    :raises ImportError: Minari is not installed
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
    except ImportError as error:
        raise ImportError("Minari is missing: pip install 'bulletarm-gym[minari]'") from error
    names = ("observations", "actions", "rewards", "terminations", "truncations", "seed")
    buffers = [
        EpisodeBuffer(id=number, **{name: getattr(episode, name) for name in names})
        for number, episode in enumerate(demonstrations)
    ]
    with closing(demonstrations.make_env()) as env:
        return minari.create_dataset_from_buffers(
            dataset_id, buffers, env=env, **{"algorithm_name": demonstrations.about["planner"], **metadata}
        )
