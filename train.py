"""Train a network: ``python train.py model=dopepp data=hybrid``; see ``conf/`` for the options."""

from dopepp.experiment.entries import start

if __name__ == "__main__":
    start("train")
