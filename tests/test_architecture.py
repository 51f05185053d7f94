import ast
import functools
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import ballbot_baselines
import ballbot_gym
import ballbot_train

ROOT = Path(__file__).parent.parent
PACKAGES = ("ballbot_gym", "ballbot_baselines", "ballbot_train")
FOLDERS = ("ballbot_gym", "baselines/ballbot_baselines", "train/ballbot_train")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
ALL_FILES = sorted(set(FILES) | {path for folder in ("tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")})


# The rooms from the bottom to the top. A file imports from its own room and from those below it only.
ROOMS = (
    "ballbot_gym",
    *("solvers", "optimum", "proofs", "feedback", "identification", "paper", "ballbot_baselines"),
    *("ballbot_train", "work", "policy", "evaluation", "learning", "report", "commands"),
)


@functools.cache
def parsed(path):
    """The syntax tree of a file, without what runs for type checkers alone."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            node.body = []
    return tree


@functools.cache
def modules(path, only_top_level):
    """Dotted names that the import statements of a file name, anywhere in it or at its top level only.

    `from a import b` counts as a.b, because b may be a module.
    """
    tree, found = parsed(path), set()
    for node in tree.body if only_top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def imports(path, only_top_level=False):
    """Names of the packages that a file imports, anywhere or at its top level."""
    return {name.partition(".")[0] for name in modules(path, only_top_level=only_top_level)}


def package(path):
    """The package that a file belongs to."""
    return next(part for part in path.relative_to(ROOT).parts if part in PACKAGES)


def room(module):
    """The room of a dotted name; None where it is of another package.

    The entry point `ballbot_train.cli` belongs to the commands.
    """
    top, *inner = module.split(".")
    below = inner[0] if inner else ""
    if top != "ballbot_train":
        return below if top == "ballbot_baselines" and below in ROOMS else top if top in PACKAGES else None
    return "commands" if below == "cli" else below if below in ROOMS else top


def room_of(path):
    """The room of a file."""
    parts = path.with_suffix("").parts
    return room(".".join(parts[parts.index(package(path)) :]))


def relative(paths):
    return [str(path.relative_to(ROOT)) for path in paths]


def test_imports_go_down():
    upwards = [
        f"{path.relative_to(ROOT)} ({room_of(path)}) imports {name} from a room above it"
        for path in FILES
        for name in modules(path, only_top_level=False)
        if room(name) and ROOMS.index(room(name)) > ROOMS.index(room_of(path))
    ]
    assert upwards == []
    assert {room_of(path) for path in FILES} == set(ROOMS)


def test_only_the_engines_know_physics_engines_and_only_the_viewer_the_library_of_its_page():
    knowing = [path for path in FILES if imports(path) & {"pybullet", "mujoco", "websockets"}]
    assert relative(knowing) == [
        "ballbot_gym/drawing/viewer.py",
        "ballbot_gym/engines/bullet_client.py",
        "ballbot_gym/engines/mujoco.py",
    ]


def test_environments_import_no_solver_and_no_learner_at_their_top():
    heavy = {"casadi", "torch", "stable_baselines3", "pybullet", "mujoco", "scipy", "matplotlib", "websockets"}
    gym = [path for path in FILES if package(path) == "ballbot_gym"]
    assert relative(path for path in gym if imports(path, only_top_level=True) & heavy) == []


def test_importing_the_environments_imports_only_numpy_and_gymnasium():
    heavy = {
        "torch",
        "casadi",
        "scipy",
        "matplotlib",
        "pybullet",
        "stable_baselines3",
        "ballbot_baselines",
        "ballbot_train",
    }
    code = f"import sys, ballbot_gym; print(*sorted({heavy} & set(sys.modules)))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


def test_no_default_reads_a_urdf_when_its_module_is_imported():
    def early_calls(path):
        """Calls outside of functions' bodies, where they run at import: at the top, in classes and in defaults."""
        waiting: list[ast.AST] = [parsed(path)]
        while waiting:
            node = waiting.pop()
            if isinstance(node, ast.Call):
                yield ast.unparse(node.func)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                waiting += [*node.args.defaults, *(d for d in node.args.kw_defaults if d), *node.decorator_list]
            elif not isinstance(node, ast.Lambda):
                waiting += ast.iter_child_nodes(node)

    readers = {"default_params", "params.default_params", "read_urdf"}
    assert relative(path for path in FILES if readers & set(early_calls(path))) == []


def test_experts_import_no_learner():
    experts = [path for path in FILES if package(path) == "ballbot_baselines"]
    assert relative(path for path in experts if imports(path) & {"torch", "stable_baselines3"}) == []


def test_nothing_outside_tasks_branches_on_a_task():
    names = r"isinstance\(\w*\.?_?task, (Stabilize|Turn|Orbit|Weave)"
    outside = [path for path in FILES if "tasks" not in path.parts]
    assert relative(path for path in outside if re.search(names, path.read_text())) == []


def test_no_file_names_a_place_on_the_developers_machine():
    # put together here, so that this file does not find itself
    places = re.compile("['\"(= ]/(" + "|".join(("wo" + "rk", "ho" + "me", "ro" + "ot", "Us" + "ers")) + r")\b")
    assert relative(path for path in ALL_FILES if places.search(path.read_text())) == []


def test_the_cubic_hermite_basis_and_the_angle_of_tilt_each_have_one_place():
    basis = re.compile(r"3 - 2 \* \w+|1 \+ 2 \* \w+\) \*")
    assert relative(path for path in FILES if basis.search(path.read_text())) == ["ballbot_gym/tasks/paths.py"]
    angle = re.compile(r"\b(math|np|torch)\.(acos|arccos)\(")
    assert relative(path for path in FILES if angle.search(path.read_text())) == ["ballbot_gym/ops.py"]


def test_no_file_prints_but_the_command_line():
    def prints(path):
        calls = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
        return any(isinstance(call.func, ast.Name) and call.func.id == "print" for call in calls)

    library = [path for path in FILES if package(path) != "ballbot_train"]
    assert relative(path for path in library if prints(path)) == []


def test_what_users_are_shown_to_import_comes_from_the_tops_of_the_packages() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs/notebooks").glob("*.ipynb")]
    shown = {page: page.read_text() for page in [*pages, *(ROOT / "examples").glob("*.py")]}
    deep = re.compile(r"(?:from|import) +ballbot_(?:gym|baselines|train)\.\w+")
    assert {page.name: deep.findall(text) for page, text in shown.items() if deep.search(text)} == {}


@pytest.mark.parametrize("package", [ballbot_gym, ballbot_baselines, ballbot_train])
def test_every_public_name_of_a_package_is_there(package: Any) -> None:
    for name in package.__all__:
        assert getattr(package, name) is not None
    assert len({name for each in (ballbot_gym, ballbot_baselines, ballbot_train) for name in each.__all__}) <= 80
