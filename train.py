"""Train: ``python train.py model=dopepp data=hybrid``; every option is a file in ``conf/``."""

import hydra
from omegaconf import DictConfig

from dopepp.experiment.command_line import entry, run_job


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(config: DictConfig) -> None:
    """Run one training job."""
    from dopepp.experiment.run import train

    run_job(config, train)


if __name__ == "__main__":
    entry(main, open_nodes=["virtual.scene"])
