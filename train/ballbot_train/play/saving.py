"""Saves what happened in a playground: trajectory files and films, which the browser that asks downloads."""

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ballbot_train.play import views
from ballbot_train.play.background import OtherProcess
from ballbot_train.play.simulation import Playground
from ballbot_train.report.replay import Replay

MOST_FILES = 200
MOST_BYTES = 2**28
_FILM_WIDTH = 640  # px
_FILM_FPS = 20


class Saver:
    """Writes files into a folder: so many and so large ones that nobody who opens the page fills the disk."""

    def __init__(self, playground: Playground, out: Path):
        self.out = out
        self._playground = playground
        self._number = self._count = self._bytes = 0
        self._process: OtherProcess | None = None
        self._thread = ThreadPoolExecutor(1, "ballbot-film")
        self._film: tuple[Any, Future] | None = None

    def save_trajectory(self, client: Any) -> None:
        """Writes the episode so far, and hands it to viser's client."""
        trajectory = self._playground.trajectory()
        self._hand_over(client, trajectory.save(self._path(".npz")))

    def save_film(self, client: Any, ending: str) -> None:
        """Begins a film of the episode so far in another process: it takes all of a core. `poll` hands it to the client."""
        if self._film is not None:
            raise ValueError("a film is being drawn; wait for it")
        replay, path = views.replay(self._playground), self._path(ending)
        if self._process is None or self._process.pid is None:
            self._process = OtherProcess()
        self._film = client, self._thread.submit(self._process, film, replay, path)
        self._playground.crew.notice = f"drawing {path} …"

    def poll(self) -> None:
        """Hands over a film that is finished."""
        if self._film is None or not self._film[1].done():
            return
        (client, made), self._film = self._film, None
        if (error := made.exception()) is not None:
            raise ValueError(f"no film: {error}")
        self._hand_over(client, made.result())

    def close(self) -> None:
        """Gives up a film that is not finished; may be called again."""
        if self._process is not None:
            self._process.close()
        self._thread.shutdown()

    def _path(self, ending: str) -> Path:
        if self._count >= MOST_FILES or self._bytes >= MOST_BYTES:
            raise ValueError(
                f"{self._count} files of {self._bytes / 2**20:.0f} MiB are saved; start ballbot play again to save more"
            )
        name = Path(self._playground.main.name).stem.replace(" ", "-")
        while True:
            self._number += 1
            path = self.out / f"{self._playground.world.task_name}-{name}-{self._number}{ending}"
            if not path.exists():
                self._count += 1
                return path

    def _hand_over(self, client: Any, path: Path) -> None:
        content = path.read_bytes()
        self._bytes += len(content)
        self._playground.crew.notice = f"saved {path}"
        client.send_file_download(path.name, content, save_immediately=True)


def film(replay: Replay, path: Path) -> Path:
    """Writes a film as large as the page hands it over."""
    from ballbot_train.report.film import write_film

    return write_film(replay, path, replay.duration, fps=_FILM_FPS, width=_FILM_WIDTH)
