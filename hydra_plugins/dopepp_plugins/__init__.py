"""Hydra's ends of what lives in ``dopepp.experiment``.

Hydra instantiates sweepers and launchers only out of ``hydra_plugins``, and imports all of it at
every start: these modules are thin and import nothing but Hydra.
"""
