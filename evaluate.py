"""Evaluate: ``python evaluate.py ckpt_path=outputs/…/checkpoints/best.ckpt``."""

import hydra
from omegaconf import DictConfig

from dopepp.experiment.command_line import entry, run_job
from dopepp.experiment.reports.protocols import SHORT_NAMES


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    """Run one evaluation."""
    from dopepp.experiment.evaluate import evaluate

    run_job(config, evaluate)


if __name__ == "__main__":
    entry(main, open_nodes=["data", "virtual"], short_names=SHORT_NAMES)
