"""Puts compiled code into a wheel where the environment variable BALLBOT_COMPILED names its folder; see wheels.py."""

import os
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CompiledCode(BuildHookInterface):
    """Includes the folder, and gives the wheel the tag in BALLBOT_TAG where there is one."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        folder, tag = os.environ.get("BALLBOT_COMPILED"), os.environ.get("BALLBOT_TAG")
        if folder and version != "editable":
            build_data["force_include"][folder] = "ballbot_gym/machine_code/compiled"
        if tag and version != "editable":
            build_data["tag"], build_data["pure_python"] = tag, False
