"""What people look at: figures, replays and the report page."""

from ballbot_gym.lazy import need

need(__name__, "matplotlib", "jinja2", "imageio", "PIL")
