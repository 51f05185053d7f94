"""Where work is done: in this process, in processes of this machine, or on the nodes of a Ray cluster.

A task gets its arguments and nothing else, so a worker needs no file of this machine. Jobs of `jobs` and missing
optima are tasks.
"""

import itertools
import os
import pickle
import shutil
import signal
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any, TypeVar

from ballbot_gym import registry
from ballbot_gym.lazy import imports_of
from ballbot_gym.robot import Registered

_NODE_SECONDS = 5.0  # between two looks whether a cluster has more cores
_RETRIES = 5  # of a task on a cluster whose worker or node dies
_OBJECT_STORE = 200 * 2**20  # bytes of a cluster started here: results are small and go to this process at once
_PER_CORE = 2  # tasks in flight for every core of a cluster, so that no core waits for its next one
_NOT_STARTED = (
    "a worker process could not start; its own error is above. Each imports the script that started the run, so a script "
    'must do its work under if __name__ == "__main__":, or with workers=1'
)

Key = TypeVar("Key")


class WorkerError(RuntimeError):
    """A worker died; or, on a cluster, several workers died at the same task; or there is no cluster."""


@dataclass(frozen=True)
class Workers:
    """Where the work of a command is done. The results are the same everywhere."""

    workers: int | None = None
    """Number of processes, or of jobs at the same time on a Ray cluster; default, one for every core."""
    ray: str | None = None
    """Address of a Ray cluster, HOST:PORT, "auto" or "local"."""

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be at least 1, not {self.workers}")
        if self.ray is not None and self.ray.startswith("ray://"):
            raise ValueError(
                f"{self.ray} is the address of a Ray client, which is not supported; run the command on a "
                "node of the cluster with --ray auto, for example by `ray job submit`"
            )

    @classmethod
    def of(cls, workers: "int | Workers") -> "Workers":
        """A number of processes as workers; raises a ValueError where there are none."""
        return workers if isinstance(workers, Workers) else cls(workers)

    @property
    def here(self) -> int:
        """Processes that work on this machine; 0 where a cluster does the work."""
        return (self.workers or os.cpu_count() or 1) if self.ray is None else 0


Task = tuple[Key, Callable[..., Any], tuple[Any, ...]]
"""The key that identifies a task, and a function of a module with its arguments."""


def completed(tasks: Iterable[Task[Key]], workers: int | Workers) -> Iterator[tuple[Key, Any]]:
    """Does tasks on workers, and gives the result of each when it is there, with the task's key.

    Args:
        tasks: what there is to do. They are taken when workers have room for them, so that few are in memory.
        workers: a number of processes of this machine, or `Workers`. 1 process is this one. Where there is nothing to do,
            none starts.

    Raises:
        WorkerError: a worker died, or there is no cluster.
        Exception: what a task raised, once the results are given that came with it.
    """
    workers, tasks = Workers.of(workers), iter(tasks)
    if workers.here == 1:
        for key, function, arguments in tasks:
            yield key, function(*arguments)
        return
    if (first := next(tasks, None)) is None:
        return
    tasks, running = itertools.chain([first], tasks), dict[Future, Key]()
    with _local(workers) if workers.ray is None else _cluster(workers) as (submit, most):
        while True:
            for key, function, arguments in itertools.islice(tasks, max(0, most() - len(running))):
                running[submit(function, arguments, *registry.registered())] = key
            if not running:
                return
            ended = wait(running, _NODE_SECONDS, FIRST_COMPLETED).done
            for future in sorted(ended, key=lambda future: future.exception() is not None):
                yield running.pop(future), _result_of(future)


def _result_of(future: Future) -> Any:
    """What the function of a task returned.

    Raises:
        WorkerError: the worker died.
        Exception: what the function raised.
    """
    try:
        value, error, text = future.result()
    except Exception as died:  # a task gives its own errors back
        raise WorkerError(
            f"a worker process died, most likely out of memory ({died!s:.200}). What is finished is kept: the same command "
            "does what is missing, with fewer --workers each has more memory"
        ) from died
    if error is not None:
        raise error from WorkerError(f"in a worker:\n{text}")
    return value


def _attempt(
    function: Callable[..., Any], arguments: tuple[Any, ...], modules: tuple[str, ...], robots: dict[str, Registered]
) -> tuple[Any, Exception | None, str]:
    """On a worker, what a task returned; or what it raised, and where. An error that cannot be pickled becomes a
    RuntimeError. Tasks know what users registered where the run began, `modules` and `robots`.
    """
    try:
        registry.restore(modules, robots)
        return function(*arguments), None, ""
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            error = RuntimeError(repr(error))
        return None, error, traceback.format_exc()


Pool = tuple[Callable[..., Future], Callable[[], int]]
"""What submits the arguments of `_attempt`, and what says how many tasks to have in flight at most."""


@contextmanager
def _local(workers: Workers) -> Iterator[Pool]:
    """Processes of this machine. At the end of the block whatever still runs is stopped. One that dies ends the others'
    work too.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # processes share the cores, not the threads of each
    # a forked child would share PyBullet's clients and CasADi's state
    pool, started = ProcessPoolExecutor(workers.here, get_context("spawn"), _prepare), dict[int, Any]()

    def submit(*task: Any) -> Future:
        future = pool.submit(_attempt, *task)
        started.update(pool._processes or {})
        return future

    try:
        yield submit, lambda: workers.here
    except WorkerError as error:
        for process in started.values():
            process.join(1.0)
        if any(process.exitcode == 1 for process in started.values()):  # one that is killed has a negative number
            raise WorkerError(_NOT_STARTED) from error
        raise
    finally:
        for process in list((pool._processes or {}).values()):  # Python 3.14 is the first with a public way
            process.terminate()
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which then ends its workers
    Thread(target=_end_with_the_run, daemon=True).start()


def _end_with_the_run() -> None:
    """Ends this worker as soon as the run is killed. Otherwise it would spend minutes on a result that nothing reads."""
    run = parent_process()
    if run is not None:
        wait_for([run.sentinel])
        os._exit(1)


@contextmanager
def _cluster(workers: Workers) -> Iterator[Pool]:
    """Tasks of one core each on a Ray cluster, to which this process must not be connected.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        WorkerError: there is no cluster at the address.
    """
    with imports_of("--ray", "ray"):
        import ray  # pyright: ignore[reportMissingImports]
    with TemporaryDirectory() as folder:
        _connect(ray, workers, Path(folder))
        # a name with a module, so that nodes import the function rather than unpickle it
        task = ray.remote(num_cpus=1, max_retries=_RETRIES)(_attempt)

        def most() -> int:  # nodes come and go
            return workers.workers or max(1, _PER_CORE * int(ray.cluster_resources().get("CPU", 0)))

        try:
            yield (lambda *given: task.remote(*given).future()), most
        finally:
            ray.shutdown()  # which ends the tasks too


def _connect(ray: Any, workers: Workers, folder: Path) -> None:
    """Starts a cluster for this run, or joins one, whose nodes get our code by way of the folder."""
    quiet: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    try:
        if workers.ray == "local":
            count = workers.workers or os.cpu_count() or 1
            ray.init("local", num_cpus=count, object_store_memory=_OBJECT_STORE, include_dashboard=False, **quiet)
        else:
            environment = {"py_modules": _code(folder), "env_vars": {"OMP_NUM_THREADS": "1"}}
            ray.init(workers.ray, runtime_env=environment, **quiet)
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise WorkerError(
            f"no Ray cluster can be used at {workers.ray} ({error}); `ray start --head` starts one, and --ray local "
            "starts one for this run alone"
        ) from error


def _code(folder: Path) -> list[Any]:
    """Our packages and modules with users' tasks, for the nodes. Their dependencies are not among them.

    The package that reads URDFs is copied with them, as a wheel holds it.
    """
    import ballbot_gym
    from ballbot_gym.robot import URDF_FOLDER

    ours, copied = ("ballbot_baselines", "ballbot_train"), folder / "ballbot_gym"
    shutil.copytree(Path(ballbot_gym.__file__).parent, copied, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(URDF_FOLDER, copied / "urdf", dirs_exist_ok=True)
    users = (name.partition(".")[0] for name in registry.registered()[0])
    return [str(copied), *map(import_module, dict.fromkeys([*ours, *users]))]
