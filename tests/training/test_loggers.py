import logging

import pytest
from lightning.pytorch.loggers import Logger

from dopepp.core.files import read_csv
from dopepp.training.loggers import GuardedLogger, MetricsTable


def test_columns_are_added_and_a_step_has_one_row(tmp_path):
    table = MetricsTable(tmp_path / "run" / "metrics.csv")
    table.save()
    assert not table.path.exists()
    table.log_metrics({"train/loss": 2.0}, step=0)
    table.save()
    table.log_metrics({"val/loss": 1.5}, step=1)
    table.log_metrics({"train/loss": 1.0}, step=1)
    table.finalize("success")
    assert read_csv(table.path) == [
        {"step": "0", "train/loss": "2.0", "val/loss": ""},
        {"step": "1", "train/loss": "1.0", "val/loss": "1.5"},
    ]
    assert [path.name for path in table.path.parent.iterdir()] == ["metrics.csv"]


def test_a_failing_write_keeps_the_old_file_and_the_rows(tmp_path, monkeypatch, caplog):
    table = MetricsTable(tmp_path / "metrics.csv")
    table.log_metrics({"loss": 2.0}, step=0)
    table.save()
    before = table.path.read_bytes()
    table.log_metrics({"loss": 1.0}, step=1)

    def full(*_):
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("dopepp.core.files.write_file", full)
        with pytest.raises(OSError, match="no space"):
            table.write()
        table.save()
        table.save()
    assert table.path.read_bytes() == before
    assert caplog.text.count("no space left on device") == 1
    table.save()
    assert [row["step"] for row in read_csv(table.path)] == ["0", "1"]


def test_an_existing_file_is_continued(tmp_path):
    path = tmp_path / "metrics.csv"
    first = MetricsTable(path)
    for step in range(4):
        first.log_metrics({"loss": 4.0 - step}, step=step)
    first.save()
    second = MetricsTable(path)
    second.forget_after(1)
    second.log_metrics({"loss": 9.0, "rate": 0.1}, step=2)
    second.save()
    rows = [(row["step"], row["loss"], row["rate"]) for row in read_csv(path)]
    assert rows == [("0", "4.0", ""), ("1", "3.0", ""), ("2", "9.0", "0.1")]


CALLS = ("construction", "name", "log_hyperparams", "log_metrics", "save", "finalize")


class Broken(Logger):
    """Records calls, and fails in the named call."""

    version = ""

    def __init__(self, failing=""):
        super().__init__()
        self.failing, self.calls = failing, []
        self._record("construction")

    def _record(self, call):
        self.calls.append(call)
        if call == self.failing:
            raise ConnectionError(f"{call} failed")

    @property
    def name(self):
        self._record("name")
        return "broken"

    log_hyperparams, log_metrics, save, finalize = (
        lambda self, *_, call=call, **__: self._record(call) for call in CALLS[2:]
    )


@pytest.mark.parametrize("call", ["", *CALLS])
def test_a_failing_logger_warns_once_and_is_disabled(call, caplog):
    made = []

    def make():
        made.append(Broken(call))
        return made[-1]

    with caplog.at_level(logging.WARNING):
        logger = GuardedLogger(make)
        assert logger.name in (None, "broken")
        logger.log_hyperparams({})
        for step in range(3):
            logger.log_metrics({"loss": 1.0}, step)
            logger.save()
        logger.finalize("success")
        assert logger.version in (None, "")
    if not call:  # the logger works and receives all calls
        assert set(made[0].calls) == set(CALLS)
        assert not caplog.records
    else:
        assert len(caplog.records) == 1
        assert f"{call} failed" in caplog.text
        assert not made or (made[0].calls.count(call), made[0].calls[-1]) == (1, call)
