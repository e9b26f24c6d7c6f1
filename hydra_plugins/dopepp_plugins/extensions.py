"""Add the config files of user packages to Hydra's search path."""

from __future__ import annotations

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin


class Extensions(SearchPathPlugin):
    """Adds the folders that :mod:`dopepp.core.extensions` finds."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the folders last, so that no file hides a file of ``conf/``."""
        from dopepp.core.extensions import config_folders

        for package, folder in config_folders():
            search_path.append(provider=package, path=f"file://{folder}")
