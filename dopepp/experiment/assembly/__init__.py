"""From the configuration to objects, data, network and trainer."""
