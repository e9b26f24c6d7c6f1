"""The behaviour of a process after the death of another process of its run."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

from dopepp.training import processes
from dopepp.training.processes import Watch


def sleeper(code="import time; time.sleep(60)"):
    return subprocess.Popen([sys.executable, "-c", code])


def test_a_death_is_described_with_its_cause():
    quiet, killed = sleeper(), sleeper()
    failed, done = sleeper("raise SystemExit(3)"), sleeper("pass")
    try:
        assert Watch([quiet, killed], None).death() is None
        killed.send_signal(signal.SIGKILL)
        expected = f"process {killed.pid} (rank 2 on this machine) was killed by signal 9"
        assert Watch([quiet, killed], None).death(10) == expected
        failed.wait()
        assert "ended with code 3" in str(Watch([failed], None).death())
        done.wait()
        assert Watch([done], None).death() is None  # it ended normally
        assert Watch([], os.getppid()).death() is None
        assert "rank 0 on this machine) has died" in str(Watch([], 2**22).death())
    finally:
        for process in (quiet, killed):
            process.kill()
            process.wait()


def hang(errors):
    sys.stderr = errors.open("w")
    processes._POLL_S = processes._GRACE_S = 0.2
    Watch([sleeper("import os; os.kill(os.getpid(), 9)")], None).start()
    time.sleep(120)


def test_a_hanging_process_is_ended(tmp_path):
    """As in a collective on GPUs, where no exception reaches the main thread."""
    process = multiprocessing.get_context("fork").Process(target=hang, args=[tmp_path / "errors"])
    process.start()
    process.join(100)
    assert process.exitcode == 1
    message = (tmp_path / "errors").read_text()
    assert message.endswith("was killed by signal 9: the run ends\n")


def end_normally():
    processes._POLL_S = processes._GRACE_S = 0.2
    child = sleeper("raise SystemExit(3)")
    watch = Watch([child], None)
    watch.start()
    watch.stop()
    child.wait()
    watch.join(100)


def test_a_stopped_watch_lets_processes_end():
    process = multiprocessing.get_context("fork").Process(target=end_normally)
    process.start()
    process.join(100)
    assert process.exitcode == 0
