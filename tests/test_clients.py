"""Every client of `docs/clients.md` runs as the page shows it. A client that is not installed is skipped."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "clients.md").read_text()
_TITLES = re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
_CODE = {title: "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)) for title, text in _TITLES}
SECTIONS = {title: code.replace("15_360_000", "4096") for title, code in _CODE.items() if code}
"""The code of each section by its title; a training of minutes is shortened."""
OURS = {"ballbot_gym", "ballbot_train"}
NEEDS = {"RL Baselines3 Zoo": {"rl_zoo3"}}  # besides what the code imports


def libraries(title):
    """What a section's code imports, or runs as a command."""
    named = re.findall(r"^(?:import|from) (\w+)", SECTIONS[title], re.MULTILINE)
    return (set(named) | NEEDS.get(title, set())) - OURS


@pytest.mark.slow
@pytest.mark.parametrize("title", SECTIONS)
def test_client_runs_as_documented(title, tmp_path):
    missing = sorted(name for name in libraries(title) if importlib.util.find_spec(name) is None)
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    # in a process of its own, because clients start threads and set global state
    environment = os.environ | {"RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    done = subprocess.run(
        [sys.executable, "-c", SECTIONS[title]], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


def test_every_client_that_make_installs_has_a_section():
    makefile = (ROOT / "Makefile").read_text()
    listed = re.search(r"^CLIENTS := (.*)$", makefile, re.MULTILINE)[1].split()
    imported = set().union(*map(libraries, SECTIONS))
    modules = {"torchrl>=0.14": "torchrl", "rl-zoo3": "rl_zoo3", "rsl-rl-lib": "rsl_rl"}
    assert {modules.get(name, name) for name in listed} <= imported
