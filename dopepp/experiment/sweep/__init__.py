"""Jobs of a multirun in other processes and on other machines: ``hydra/launcher=…``."""
