"""Distributed training in which all processes end if one process dies.

Without this module, a process in a collective would wait half an hour for a dead process, and
Lightning would kill rank 0 without a message. Rank 0 watches its children, and the children watch
their parent.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any, Final

from lightning.fabric.utilities.distributed import _set_num_threads_if_needed
from lightning.pytorch import Trainer
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher
from lightning.pytorch.utilities import rank_zero_only

from dopepp.core.errors import RunError

_STARTED_BY: Final = "DOPEPP_STARTED_BY"  # Environment variable with the parent's process id
_POLL_S: Final = 1.0
_NOTICE_S: Final = 5.0  # Time from a broken connection until the death of a process is noticed
_GRACE_S: Final = 20.0  # Time after a death in which other processes may end by themselves


def is_rank_zero() -> bool:
    """Return whether this process has rank 0, also before there is a trainer."""
    return not getattr(rank_zero_only, "rank", 0)


class ProcessDiedError(RunError):
    """Another process of the run has ended unexpectedly."""


class Watch(threading.Thread):
    """Watches this process's children, rank 1 first, and the parent if it is part of the run."""

    def __init__(self, children: Sequence[subprocess.Popen[Any]], parent: int | None) -> None:
        super().__init__(daemon=True, name="process-watch")
        self._children, self._parent = children, parent
        self._stopped = threading.Event()

    def run(self) -> None:
        """End this process 20 s after the death of another process."""
        while not self._stopped.wait(_POLL_S):
            death = self.death()
            if death is not None:
                time.sleep(_GRACE_S)
                sys.stderr.write(f"{death}: the run ends\n")
                sys.stderr.flush()
                os._exit(1)  # exceptions do not reach the main thread in a collective

    def stop(self) -> None:
        """Stop watching, before the other processes end normally."""
        self._stopped.set()

    def death(self, wait_s: float = 0.0) -> str | None:
        """Wait up to ``wait_s`` seconds for a process to die; return how it died, or None."""
        deadline = time.monotonic() + wait_s
        while True:
            for rank, child in enumerate(self._children, start=1):
                code = child.poll()
                if code:
                    how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
                    return f"process {child.pid} (rank {rank} on this machine) {how}"
            if self._parent is not None and os.getppid() != self._parent:
                return f"process {self._parent} (rank 0 on this machine) has died"
            if time.monotonic() >= deadline:
                return None
            time.sleep(0.1)


class WatchedLauncher(_SubprocessScriptLauncher):
    """Starts a process for each further rank of this machine, like Lightning, and watches it."""

    def launch(
        self, function: Callable[..., Any], *args: Any, trainer: Trainer | None = None, **kw: Any
    ) -> Any:
        """Start the further ranks and call the function; name a process that died meanwhile."""
        self.cluster_environment.validate_settings(self.num_processes, self.num_nodes)
        started_by = os.environ.pop(_STARTED_BY, None)
        if not self.cluster_environment.creates_processes_externally:
            os.environ[_STARTED_BY] = str(os.getpid())
            self._call_children_scripts()
            del os.environ[_STARTED_BY]
        _set_num_threads_if_needed(num_processes=self.num_processes)
        watch = Watch(self.procs, None if started_by is None else int(started_by))
        watch.start()
        death = None
        try:
            return function(*args, **kw)
        except RunError:
            raise
        except Exception as error:
            death = watch.death(_NOTICE_S)
            if death is None:
                raise
            raise ProcessDiedError(f"{death}: the run ends") from error
        finally:
            if death is None:  # otherwise keep watching, because cleaning up may hang
                watch.stop()


class WatchedDDP(DDPStrategy):
    """Distributed data parallel with :class:`WatchedLauncher` and a timeout of collectives."""

    def __init__(self, timeout_s: float) -> None:
        super().__init__(timeout=timedelta(seconds=timeout_s))

    def _configure_launcher(self) -> None:
        assert self.cluster_environment is not None
        self._launcher = WatchedLauncher(
            self.cluster_environment, self.num_processes, self.num_nodes
        )
