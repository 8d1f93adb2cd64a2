"""The same job on many runs in parallel: one progress bar, failures at the end, finished work kept.

joblib runs the jobs; ``joblib.parallel_config`` around :func:`run_jobs` chooses another backend, such as dask.
"""

from __future__ import annotations

import signal
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar, cast

import typer
from rich.console import Console
from rich.markup import escape

from ..errors import PumafuseError, PumafuseWarning
from ..folders import sweep
from .screen import INTERRUPTED, say

R = TypeVar("R")


@contextmanager
def progress_bar(what: str, total: float = 1.0) -> Generator[Callable[[float], None]]:
    """A progress bar on stderr, where that is a terminal, and the function that moves it to a part of ``total``."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _: None
        return
    from rich.progress import Progress  # takes 0.02 s

    with Progress(console=console, transient=True) as bar:
        task = bar.add_task(escape(what), total=total)
        yield lambda done: bar.update(task, completed=done)


@contextmanager
def _block_ctrl_c() -> Generator[None]:
    """Processes that are started here block Ctrl-C, which would end them with a traceback each.

    They end with this process, which handles afterwards any Ctrl-C that came meanwhile.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # as it starts it ends the blocking
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


def run_jobs(
    what: str, jobs: Mapping[str, Callable[[], R]], folders: Iterable[Path]
) -> tuple[dict[str, R], dict[str, str]]:
    """Run every job, several at a time."""
    from multiprocessing import active_children

    from joblib import Parallel, delayed
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    results: dict[str, R] = {}
    failed: dict[str, str] = {}
    parallel = Parallel(n_jobs=-1, return_as="generator_unordered", batch_size=1)
    work = (delayed(_guard)(name, job) for name, job in jobs.items())
    outcomes: Generator[tuple[str, R | None, str | None]] | None = None
    before = active_children()
    try:
        with _block_ctrl_c():
            outcomes = cast(Generator[tuple[str, R | None, str | None]], parallel(work))
        with progress_bar(what, len(jobs)) as move:
            for name, result, problem in outcomes:
                if problem is None:
                    results[name] = cast(R, result)
                else:
                    failed[name] = problem
                move(len(results) + len(failed))
    except KeyboardInterrupt:
        say(f"interrupted: {len(results)} of {len(jobs)} runs are done and kept", err=True)
        raise typer.Exit(INTERRUPTED) from None
    except TerminatedWorkerError:
        kept = f"{len(results)} of {len(jobs)} runs are done and kept"
        raise PumafuseError(f"a worker process died (out of memory?): {kept}") from None
    finally:
        hook, threading.excepthook = threading.excepthook, _unsaid
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of work that is not used
            if outcomes is not None:
                outcomes.close()
        threading.excepthook = hook
        if len(results) + len(failed) < len(jobs):
            for worker in set(active_children()).difference(before):  # what joblib has left behind
                worker.kill()
                worker.join()
        sweep(folders)  # only now does no worker write any more
    done = {name: results[name] for name in jobs if name in results}
    return done, {name: failed[name] for name in jobs if name in failed}


def _unsaid(_: threading.ExceptHookArgs) -> None:
    """Print nothing of a thread of joblib that ends while it starts."""


def report_failures(failed: Mapping[str, str], count: int, where: Path) -> None:
    """Print the error of each job that failed."""
    for name, problem in failed.items():
        say(f"pumafuse: {name}: {problem}", err=True)
    if failed:
        kept = "" if len(failed) == count else f"; the others are in {where}"
        raise PumafuseError(f"{len(failed)} of {count} runs failed (see above){kept}")


def _guard(name: str, job: Callable[[], R]) -> tuple[str, R | None, str | None]:
    """A job's name and its result, or its error in one line: one bad run must not stop the others."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PumafuseWarning)  # they are in the notes of each run's summary
        try:
            return name, job(), None
        except PumafuseError as error:
            return name, None, str(error)
        except Exception as error:
            return name, None, " ".join(f"unexpected {type(error).__name__}: {error}".split())
