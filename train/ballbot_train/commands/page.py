"""`ballbot page`: the playground as one HTML page that needs no Python."""

from pathlib import Path

from ballbot_gym import files
from ballbot_train.work.console import console


def page(policies: tuple[str, ...] = (), /, out: Path = Path("runs/page/playground.html")) -> None:
    """Writes the playground, on which you push robots under a policy and LQR, as one HTML page without Python or network.

    Args:
        policies: policy files; each replaces the shipped policy of its task on the page.
        out: path of the page.
    """
    from ballbot_train.report.playground import playground_page  # it imports casadi

    written = files.write(out, playground_page(policies))
    console.print(f"page: {written}, {written.stat().st_size / 1e6:.2f} MB; open it in a browser")
