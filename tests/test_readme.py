"""Every Python block of the README runs as it stands, in order, as a reader would paste it."""

import re
from pathlib import Path

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_python_examples_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(blocks) >= 3
    namespace = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), namespace)
    assert "Solve_Succeeded" in capsys.readouterr().out


def test_pictures_and_commands_that_it_names_exist():
    from ballbot_train.commands import COMMANDS

    for picture in re.findall(r"!\[[^]]*\]\(([^)]*)\)", README):
        assert (Path(__file__).parent.parent / picture).exists(), picture
    for command in re.findall(r"`ballbot (\w+)", README):
        assert command in COMMANDS
