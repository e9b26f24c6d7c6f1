"""Five kills at random moments; ``benchmarks/crash.py`` does fifty."""

import pytest


@pytest.mark.timeout(600)
def test_a_run_killed_five_times_ends_as_one_left_in_peace(command):
    done = command("benchmarks/crash.py", "--kills=5", "--epochs=4", timeout=580)
    assert done.code == 0, done.out[-4000:] + done.err[-4000:]
    assert "5 kills: " in done.out
    assert ", 0 lost []" in done.out
    assert "differences from the undisturbed run: none" in done.out
