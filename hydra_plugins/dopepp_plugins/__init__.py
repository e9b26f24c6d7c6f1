"""Hydra plugins that call ``dopepp.experiment``.

Hydra loads sweepers and launchers only from ``hydra_plugins`` and imports all of them at every
start. Therefore these modules are short and import nothing but Hydra.
"""
