"""Evaluate a checkpoint: ``python evaluate.py ckpt_path=outputs/…/checkpoints/best.ckpt``."""

from dopepp.experiment.entries import start

if __name__ == "__main__":
    start("evaluate")
