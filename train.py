"""Train: ``python train.py model=dopepp data=hybrid``; every option is a file in ``conf/``."""

from dopepp.experiment.entries import start

if __name__ == "__main__":
    start("train")
