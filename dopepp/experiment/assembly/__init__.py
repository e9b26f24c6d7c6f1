"""Build objects, data, network and trainer from a config."""
