import ast
import re
from pathlib import Path

import pytest

import ballbot_gym

ROOT = Path(__file__).parent.parent
PACKAGES = ("ballbot_gym", "ballbot_baselines", "ballbot_train")
FOLDERS = ("ballbot_gym", "baselines/ballbot_baselines", "train/ballbot_train")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
ALL_FILES = sorted(set(FILES) | {path for folder in ("tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")})


def imports(path, only_top_level=False):
    """Names of the packages that a file imports, anywhere or at its top level."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if only_top_level else ast.walk(tree)
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module.partition(".")[0])
    return found


def relative(paths):
    return [str(path.relative_to(ROOT)) for path in paths]


def test_there_are_files_to_look_at():
    assert len(FILES) > 20


@pytest.mark.parametrize(
    ("package", "above"),
    [("ballbot_gym", {"ballbot_baselines", "ballbot_train"}), ("ballbot_baselines", {"ballbot_train"})],
)
def test_packages_depend_in_one_direction(package, above):
    assert (
        relative(path for path in FILES if path.relative_to(ROOT).parts[0] == package and imports(path) & above) == []
    )


def test_only_the_simulator_knows_pybullet():
    knowing = [path for path in FILES if imports(path) & {"pybullet", "pybullet_data"}]
    assert relative(knowing) == ["ballbot_gym/simulator.py"]


def test_environments_import_no_solver_and_no_learner_at_their_top():
    heavy = {"casadi", "torch", "stable_baselines3", "pybullet", "scipy", "matplotlib"}
    gym = [path for path in FILES if path.relative_to(ROOT).parts[0] == "ballbot_gym" and path.name != "vector.py"]
    assert relative(path for path in gym if imports(path, only_top_level=True) & heavy) == []


def test_experts_import_no_learner():
    experts = [path for path in FILES if path.relative_to(ROOT).parts[0] == "ballbot_baselines"]
    assert relative(path for path in experts if imports(path) & {"torch", "stable_baselines3"}) == []


def test_nothing_outside_tasks_branches_on_a_task():
    names = r"isinstance\(\w*\.?_?task, (Stabilize|Turn|Orbit|Weave)"
    outside = [path for path in FILES if "tasks" not in path.parts]
    assert relative(path for path in outside if re.search(names, path.read_text())) == []


def test_no_file_names_a_place_on_the_developers_machine():
    # put together here, so that this file does not find itself
    places = re.compile("['\"(= ]/(" + "|".join(("wo" + "rk", "ho" + "me", "ro" + "ot", "Us" + "ers")) + r")\b")
    assert relative(path for path in ALL_FILES if places.search(path.read_text())) == []


def test_urdf_travels_with_the_package():
    assert (Path(ballbot_gym.__file__).parent / "urdf" / "ballbot.urdf").is_file()


def test_no_file_prints_but_the_command_line():
    def prints(path):
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        return any(isinstance(call.func, ast.Name) and call.func.id == "print" for call in calls)

    library = [path for path in FILES if path.relative_to(ROOT).parts[0] != "ballbot_train"]
    assert relative(path for path in library if prints(path)) == []
