"""Options that several commands share."""

import ast
import inspect
import itertools
import textwrap
from typing import Annotated, cast

from ballbot_gym.lazy import missing
from ballbot_train.executors import Workers

try:
    import tyro
except ModuleNotFoundError as error:
    raise missing(__name__, error.name) from error

UNNAMED = tyro.conf.arg(name="")
"""Of a dataclass whose fields are options of their own names."""

WorkersOption = Annotated[Workers, UNNAMED, tyro.conf.DisallowNone]
"""The options --workers and --ray of every command that does much work."""


def meanings_of(config: type) -> dict[str, str]:
    """What the docstrings under the fields of a dataclass and its bases say, by field."""
    found: dict[str, str] = {}
    for kind in reversed(config.__mro__[:-1]):
        body = cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]).body
        for field, after in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                found[cast(ast.Name, field.target).id] = " ".join(ast.literal_eval(after.value).split())
    return found
