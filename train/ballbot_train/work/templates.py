"""Templates of text: HTML pages, and files in C."""

import functools
from pathlib import Path

from ballbot_gym.lazy import imports_of

with imports_of(__name__):
    import jinja2
    from markupsafe import Markup


@functools.cache
def _templates(folder: Path) -> jinja2.Environment:
    """The templates of a folder; those of pages escape every string that is not a `Markup`."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=lambda name: name is not None and name.endswith(".html.j2"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "ensure_ascii": False}
    return environment


def render(template: Path, **values: object) -> Markup:
    """The text of a template with these values."""
    return Markup(_templates(template.parent).get_template(template.name).render(values))
