"""Train: ``python train.py model=dopepp data=hybrid``; every option is a file in ``conf/``."""

import hydra
from omegaconf import DictConfig

from dopepp.experiment.command_line import SHORT_NAMES, entry, run_job


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(config: DictConfig) -> float | None:
    """Run one job and return what a search maximises."""
    from dopepp.experiment.train import do_job

    return run_job(config, do_job)


if __name__ == "__main__":
    entry(main, open_nodes=["virtual.scene"], short_names=SHORT_NAMES)
