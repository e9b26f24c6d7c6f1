"""Training: the LightningModule around the network, and its callbacks."""
