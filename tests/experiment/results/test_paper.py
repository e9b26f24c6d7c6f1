"""The paper's tables: rows of methods, and rejected layouts.

The tables themselves are compared to the character in ``test_golden.py``.
"""

from pathlib import Path

import pandas as pd
import pytest
from omegaconf import OmegaConf

from dopepp.core.errors import UserError
from dopepp.core.files import read_csv
from dopepp.experiment.results.compare import compare_paths
from dopepp.experiment.results.frame import interval
from dopepp.experiment.results.paper import PaperTable, pooled_rates
from dopepp.experiment.sweep.multirun import CompareJobs
from tests.experiment.conftest import report_of, write_run

pytestmark = pytest.mark.usefixtures("blank_figures")

FOLDER = Path(__file__).parents[3] / "conf" / "experiment"
EXPERIMENTS = sorted(
    path.stem for path in FOLDER.glob("*.yaml") if path.stem.startswith(("table", "fig"))
)
LABELS = {"model=dope": "DOPE", "model=dopepp": "DOPE++"}
ERRORS = [0.004, 0.06]


def end(folder, table):
    """End a multirun and return its table."""
    hydra = {"sweep": {"dir": str(folder)}}
    CompareJobs().on_multirun_end(OmegaConf.create({"hydra": hydra, "table": table}))
    return read_csv(folder / "table.csv")


def test_a_multirun_writes_its_table_before_it_fails(tmp_path):
    end(tmp_path, {"title": "6"})  # of no jobs: nothing to say
    write_run(tmp_path / "0", ["model=dopepp"], report_of("dopepp", ERRORS))
    write_run(tmp_path / "10", ["model=dopepp"])
    with pytest.raises(SystemExit) as failed:
        end(tmp_path, {"title": "6"})
    assert failed.value.code == 1
    rows = read_csv(tmp_path / "table.csv")
    assert rows[1]["method"].endswith("unfinished: no metrics.json")


def test_parts_with_other_seeds_are_not_joined(tmp_path):
    for number, part in enumerate(("bolt", "nut")):
        result = report_of("x", {part: ERRORS}, test_set=part)
        write_run(tmp_path / str(number), [f"seed={number}"], result, data={"parts": [part]})
    assert "mean" not in [row["object"] for row in end(tmp_path, {"title": "Table 2"})]


@pytest.mark.parametrize("experiment", EXPERIMENTS)
@pytest.mark.parametrize("scale", ["paper", "laptop"])
def test_every_experiment_composes(composed, experiment, scale):
    """Tables of trainings use the paper's recipe at full scale, and our recipe on a laptop."""
    config = composed(f"experiment={experiment}", f"scale={scale}")
    table = PaperTable.of(config["table"])
    assert set(table.labels.values()) & set(table.paper) or not table.paper
    assert config["model"]["width"] == (0.25 if scale == "laptop" else 1.0)
    if experiment[:6] not in {f"table{number}" for number in (1, 2, 3, 5, 6, 7)}:
        return
    loss = config["model"]["loss"]["_target_"].rpartition(".")[2]
    if scale == "laptop":
        assert (config["recipe"], loss) == ("ours", "SpatialCrossEntropy")
    else:
        assert (config["recipe"], loss) == ("paper", "MapMSE")
        assert config["optimizer"] == {"_target_": "torch.optim.Adam", "lr": 1e-4}
        assert config["scheduler"]["_target_"] is None
        assert (config["data"]["batch_size"], config["trainer"]["max_epochs"]) == (32, 60)


def test_recipe_of_experiments(composed):
    assert composed()["recipe"] == "ours"
    assert composed("experiment=paper")["optimizer"] == {"_target_": "torch.optim.Adam", "lr": 1e-4}
    table = composed("experiment=table6_dope_vs_dopepp", "recipe=ours")
    assert table["model"]["loss"]["_target_"] == "dopepp.models.losses.SpatialCrossEntropy"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"title": "T", "colour": 1}, r"table\.colour=1; allowed: title, kind"),
        ({"title": "T", "kind": "pie"}, r"table\.kind='pie'; allowed: poses, shading"),
        ({"title": "T", "threshold": 0.2}, r"table\.threshold=0\.2; allowed: 0\.05, 0\.1"),
        ({}, "no table.title"),
    ],
)
def test_impossible_tables(table, message):
    with pytest.raises(UserError, match=message):
        PaperTable.of(table)


def test_finished_runs_in_another_tables_layout(tmp_path):
    write_run(tmp_path / "sweep" / "0", ["model=dope"], report_of("dope", ERRORS))
    layout = FOLDER / "table6_dope_vs_dopepp.yaml"
    out = compare_paths([tmp_path / "sweep"], tmp_path / "out", table=layout)
    measured = [row for row in read_csv(out / "table.csv") if row["object"] == "part"]
    assert [row["method"] for row in measured] == ["DOPE", "best constant pose"]


@pytest.mark.parametrize("text", ["model: dope\n", "table: Table 6\n", "- table\n"])
def test_an_experiment_without_a_table_is_rejected_early(text, tmp_path):
    write_run(tmp_path / "0", ["model=dope"], report_of("dope", ERRORS))
    path = tmp_path / "experiment.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match="has no table layout"):
        compare_paths([tmp_path / "0"], tmp_path / "out", table=path)
    assert not (tmp_path / "out").exists()


def test_a_table_of_failed_runs_names_their_failures(tmp_path):
    for number, model in enumerate(("dope", "dopepp")):
        write_run(tmp_path / str(number), [f"model={model}"])
    with pytest.raises(SystemExit):
        end(tmp_path, {"title": "6", "labels": LABELS})
    methods = [row["method"] for row in read_csv(tmp_path / "table.csv")]
    assert methods == [f"{label}: unfinished: no metrics.json" for label in LABELS.values()]


def test_the_interval_of_a_curve_counts_each_instance_once():
    rates = pd.DataFrame(
        {"method": "a", "share": 0.2, "seed": ["1", "2", "3"], "rate": 0.5, "num_instances": 40}
    )
    (value,) = pooled_rates(rates)
    assert (value.low, value.high) == interval(0.5, 40)
