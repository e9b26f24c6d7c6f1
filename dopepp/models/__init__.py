"""Networks, losses, the spec that describes a network, and checkpoints."""
