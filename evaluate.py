"""Evaluate: ``python evaluate.py ckpt_path=outputs/…/checkpoints/best.ckpt``."""

import hydra
from omegaconf import DictConfig

from dopepp.experiment.command_line import SHORT_NAMES, entry, run_job
from dopepp.experiment.reports import protocols


@hydra.main(version_base="1.3", config_path="conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    """Run one evaluation."""
    from dopepp.experiment.evaluate import evaluate

    run_job(config, evaluate)


if __name__ == "__main__":
    entry(main, ["data", "virtual"], {**SHORT_NAMES, **protocols.SHORT_NAMES})
