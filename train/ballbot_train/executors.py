"""Where work is done: in this process, in processes of this machine, or on the nodes of a Ray cluster.

Each of the three is a `Pool`. It runs tasks, which are generator functions, and gives back what they yield as soon as they
yield it. Items of `jobs` and trials of `learning.tuning` are tasks. A task gets its arguments and
nothing else, so a worker needs no file of this machine.
"""

import math
import os
import pickle
import shutil
import signal
import time
import traceback
from collections.abc import Callable, Hashable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any, Literal, Protocol

from ballbot_gym import registry
from ballbot_gym.lazy import missing
from ballbot_gym.robots import Robot
from ballbot_train.console import console

_NODE_SECONDS = 5.0  # how often the nodes of a cluster are counted
_OBJECT_STORE = 200 * 2**20  # bytes of a cluster started here: results are small and go to this process at once


class WorkerError(RuntimeError):
    """Worker processes died, and died again when their items were tried once more; or there is no cluster."""


@dataclass(frozen=True)
class Workers:
    """Where the items of a run are done. The results are the same everywhere."""

    workers: int | None = None
    """Processes, or tasks on a Ray cluster; default, all cores."""
    ray: str | None = None
    """Address of a Ray cluster, HOST:PORT, "auto" or "local"."""

    @classmethod
    def of(cls, workers: "int | Workers") -> "Workers":
        """A number of processes as workers; raises a ValueError where there are none."""
        workers = workers if isinstance(workers, Workers) else cls(workers)
        if workers.workers is not None and workers.workers < 1:
            raise ValueError(f"workers must be at least 1, not {workers.workers}")
        if workers.ray is not None and workers.ray.startswith("ray://"):
            raise ValueError(
                f"{workers.ray} is the address of a Ray client, which is not supported; run the command on a "
                "node of the cluster with --ray auto, for example by `ray job submit`"
            )
        return workers

    @property
    def named(self) -> int | str:
        """What results say: a number of processes, or that a cluster did the work."""
        return self.here or "a Ray cluster"

    @property
    def here(self) -> int:
        """Processes that work on this machine; 0 where a cluster does the work."""
        return (self.workers or os.cpu_count() or 1) if self.ray is None else 0


@dataclass(frozen=True)
class Event:
    """What happened to a task."""

    key: Hashable
    """Of the task, as given to `Pool.start`."""
    kind: Literal["yielded", "ended", "worker died", "node died"]
    value: Any = None
    """What the task yielded."""


class Pool(Protocol):
    """Runs tasks. An exception that a task raises is raised by `events`."""

    def has_room(self) -> bool:
        """Whether another task may be started. Who starts no others keeps few tasks in memory."""
        ...

    def start(self, key: Hashable, function: Callable[..., Iterator[Any]], *arguments: Any) -> None:
        """Runs a generator function of a module on a worker."""
        ...

    def events(self) -> list[Event]:
        """What happened since the last call; waits until something has. Those of one task are in order."""
        ...

    def stop(self, key: Hashable) -> None:
        """Ends a task at once. No more is heard of it."""
        ...


@contextmanager
def open_pool(workers: int | Workers, serial: bool = False, per_core: int = 2) -> Iterator[Pool]:
    """The pool of some workers. At the end of the block whatever still runs is stopped.

    Args:
        workers: a number of processes of this machine, or `Workers`.
        serial: do everything in this process.
        per_core: tasks in flight for every core of a cluster; with two, no core waits for its next task.
    """
    workers = Workers.of(workers)
    with ExitStack() as stack:
        if serial:
            yield _Serial()
        elif workers.ray is None:
            pool = _Processes(workers.here)
            stack.callback(pool.close)
            yield pool
        else:
            yield stack.enter_context(_cluster(workers, per_core))


class _Serial:
    """The calling process, which does one task at a time."""

    def __init__(self) -> None:
        self._running: dict[Hashable, Iterator[Any]] = {}

    def has_room(self) -> bool:
        return not self._running

    def start(self, key: Hashable, function: Callable[..., Iterator[Any]], *arguments: Any) -> None:
        self._running[key] = function(*arguments)

    def events(self) -> list[Event]:
        key, generator = next(iter(self._running.items()))
        for value in generator:
            return [Event(key, "yielded", value)]
        del self._running[key]
        return [Event(key, "ended")]

    def stop(self, key: Hashable) -> None:
        self._running.pop(key, None)


class _Processes:
    """Processes of this machine. Each does one task at a time, so one that dies takes only its own task with it."""

    def __init__(self, count: int):
        os.environ.setdefault("OMP_NUM_THREADS", "1")  # processes share the cores, not the threads of each
        self._context = get_context("spawn")  # a forked child would share PyBullet's clients and CasADi's state
        self._count = count
        self._idle: list[tuple[Any, Connection]] = []
        self._busy: dict[Connection, tuple[Hashable, Any]] = {}

    def has_room(self) -> bool:
        return len(self._busy) < self._count

    def start(self, key: Hashable, function: Callable[..., Iterator[Any]], *arguments: Any) -> None:
        while self._idle:
            process, ours = self._idle.pop()
            if process.is_alive():
                break
        else:
            ours, theirs = self._context.Pipe()
            process = self._context.Process(target=_serve, args=(theirs, *registry.registered()))
            process.start()
            theirs.close()  # so that the pipe ends with the process
        assert isinstance(ours, Connection)
        self._busy[ours] = key, process
        try:
            ours.send((function, arguments))
        except OSError:  # it has just died, which `events` will find
            return

    def events(self) -> list[Event]:
        found = []
        for ours in wait(list(self._busy)):
            assert isinstance(ours, Connection)
            key, process = self._busy[ours]
            try:
                kind, value = ours.recv()
            except (EOFError, OSError):
                kind, value = "worker died", None
                process.join()
            if kind == "raised":
                assert value is not None
                raise value[0] from WorkerError(f"in a worker:\n{value[1]}")
            if kind != "yielded":
                del self._busy[ours]
                if kind == "ended":
                    self._idle.append((process, ours))
            found.append(Event(key, kind, value))
        return found

    def stop(self, key: Hashable) -> None:
        for ours, (running, process) in list(self._busy.items()):
            if running == key:
                process.terminate()
                del self._busy[ours]

    def close(self) -> None:
        for process, ours in [*self._idle, *((process, ours) for ours, (_, process) in self._busy.items())]:
            process.terminate()
            ours.close()


def _serve(connection: Connection, modules: tuple[str, ...], robots: dict[str, Robot]) -> None:
    """Does the tasks that come through a pipe until it ends. Modules and robots are those that users registered."""
    prepare_worker(modules, robots)
    try:
        while True:
            for message in _messages(*connection.recv()):
                connection.send(message)
    except (EOFError, OSError):  # the run was killed, and may already go on in another process
        os._exit(1)


def prepare_worker(modules: tuple[str, ...], robots: dict[str, Robot]) -> None:
    """Gives this process what users registered in the one that started it, and lets it end with that one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which then ends its workers
    Thread(target=_end_with_the_run, daemon=True).start()
    registry.restore(modules, robots)


def _end_with_the_run() -> None:
    """Ends this worker as soon as the run is killed. Else it would finish its item, which can take minutes, for nobody."""
    run = parent_process()
    if run is not None:
        wait([run.sentinel])
        os._exit(1)


def _messages(function: Callable[..., Iterator[Any]], arguments: tuple[Any, ...]) -> Iterator[tuple[str, Any]]:
    try:
        for value in function(*arguments):
            yield "yielded", value
    except Exception as error:
        yield "raised", (_sendable(error), traceback.format_exc())
    else:
        yield "ended", None


def _sendable(error: Exception) -> Exception:
    """The error, or a RuntimeError that says the same if it cannot be pickled."""
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(repr(error))


@contextmanager
def _cluster(workers: Workers, per_core: int) -> Iterator[Pool]:
    """A pool of tasks on a Ray cluster. Connects to the cluster, unless this process is connected to one already.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        WorkerError: there is no cluster at the address.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise missing("--ray", error.name, "ray") from error
    connected = ray.is_initialized()
    with TemporaryDirectory() as folder:
        if not connected:
            quiet: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
            try:
                if workers.ray == "local":
                    count = workers.workers or os.cpu_count() or 1
                    ray.init(
                        "local", num_cpus=count, object_store_memory=_OBJECT_STORE, include_dashboard=False, **quiet
                    )
                else:
                    environment = {"py_modules": _code(Path(folder)), "env_vars": {"OMP_NUM_THREADS": "1"}}
                    ray.init(workers.ray, runtime_env=environment, **quiet)
            except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
                raise WorkerError(
                    f"no Ray cluster can be used at {workers.ray} ({error}); `ray start --head` starts one, and --ray local "
                    "starts one for this run alone"
                ) from error
        pool = _Ray(ray, workers.workers, per_core)
        try:
            yield pool
        finally:
            if connected:
                pool.close()
            else:
                ray.shutdown()  # which ends the tasks too


def _code(folder: Path) -> list[str]:
    """Copies our packages, as a wheel holds them, and modules with users' tasks, for the nodes; says where. Their
    dependencies are not among them.
    """
    from ballbot_gym.params import URDF_FOLDER

    found = []
    modules = (name.partition(".")[0] for name in registry.registered()[0])
    for name in dict.fromkeys(("ballbot_gym", "ballbot_baselines", "ballbot_train", *modules)):
        spec = find_spec(name)
        assert spec is not None
        assert spec.origin is not None
        path = Path(spec.origin)
        found.append(str(folder / (name if path.stem == "__init__" else path.name)))
        if path.stem == "__init__":
            shutil.copytree(path.parent, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(path, folder)
    shutil.copytree(URDF_FOLDER, folder / "ballbot_gym" / "urdf", dirs_exist_ok=True)
    return found


class _Ray:
    """Tasks of one core each on the nodes of the cluster to which this process is connected.

    Ray repeats no task by itself, because a task that is started anew would repeat what it has yielded. Who started the
    task hears that its worker or node died, and starts what is left.
    """

    def __init__(self, ray: Any, workers: int | None, per_core: int):
        self._ray, self._workers, self._per_core = ray, workers, per_core
        # a name with a module, so that nodes import the function rather than unpickle it
        self._task = ray.remote(num_cpus=1, max_retries=0, num_returns="streaming")(_stream)
        self._running: dict[Any, Hashable] = {}
        self._counted, self._nodes, self._cores = -math.inf, 0, 0
        self._count_nodes()

    def has_room(self) -> bool:
        self._count_nodes()
        most = self._workers or max(1, self._per_core * self._cores)
        return len(self._running) < most

    def start(self, key: Hashable, function: Callable[..., Iterator[Any]], *arguments: Any) -> None:
        self._running[self._task.remote(function, arguments, *registry.registered())] = key

    def events(self) -> list[Event]:
        ready = []
        while not ready:
            tasks = list(self._running)
            if self._ray.wait(tasks, num_returns=1, timeout=_NODE_SECONDS)[0]:
                ready = self._ray.wait(tasks, num_returns=len(tasks), timeout=0)[0]
            self._count_nodes()
        return [self._event(task) for task in ready]

    def _event(self, task: Any) -> Event:
        key, failed = self._running[task], self._ray.exceptions
        try:
            return Event(key, "yielded", self._ray.get(next(task)))
        except StopIteration:
            kind = "ended"
        except failed.RayTaskError as error:
            raise error.cause if isinstance(error.cause, Exception) else error from error
        except failed.RuntimeEnvSetupError as error:
            raise WorkerError(f"a node of the cluster cannot be prepared: {error}") from error
        except failed.NodeDiedError:
            kind = "node died"
        except failed.RayError:  # a worker that crashed or was out of memory, or a result that was lost with its node
            kind = "worker died"
        del self._running[task]
        return Event(key, kind)

    def stop(self, key: Hashable) -> None:
        for task, running in list(self._running.items()):
            if running == key:
                self._ray.cancel(task, force=True)
                del self._running[task]

    def close(self) -> None:
        for key in list(self._running.values()):
            self.stop(key)

    def _count_nodes(self) -> None:
        """Counts nodes and cores now and then, and says when they change."""
        if time.monotonic() - self._counted < _NODE_SECONDS:
            return
        self._counted = time.monotonic()
        nodes = [node for node in self._ray.nodes() if node["Alive"]]
        counts = len(nodes), int(sum(node["Resources"].get("CPU", 0) for node in nodes))
        if counts != (self._nodes, self._cores):
            self._nodes, self._cores = counts
            console.print(f"Ray: {self._nodes} nodes with {self._cores} cores")


def _stream(
    function: Callable[..., Iterator[Any]],
    arguments: tuple[Any, ...],
    modules: tuple[str, ...],
    robots: dict[str, Robot],
) -> Iterator[Any]:
    registry.restore(modules, robots)
    for value in function(*arguments):  # noqa: UP028  # `yield from` hands on what Ray sends, which few iterators take
        yield value
