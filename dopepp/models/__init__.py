"""Networks, their losses, the plain spec that describes them and the checkpoint that keeps them."""
