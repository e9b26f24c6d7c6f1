"""Sweeps in the paper's layout, with the paper's figures beside them."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf

from dopepp.core.errors import UserError
from dopepp.drawing.pictures import read_rgb
from dopepp.experiment.results.compare import compare_paths
from dopepp.experiment.results.evaluators import Cost
from dopepp.experiment.results.folder import FAILURE_FILE, METRICS_FILE, write_config, write_json
from dopepp.experiment.results.paper_table import PaperTable
from dopepp.experiment.results.report import Report
from dopepp.experiment.results.tables import read_csv
from dopepp.experiment.run.train import do_job
from dopepp.experiment.sweep.multirun import CompareJobs
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import PoseErrors, mean_row, summarise

FOLDER = Path(__file__).parents[3] / "conf" / "experiment"
EXPERIMENTS = sorted(
    path.stem for path in FOLDER.glob("*.yaml") if path.stem.startswith(("table", "fig"))
)
LABELS = {"model=dope": "DOPE", "model=dopepp": "DOPE++"}


def job(
    folder: Path, overrides: list[str], errors: list[float] | None, part: str = "part",
    refined: list[float] | None = None, **config: Any,
) -> None:  # fmt: skip
    """Write what a job of a sweep leaves, refined as well; without errors, a failure."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(overrides))
    if errors is None:
        write_json(folder / FAILURE_FILE, {"reason": "no memory"})
        return
    report = report_of("x", errors, part)
    report.refined = None if refined is None else report_of("x + region", refined, part)
    write_json(folder / METRICS_FILE, report.to_record())
    seed = next((int(text[5:]) for text in overrides if text.startswith("seed=")), 0)
    model = {"name": "x", "width": 1}
    of_a_data_set = any(text.startswith("data.objects=") for text in overrides)
    data = {"objects" if of_a_data_set else "parts": [part]}
    write_config(folder, {"model": model, "seed": seed, "data": data, "a": overrides[0], **config})


def report_of(name: str, errors: list[float], part: str) -> Report:
    e = torch.tensor(errors, dtype=torch.float64)
    errors_of = PoseErrors(e, e, e, None, 1000 * e, 1000 * e, e)
    rows = {part: summarise(part, name, 0.1, errors_of, 1)}
    rows[MEAN] = mean_row(list(rows.values()), name)
    return Report(
        name, rows, {"best constant pose": rows}, {part: np.array(errors)}, Cost(), len(errors),
        rotation_deg={part: 1000 * np.array(errors)}, diameters={part: 0.1}, test_set=part,
    )  # fmt: skip


def end(folder: Path, table: dict[str, Any]) -> None:
    """What Hydra does when the last job of a sweep has ended."""
    hydra = {"sweep": {"dir": str(folder)}}
    CompareJobs().on_multirun_end(OmegaConf.create({"hydra": hydra, "table": table}))


def read_table(folder: Path) -> list[dict[str, str]]:
    return read_csv(folder / "table.csv")


def test_pass_rates_with_seeds_failures_and_the_papers_figures(tmp_path):
    job(tmp_path / "0", ["model=dope", "seed=1"], [0.04, 0.06], recipe="ours")
    job(tmp_path / "1", ["model=dope", "seed=2"], [0.04, 0.04], recipe="ours")
    job(tmp_path / "2", ["model=dopepp", "seed=1"], None)
    table = {
        "title": "Table 6",
        "labels": LABELS,
        "paper": {"DOPE": {"part": {"pass": 91.5, "auc_10cm": 48.25}},
                  "DRNet": {"part": {"pass": 74.28}}},
        "recomputed": {"PoseCNN": {"part": {"pass": 97.5, "add_01d": 25.1}}},
        "notes": ["A remark."],
    }  # fmt: skip
    with pytest.raises(SystemExit):
        end(tmp_path, table)
    dope, dopepp, posecnn, drnet, reference = read_table(tmp_path)
    assert (dope["method"], dope["object"]) == ("DOPE", "part")
    assert dope["ADD<5cm %"] == "75.0 ± 35.4"
    assert dope["the paper: ADD<5cm %"] == "91.5"
    assert dope["the paper: AUC[0,10cm] %"] == "48.25"
    assert "ADD<10cm %" not in dope
    assert dopepp["method"] == "DOPE++: no memory"
    assert (posecnn["method"], posecnn["ADD<5cm %"]) == ("PoseCNN", "97.5")
    assert (posecnn["ADD-0.1d %"], posecnn["the paper: ADD<5cm %"]) == ("25.1", "")
    assert (drnet["method"], drnet["ADD<5cm %"], drnet["the paper: ADD<5cm %"]) == (
        "DRNet", "", "74.28",
    )  # fmt: skip
    assert (reference["method"], reference["rotation °"]) == ("best constant pose", "50.0")
    text = (tmp_path / "table.md").read_text()
    assert text.startswith("# Table 6, recipe=ours\n")
    assert "- A remark." in text
    assert "pass rate is ADD < 0.05 m" in text
    assert "prints no such table" not in text
    assert "VGG19" not in text


@pytest.mark.parametrize("option", ["data.parts", "data.objects"])
def test_one_network_a_part_is_one_method_with_a_mean(option, tmp_path):
    errors = {"none": {"bolt": [0.06, 0.06], "nut": [0.004] * 8 + [0.06] * 2},
              "random": {"bolt": [0.004, 0.06], "nut": [0.004] * 9 + [0.06]}}  # fmt: skip
    for number, (seed, mask, part) in enumerate(product((1, 2), errors, ("bolt", "nut"))):
        overrides = [f"data/masking={mask}", f"{option}=[{part}]", f"seed={seed}"]
        job(tmp_path / str(number), overrides, errors[mask][part], part)
    labels = {"data/masking=none": "without", "data/masking=random": "with"}
    printed = {
        "without": {"bolt": {"pass": 84.05}, "nut": {"pass": 86.35}, "mean": {"pass": 85.2}},
        "with": {"bolt": {"pass": 92.35}, "screw": {"pass": 91.75}, "mean": {"pass": 92.05}},
    }
    end(tmp_path, {"title": "Table 2", "labels": labels, "paper": printed})
    rows = read_table(tmp_path)
    found = {(row["method"], row["object"]): row for row in rows}
    assert list(found)[:6] == [
        (method, name) for name in ("bolt", "nut", "mean") for method in ("without", "with")
    ]
    rates = [found["without", name]["ADD-0.1d %"] for name in ("bolt", "nut", "mean")]
    assert rates == ["0.0 ± 0.0", "80.0 ± 0.0", "40.0 ± 0.0"]
    assert found["with", "mean"]["ADD-0.1d %"] == "70.0 ± 0.0"
    assert found["with", "mean"]["Δ ADD-0.1d %"].startswith("+30.0 [")
    assert found["with", "nut"]["Δ ADD-0.1d %"].startswith("+10.0 [")
    assert ("best constant pose", "mean") in found
    assert found["without", "mean"]["the paper: ADD<5cm %"] == "85.2"
    assert found["with", "mean"]["the paper: ADD<5cm %"] == ""  # a mean of other parts
    assert found["with", "bolt"]["the paper: ADD<5cm %"] == "92.35"
    compared = read_csv(tmp_path / "compare.csv")
    assert {row["seeds"] for row in compared if row["method"].startswith("x ")} == {"1, 2"}


def test_refined_poses_are_a_row_without_the_papers_figures(tmp_path):
    job(tmp_path / "0", ["model=dope"], [0.04, 0.06], refined=[0.004, 0.06])
    job(tmp_path / "1", ["model=dopepp"], [0.04, 0.04], refined=[0.004, 0.004])
    printed = {name: {"part": {"pass": 91.5}} for name in LABELS.values()}
    end(tmp_path, {"title": "Table 6", "labels": LABELS, "paper": printed})
    rows = read_table(tmp_path)
    names = ["DOPE", "DOPE + region", "DOPE++", "DOPE++ + region", "best constant pose"]
    assert [row["method"] for row in rows] == names
    assert [row["the paper: ADD<5cm %"] for row in rows] == ["91.5", "", "91.5", "", ""]
    assert [row["ADD-0.1d %"] for row in rows[:4]] == ["0.0", "50.0", "0.0", "100.0"]
    changes = [row["Δ ADD-0.1d %"].partition(" ")[0] for row in rows[:4]]
    assert changes == ["", "+50.0", "+0.0", "+50.0"]
    assert (
        "Δ of refined poses is against the first refined row" in (tmp_path / "table.md").read_text()
    )


def test_a_part_with_other_seeds_stands_alone(tmp_path):
    job(tmp_path / "0", ["a=1", "seed=1"], [0.004, 0.06], "bolt")
    job(tmp_path / "1", ["a=1", "seed=2"], [0.004, 0.06], "nut")
    end(tmp_path, {"title": "Table 2"})
    objects = [row["object"] for row in read_table(tmp_path)]
    assert "mean" not in objects
    assert {"bolt", "nut"} <= set(objects)


def test_an_untrained_vgg19_is_named(tmp_path):
    vgg = {"_target_": "dopepp.models.backbones.VGG19", "weights_path": None}
    job(tmp_path / "0", ["model=dope"], [0.06], model={"name": "dope", "backbone": vgg})
    end(tmp_path, {"title": "Table 7", "threshold": 0.1})
    text = (tmp_path / "table.md").read_text()
    assert "VGG19 started untrained" in text
    assert "prints no such table" in text
    assert read_table(tmp_path)[0]["ADD<10cm %"] == "100.0"


def test_shading_is_averaged_over_seeds_and_drawn(tmp_path):
    header = "method,object,share,num_instances,pass_5cm,add_01d\n"
    rates = {"dope": (0.9, 0.4), "dopepp": (0.8, 0.6)}
    for number, (model, seed) in enumerate(product(rates, (1, 2))):
        folder = tmp_path / str(number)
        job(folder, [f"model={model}", f"seed={seed}"], [0.04, 0.06])
        lines = [
            f"x,part,{share},10,{rate + 0.1 * (seed - 1.5)},{rate / 2}\n"
            for share, rate in zip((0, 0.8), rates[model], strict=True)
        ]
        (folder / "shading.csv").write_text(header + "".join(lines))
    job(tmp_path / "4", ["model=other"], [0.04, 0.06])
    table = {"title": "Table 3", "kind": "shading", "labels": LABELS}
    end(tmp_path, {**table, "paper": {"DOPE": {"part": {"80 %": 14.1}}}})
    missing, *found = read_table(tmp_path)
    assert missing["method"].endswith(": no such measurement")
    lenient = [row for row in found if row["measure"] == "ADD<5cm %"]
    assert [row["method"] for row in lenient] == ["DOPE", "DOPE, the paper", "DOPE++", "Δ DOPE++"]
    assert (lenient[0]["0 %"], lenient[0]["80 %"]) == ("90.0 ± 7.1", "40.0 ± 7.1")
    assert (lenient[1]["0 %"], lenient[1]["80 %"]) == ("", "14.1")
    # Equal seeds differ equally: the interval has no width.
    assert lenient[3]["80 %"] == "+20.0 [+20.0, +20.0]"
    strict = [row for row in found if row["measure"] == "ADD-0.1d %"]
    assert (strict[0]["method"], strict[0]["80 %"]) == ("DOPE", "20.0 ± 0.0")
    assert read_rgb(tmp_path / "table_shading.png").std() > 0


def test_shading_has_a_line_refined_and_none_of_another_checkpoint(tmp_path):
    header = "method,object,share,num_instances,pass_5cm,add_01d\n"
    for number, model in enumerate(("dope", "dopepp")):
        folder = tmp_path / str(number)
        job(folder, [f"model={model}"], [0.04, 0.06], refined=[0.004, 0.004])
        rates = {"other": 0.9, "other + region": 0.8, "x": 0.1, "x + region": 0.2 + number / 2}
        lines = [f"{name},part,0.2,10,{rate},{rate}\n" for name, rate in rates.items()]
        (folder / "shading.csv").write_text(header + "".join(lines))
    table = {"title": "Table 3", "kind": "shading", "labels": LABELS}
    end(tmp_path, {**table, "paper": {"DOPE": {"part": {"20 %": 14.1}}}})
    found = [row for row in read_table(tmp_path) if row["measure"] == "ADD<5cm %"]
    assert [(row["method"], row["20 %"]) for row in found] == [
        ("DOPE", "10.0"), ("DOPE, the paper", "14.1"),
        ("DOPE + region", "20.0"), ("Δ DOPE + region", "+10.0"),
        ("DOPE++", "10.0"), ("Δ DOPE++", "+0.0"),
        ("DOPE++ + region", "70.0"), ("Δ DOPE++ + region", "+50.0"),
    ]  # fmt: skip


def test_shading_of_one_network_a_part_has_a_mean(tmp_path):
    for number, (part, rate) in enumerate([("bolt", 0.2), ("nut", 0.6)]):
        folder = tmp_path / str(number)
        job(folder, ["model=dope", f"data.parts=[{part}]"], [0.04, 0.06], part)
        header = "method,object,share,num_instances,pass_5cm,add_01d\n"
        (folder / "shading.csv").write_text(f"{header}x,{part},0.2,10,{rate},{rate}\n")
    end(tmp_path, {"title": "Table 3", "kind": "shading", "labels": LABELS})
    rows = {(row["object"], row["measure"]): row["20 %"] for row in read_table(tmp_path)}
    assert rows["mean", "ADD-0.1d %"] == "40.0"
    assert rows["nut", "ADD-0.1d %"] == "60.0"


def test_costs_have_no_line_refined(tmp_path):
    job(tmp_path / "0", ["model=dope"], [0.04], refined=[0.004])
    end(tmp_path, {"title": "4", "kind": "parameters", "labels": LABELS})
    assert [row["method"] for row in read_table(tmp_path)] == ["DOPE: no such measurement"]


def test_costs(composed, tmp_path):
    small = ("scale=laptop", "data.input_size=[32,32]", "cost.num_frames=3", "cost.batch_size=2")
    for number, name in enumerate(("dope", "dopepp")):
        folder = tmp_path / str(number)
        job(folder, [f"model={name}"], None)
        (folder / FAILURE_FILE).unlink()
        do_job(composed("experiment=table8_time", f"model={name}", *small), folder)
    printed = {"DOPE++": {"network": {"ms/frame": 33, "backbone weights": 1106696}}, "DRNet": {}}
    end(tmp_path, {"title": "4", "kind": "parameters", "labels": LABELS, "paper": printed})
    dope, dopepp = read_table(tmp_path)
    assert (dope["method"], dopepp["method"]) == ("DOPE", "DOPE++")
    assert int(dope["parameters"].replace(",", "")) > int(dopepp["parameters"].replace(",", ""))
    assert (dope["the paper"], dopepp["the paper"]) == ("", "1,106,696")
    assert not (tmp_path / "frame_rate.png").exists()
    end(tmp_path, {"title": "8", "kind": "time", "labels": LABELS, "paper": printed})
    dope, dopepp, other = read_table(tmp_path)
    assert float(dope["ms/frame"]) > float(dope["network ms"]) > 0
    assert (dopepp["the paper: ms/frame"], other["method"]) == ("33", "DRNet")
    assert (tmp_path / "frame_rate.png").exists()


@pytest.mark.parametrize("experiment", EXPERIMENTS)
@pytest.mark.parametrize("scale", ["paper", "laptop"])
def test_every_experiment_composes(composed, experiment, scale):
    """Tables of trainings train as the paper does at its scale, and as we do on a laptop."""
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


def test_recipes_are_ours_unless_the_papers_are_asked_for(composed):
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
    job(tmp_path / "sweep" / "0", ["model=dope"], [0.04, 0.06])
    job(tmp_path / "sweep" / "1", ["model=dopepp"], [0.04, 0.04])
    out = compare_paths(
        [tmp_path / "sweep"], tmp_path / "out", table=FOLDER / "table6_dope_vs_dopepp.yaml"
    )
    measured = [row for row in read_table(out) if row["object"] == "part"]
    assert [row["method"] for row in measured] == ["DOPE", "DOPE++", "best constant pose"]
    assert (out / "table.md").read_text().startswith("# Table 6")


@pytest.mark.parametrize("text", ["model: dope\n", "table: Table 6\n", "- table\n"])
def test_an_experiment_without_a_table_is_refused_before_anything_is_written(text, tmp_path):
    job(tmp_path / "0", ["model=dope"], [0.04, 0.06])
    path = tmp_path / "experiment.yaml"
    path.write_text(text)
    with pytest.raises(UserError, match="lays out no table"):
        compare_paths([tmp_path / "0"], tmp_path / "out", table=path)
    assert not (tmp_path / "out").exists()
