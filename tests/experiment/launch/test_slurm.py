import os

import pytest

from dopepp.experiment.launch import remote


@pytest.fixture(autouse=True)
def job(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SLURM_JOB_ID", "12")


def test_only_a_requeued_job_goes_on_and_only_with_its_own_command(tmp_path, monkeypatch):
    remote.remember_run(["seed=1"], tmp_path / "a")
    remote.remember_run(["seed=2"], tmp_path / "b")
    assert remote.begun_run(["seed=1"]) is None  # the first time: no restart
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert remote.begun_run(["seed=1"]) == tmp_path / "a"
    assert remote.begun_run(["seed=2"]) == tmp_path / "b"
    assert remote.begun_run(["seed=3"]) is None
    monkeypatch.setenv("SLURM_JOB_ID", "13")
    assert remote.begun_run(["seed=1"]) is None


@pytest.mark.parametrize(
    ("variables", "named"),
    [
        ({}, "12"),
        ({"SLURM_ARRAY_JOB_ID": "10", "SLURM_ARRAY_TASK_ID": "3"}, "10_3"),  # as scontrol does
        ({"SLURM_JOB_ID": ""}, None),
        ({"SLURM_JOB_ID": "1; rm"}, None),
        ({"SLURM_JOB_ID": "--help"}, None),
    ],
)
def test_a_job_is_named(variables, named, monkeypatch):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert remote.job_id() == named


def test_a_refused_or_missing_scontrol_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert remote.requeue().startswith("SLURM did not requeue job 12: ")
    script = tmp_path / "scontrol"
    script.write_text("#!/bin/sh\necho Access denied >&2\nexit 1\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.defpath}")
    assert remote.requeue() == "SLURM did not requeue job 12: Access denied"
