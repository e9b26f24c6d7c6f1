"""Multiruns in other processes have the same results with every launcher."""

import json
import os
import subprocess
from pathlib import Path

import pytest
import yaml

from dopepp.core.errors import UserError
from dopepp.experiment.results.folder import LAST_CHECKPOINT, write_config
from dopepp.experiment.sweep import multirun
from dopepp.experiment.sweep.job_runners import on_joblib, on_slurm

RATES = ("1e-4", "1e-3", "1e-2")
SWEPT = f"optimizer.lr={','.join(RATES)}"


@pytest.fixture
def sweep(command, fast_training, tmp_path):
    """Run a multirun of jobs that take no time as a process; END_<job>=how ends a job early."""
    places = ("~hydra.callbacks.compare", f"hydra.sweep.dir={tmp_path / 'sweep'}")
    return lambda *arguments, **ends: command(fast_training, "-m", *places, *arguments, env=ends)


def reason(folder: Path, number: int) -> str:
    record = json.loads((folder / "sweep" / str(number) / "failed.json").read_text())
    return str(record["reason"])


def check_two_done_and_one_failed(folder: Path, out: str, err: str) -> None:
    for number in (0, 2):
        job = folder / "sweep" / str(number)
        assert json.loads((job / "metrics.json").read_text())["objective"] <= 1
        overrides = yaml.safe_load((job / ".hydra" / "overrides.yaml").read_text())
        assert f"optimizer.lr={float(RATES[number])}" in overrides
        # Each wrote to its own file, and not over the others' in the terminal.
        assert (job / "job.log").read_text() == f"printed by job {number}\n"
    assert reason(folder, 1) == "as the test asked"
    assert "as the test asked" in (folder / "sweep" / "1" / "job.log").read_text()
    assert "printed by" not in out + err
    assert f"each job prints to {folder / 'sweep'}/JOB/job.log" in out
    assert sum("ended" in line for line in out.splitlines()) == 3
    assert "Warning" not in err


@pytest.mark.slow
@pytest.mark.parametrize(("package", "options"), [
    ("joblib", ["hydra/launcher=joblib"]),
    ("submitit", ["hydra/launcher=submitit_slurm", "hydra.launcher.cluster=local",
                  "hydra.launcher.gpus_per_node=0"]),
])  # fmt: skip
def test_processes_of_this_machine(package, options, sweep, tmp_path):
    pytest.importorskip(package)
    code, out, err = sweep(*options, SWEPT, END_1="raise")
    assert code == 0, err
    check_two_done_and_one_failed(tmp_path, out, err)
    logs = list((tmp_path / "sweep" / ".submitit").glob("*/*_log.out"))
    assert bool(logs) == (package == "submitit")


@pytest.mark.slow
def test_joblib_with_a_lost_process(sweep, tmp_path):
    pytest.importorskip("joblib")
    code, out, err = sweep("hydra/launcher=joblib", "seed=0,1,2,3,4", END_1="kill")
    assert code == 0, err
    lost = {number for number in range(5) if (tmp_path / f"sweep/{number}/failed.json").exists()}
    assert lost == {1}
    assert reason(tmp_path, 1).startswith(
        "the process of the job was lost: LostWorkerError: a worker process"
    )
    for number in {0, 1, 2, 3, 4} - lost:
        assert (tmp_path / f"sweep/{number}/metrics.json").is_file()
    assert "ended, 5 of 5" in out


SBATCH = """#!/bin/bash
# One machine as a SLURM of one partition: runs the array's tasks one after another.
cp "$1" "$FAKE_SLURM/submitted.sh"
export SLURM_ARRAY_JOB_ID=77 SLURM_JOB_NUM_NODES=1 SLURM_NTASKS=1 SLURM_JOB_NODELIST=here
export SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0
last=$(grep -oP '(?<=--array=0-)[0-9]+' "$FAKE_SLURM/submitted.sh")
(sleep 1; for task in $(seq 0 "$last"); do
    SLURM_JOB_ID=$((77 + task)) SLURM_ARRAY_TASK_ID=$task bash "$FAKE_SLURM/submitted.sh"
done) > "$FAKE_SLURM/log.txt" 2>&1 &
echo "Submitted batch job 77"
"""
SRUN = """#!/bin/bash
while [[ "$1" == --* ]]; do
    case "$1" in --output | --error) shift 2 ;; *) shift ;; esac
done
exec "$@"
"""
SACCT = """#!/bin/bash
echo "JobID|State|NodeList"
for task in 0 1 2; do echo "77_$task|RUNNING|here"; done
"""


@pytest.mark.slow
def test_slurm_gets_an_array_with_the_options(sweep, tmp_path):
    """Replace SLURM's commands by scripts that run the submitted script on this machine."""
    pytest.importorskip("submitit")
    for name, script in (("sbatch", SBATCH), ("srun", SRUN), ("sacct", SACCT)):
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(script)
        path.chmod(0o755)
    options = ("partition=gpu", "timeout_min=90", "array_parallelism=2")
    chosen = [f"hydra.launcher.{option}" for option in options]
    with_stand_ins = {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    code, out, err = sweep(
        "hydra/launcher=submitit_slurm", *chosen, SWEPT,
        END_1="raise", FAKE_SLURM=str(tmp_path), **with_stand_ins,
    )  # fmt: skip
    assert code == 0, err + (tmp_path / "log.txt").read_text()
    check_two_done_and_one_failed(tmp_path, out, err)
    submitted = (tmp_path / "submitted.sh").read_text()
    for option in (
        "--array=0-2%2", "--partition=gpu", "--time=90", "--cpus-per-task=8", "--mem=32GB",
        "--gpus-per-node=1", "--signal=USR2@300", "--job-name=dopepp",
    ):  # fmt: skip
        assert f"#SBATCH {option}" in submitted


@pytest.mark.slow
def test_ray_on_a_cluster_of_two_nodes(sweep, two_nodes, tmp_path):
    ray = ("hydra/launcher=ray", f"hydra.launcher.address={two_nodes.address}")
    code, out, err = sweep(*ray, "optimizer.lr=1e-4,-1,1e-2")
    assert code == 0, err
    assert reason(tmp_path, 1) == "lr=-1"
    for number in (0, 2):
        assert (tmp_path / "sweep" / str(number) / "metrics.json").is_file()
        log = (tmp_path / "sweep" / str(number) / "job.log").read_text()
        assert log == f"printed by job {number}\n"
    assert sum("ended" in line for line in out.splitlines()) == 3
    assert "printed by" not in out + err


@pytest.mark.parametrize(("package", "extra"), [("joblib", "joblib"), ("submitit", "slurm")])
def test_without_the_package_the_error_names_the_extra(package, extra, monkeypatch):
    monkeypatch.setattr("dopepp.core.errors.find_spec", lambda name: None)
    with pytest.raises(UserError, match=rf"without the package {package}.*dopepp\[{extra}\]"):
        on_joblib(2) if package == "joblib" else on_slurm("x", "slurm", 0, {})


def test_joblib_needs_a_positive_number_of_processes():
    with pytest.raises(UserError, match=r"hydra\.launcher\.n_jobs=0"):
        on_joblib(0)


def test_a_job_resumes_only_with_an_equal_config(tmp_path):
    config = {"seed": 1, "model": {"width": 0.5}, "resume": None}
    assert not multirun.can_resume(config, tmp_path)
    write_config(tmp_path, {**config, "resume": "outputs/x"})
    assert not multirun.can_resume(config, tmp_path)  # it saved nothing
    (tmp_path / LAST_CHECKPOINT).parent.mkdir()
    (tmp_path / LAST_CHECKPOINT).touch()
    assert multirun.can_resume(config, tmp_path)
    assert not multirun.can_resume({**config, "seed": 2}, tmp_path)
    assert not multirun.can_resume({**config, "resume": "outputs/y"}, tmp_path)


def test_a_job_with_automatic_values_resumes(tmp_path):
    (tmp_path / LAST_CHECKPOINT).parent.mkdir()
    (tmp_path / LAST_CHECKPOINT).touch()
    camera = tmp_path / "camera.json"
    lens = {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0}
    camera.write_text(json.dumps(lens))
    config = {"data": {"input_size": None}, "virtual": {"camera": str(camera)}, "search": {"a": 1}}
    write_config(tmp_path, {"data": {"input_size": [96, 96]}, "virtual": {"camera": lens}})
    assert multirun.can_resume(config, tmp_path)
    assert not multirun.can_resume({**config, "data": {"input_size": [64, 64]}}, tmp_path)


def test_output_of_child_processes_is_redirected(tmp_path, capfd):
    with multirun.redirected_output(tmp_path / "job" / "job.log"):
        os.write(1, b"by this process\n")
        subprocess.run(["bash", "-c", "echo by a child; echo as an error >&2"], check=True)
    os.write(1, b"after it\n")
    lines = (tmp_path / "job" / "job.log").read_text().splitlines()
    assert sorted(lines) == ["as an error", "by a child", "by this process"]
    assert capfd.readouterr().out == "after it\n"


@pytest.fixture
def slurm_job(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SLURM_JOB_ID", "12")


def test_a_requeued_job_resumes_the_run_of_its_command(slurm_job, tmp_path, monkeypatch):
    multirun.record_run(["seed=1"], tmp_path / "a")
    multirun.record_run(["seed=2"], tmp_path / "b")
    assert multirun.requeued_run(["seed=1"]) is None  # the first time: no restart
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert multirun.requeued_run(["seed=1"]) == tmp_path / "a"
    assert multirun.requeued_run(["seed=2"]) == tmp_path / "b"
    assert multirun.requeued_run(["seed=3"]) is None
    monkeypatch.setenv("SLURM_JOB_ID", "13")
    assert multirun.requeued_run(["seed=1"]) is None


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
def test_slurm_job_ids(variables, named, slurm_job, monkeypatch):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert multirun.job_id() == named


def test_a_failing_scontrol_is_reported(slurm_job, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert multirun.requeue().startswith("SLURM did not requeue job 12: ")
    script = tmp_path / "scontrol"
    script.write_text("#!/bin/sh\necho Access denied >&2\nexit 1\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.defpath}")
    assert multirun.requeue() == "SLURM did not requeue job 12: Access denied"
