"""The dataset modules of the published `stable-worldmodel`, without importing its environments."""

import importlib.util
import sys
import types
from pathlib import Path

root = Path(importlib.util.find_spec("stable_worldmodel").submodule_search_locations[0])
for name in ("stable_worldmodel", "stable_worldmodel.data", "stable_worldmodel.data.formats"):
    package = types.ModuleType(name)
    package.__path__ = [str(root.joinpath(*name.split(".")[1:]))]
    sys.modules[name] = package

from stable_worldmodel.data.formats.lance import LanceDataset, LanceWriter  # noqa: E402, F401
