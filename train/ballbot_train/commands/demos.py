"""`ballbot demos`: demonstrations of an expert as a Minari dataset."""

import shlex
from pathlib import Path
from typing import Annotated

import numpy as np

from ballbot_gym.robot import file_name
from ballbot_train.commands.options import UNNAMED, WorkersOption
from ballbot_train.learning.demonstrations import DemoConfig, write_demos, write_shards
from ballbot_train.work.console import console
from ballbot_train.work.executors import Workers


def demos(
    config: Annotated[DemoConfig, UNNAMED],
    shards: str | None = None,
    out: Path | None = None,
    workers: WorkersOption = Workers(),
) -> None:
    """Records episodes of an expert, with exploration noise, as a Minari dataset. Started again, a killed run continues.

    Args:
        config: what is recorded.
        shards: URL or folder for a set of shards instead of a Minari dataset, for more episodes than fit into memory; see
            `ballbot_train.work.shards`.
        out: folder of the dataset, named NAME-vNUMBER; default runs/demos/TASK-EXPERT-v0.
        workers: where the work is done.
    """
    kind, folder = f"{file_name(config.task, config.robot)}-{config.expert}", Path("runs") / "demos"
    if shards is not None:
        made = write_shards(config, shards, out or folder / f".{kind}.shards", workers)
        console.print(f"{made.url}: {made.episodes} episodes in {len(made.numbers)} shards", markup=False)
        return
    folder = write_demos(config, out or folder / f"{kind}-v0", workers)
    import minari

    dataset = minari.MinariDataset(folder / "data")
    facts = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
    success = np.mean([fact["success"] for fact in facts])
    load = f"import minari; minari.load_dataset({folder.name!r})"
    console.print(
        f"{len(facts)} episodes, {dataset.total_steps} steps, {100 * success:.1f} % successful in spite of noise and "
        f"pushes\nMINARI_DATASETS_PATH={shlex.quote(str(folder.parent))} python -c {shlex.quote(load)}",
        markup=False,
        soft_wrap=True,
    )
