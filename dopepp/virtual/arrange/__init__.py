"""From a preset to one scene: which bodies, where, how they lie."""
