"""Saves what happened in a playground as trajectory files, which the browser that asks downloads."""

from pathlib import Path
from typing import Any

from ballbot_train.play.simulation import Playground

MOST_FILES = 200
MOST_BYTES = 2**28


class Saver:
    """Writes files into a folder: so many and so large ones that nobody who opens the page fills the disk."""

    def __init__(self, playground: Playground, out: Path):
        self.out = out
        self._playground = playground
        self._number = self._count = self._bytes = 0

    def save_trajectory(self, client: Any) -> None:
        """Writes the episode so far, and hands it to viser's client."""
        if self._count >= MOST_FILES or self._bytes >= MOST_BYTES:
            raise ValueError(
                f"{self._count} files of {self._bytes / 2**20:.0f} MiB are saved; start ballbot play again to save more"
            )
        path = self._playground.trajectory().save(self._free_path())
        content = path.read_bytes()
        self._count += 1
        self._bytes += len(content)
        self._playground.crew.notice = f"saved {path}"
        client.send_file_download(path.name, content, save_immediately=True)

    def _free_path(self) -> Path:
        name = Path(self._playground.main.name).stem.replace(" ", "-")
        while True:
            self._number += 1
            path = self.out / f"{self._playground.world.task_name}-{name}-{self._number}.npz"
            if not path.exists():
                return path
