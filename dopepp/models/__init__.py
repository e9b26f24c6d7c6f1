"""Networks, losses, the plain spec that describes a network, and checkpoints."""
