"""Ballbots as URDF files, read and written by link and joint name."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

from ballbot_gym import files
from ballbot_gym.robot.ballbot import STANDARD_GRAVITY, Ballbot
from ballbot_gym.robot.general_omni import GeneralOmni
from ballbot_gym.robot.omni import Omni, Wheels
from ballbot_gym.robot.point_ball import PointBall
from ballbot_gym.robot.rolling_ball import RollingBall

_PACKAGE = Path(__file__).parent.parent
_IN_WHEEL, _IN_CHECKOUT = _PACKAGE / "urdf", _PACKAGE.parent / "urdf"
URDF_FOLDER = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CHECKOUT
"""The URDFs of all robots. It lies inside the package in a wheel, and next to the package in a checkout."""
URDF_PATH = URDF_FOLDER / "ballbot.urdf"
"""The URDF of the paper's robot."""
ROLLING_URDF_PATH = URDF_FOLDER / "rolling.urdf"
"""The URDF of the paper's robot with a ball that rolls."""
OMNI_URDF_PATH = URDF_FOLDER / "omni.urdf"
"""The URDF of a robot with three omni-wheels."""

_TEMPLATES = {
    PointBall: URDF_PATH,
    RollingBall: ROLLING_URDF_PATH,
    Omni: OMNI_URDF_PATH,
    GeneralOmni: OMNI_URDF_PATH,
}
_FILE_LIMIT = 16 * 2**20  # bytes
_BALL, _BODY, _SHAPE = "link[@name='ball']/", "link[@name='body']/", "visual/geometry/"
_PLACES: dict[str, tuple[tuple[str, str], ...]] = {
    "ball_mass": ((f"{_BALL}inertial/mass", "value"),),
    "ball_radius": (
        (f"{_BALL}{_SHAPE}sphere", "radius"),
        (f"{_BALL}collision/geometry/sphere", "radius"),
        ("joint[@name='x']/origin", "xyz"),
    ),
    "body_mass": ((f"{_BODY}inertial/mass", "value"),),
    "body_radius": ((f"{_BODY}{_SHAPE}cylinder", "radius"),),
    "body_length": ((f"{_BODY}{_SHAPE}cylinder", "length"),),
    "com_height": ((f"{_BODY}inertial/origin", "xyz"), (f"{_BODY}visual/origin", "xyz")),
    "inertia": ((f"{_BODY}inertial/inertia", "ixx"), (f"{_BODY}inertial/inertia", "iyy")),
    "axial_inertia": ((f"{_BODY}inertial/inertia", "izz"),),
    "ball_inertia": tuple((f"{_BALL}inertial/inertia", name) for name in ("ixx", "iyy", "izz")),
    "force_limit": (("joint[@name='x']/limit", "effort"), ("joint[@name='y']/limit", "effort")),
}
"""Where a URDF has each number: element and attribute. The first place is read, and all are written."""
_CENTRE = f"{_BODY}inertial/origin"
_AS_BUILT = ("zenith", "azimuth_1", "azimuth_2", "azimuth_3", "axle_friction")
"""What <wheels> may have of a robot whose wheels are not where those of the packaged robots are."""
_FRICTION = f"{_BALL}contact/lateral_friction", "value"
_COMPARED = {
    "joint": (
        (".", "type"),
        ("parent", "link"),
        ("child", "link"),
        ("axis", "xyz"),
        ("origin", "xyz"),
        ("origin", "rpy"),
    ),
    "link": (
        *(("inertial/mass", "value"), ("inertial/origin", "xyz"), ("inertial/origin", "rpy")),
        *(("inertial/inertia", name) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")),
    ),
}
"""What a file must have as the packaged one does: the closed-form dynamics hold for these chains only."""


class UrdfError(ValueError):
    """A URDF that does not describe a ballbot; the message names the file, the element and the fault."""


def read_urdf(path: str | Path = URDF_PATH, gravity: float = STANDARD_GRAVITY) -> Ballbot:
    """The robot of a URDF with the paper's chain of links and joints, or with that of a rolling ball.

    A joint 'roll' makes it a rolling ball's: world → x → y → z prismatic, hub; from the hub the ball on the spherical
    joint 'roll', and gamma, yoke, theta, body. So only the ball rolls, and the body does not yaw. An element <wheels>
    adds three omni-wheels, and a frame between theta and the body, which then turns about its own axis on joint 'psi'. It is
    a `GeneralOmni` if the body's centre of mass is off its axis, or if <wheels> has a zenith, an azimuth_1, azimuth_2 or
    azimuth_3, rad, or an axle_friction, N·m.

    Args:
        path: the URDF; without one, the robot of the paper.
        gravity: m/s².

    Raises:
        UrdfError: a link, joint or inertial is missing, a mass is negative, an inertia not positive, or the
            chain differs from the one that the closed-form dynamics describe.
    """
    urdf = _Urdf(Path(path))
    rolls, has_wheels = (urdf.root.find(query) is not None for query in ("joint[@name='roll']", "wheels"))
    kind: type[Ballbot] = Omni if has_wheels else RollingBall if rolls else PointBall
    off_axis = 0.0, 0.0
    own: dict[str, Any] = {}
    if has_wheels:
        off_axis = urdf.vector(_CENTRE)[:2]
        given = urdf.element("wheels").attrib
        own = {name: urdf.number("wheels", name) for name in _AS_BUILT if name in given}
        if own or off_axis != (0.0, 0.0):
            kind, own = GeneralOmni, own | dict(zip(("com_x", "com_y"), off_axis, strict=True))
    names = {field.name for field in fields(kind)}
    numbers: dict[str, Any] = {name: urdf.number(*places[0]) for name, places in _PLACES.items() if name in names}
    friction = math.inf if urdf.root.find(_FRICTION[0]) is None else urdf.number(*_FRICTION)
    wheel = {field.name: urdf.number("wheels", field.name) for field in fields(Wheels) if has_wheels}
    try:
        if has_wheels:
            numbers["wheels"] = Wheels(**wheel)
        robot = kind(**numbers, **own, gravity=float(gravity), friction=friction)
    except (ValueError, OverflowError) as error:
        raise urdf.error(str(error)) from None
    urdf.check_alike(_written(robot), rolls)
    if (effort := urdf.number(*_PLACES["force_limit"][1])) != robot.force_limit:
        raise urdf.error(f"joints 'x' and 'y' must have one effort limit, not {robot.force_limit} and {effort} N")
    return robot


def urdf_text(robot: Ballbot) -> str:
    """The URDF text of a robot: a packaged file with the robot's numbers. `read_urdf` reads it back exactly."""
    return ElementTree.tostring(_written(robot), encoding="unicode")


def _written(robot: Ballbot) -> ElementTree.Element:
    urdf = _Urdf(_TEMPLATES[type(robot)])
    for name, kind in robot.PARTS.items():  # an element of this name has an attribute for each number
        for field in fields(kind):
            urdf.element(name).set(field.name, repr(getattr(getattr(robot, name), field.name)))
    for name, places in _PLACES.items():
        # a ball that does not roll is a solid sphere, which has no effect; a power would raise an OverflowError where a
        # product is inf
        value = getattr(robot, name, 0.4 * robot.ball_mass * robot.ball_radius * robot.ball_radius)
        for query, attribute in places:
            if (element := urdf.root.find(query)) is not None:  # only a ball that rolls collides
                element.set(attribute, f"0 0 {value!r}" if attribute == "xyz" else repr(value))
    if isinstance(robot, GeneralOmni):
        for name in _AS_BUILT:
            urdf.element("wheels").set(name, repr(getattr(robot, name)))
        urdf.element(_CENTRE).set("xyz", f"{robot.com_x!r} {robot.com_y!r} {robot.com_height!r}")
    ball = urdf.element(_BALL[:-1])
    if (contact := ball.find("contact")) is not None:
        ball.remove(contact)
    if robot.friction != math.inf:
        contact = ElementTree.SubElement(ball, "contact")
        ElementTree.SubElement(contact, "lateral_friction").set("value", repr(robot.friction))
    return urdf.root


@cache
def default_params() -> PointBall:
    """The paper's robot, read once from the packaged URDF."""
    robot = read_urdf()
    assert isinstance(robot, PointBall)
    return robot


class _Tree(ElementTree.TreeBuilder):
    """Builds elements of XML without a DOCTYPE, whose entities could unfold to a hundred times the file."""

    def doctype(self, *declared: str | None) -> None:
        raise ValueError("it declares a DOCTYPE, which no URDF needs; delete that")


class _Urdf:
    """A parsed URDF. Its methods raise a `UrdfError` that names what is missing."""

    def __init__(self, path: Path):
        self.path = path
        try:
            parser = ElementTree.XMLParser(target=_Tree())
            self.root = ElementTree.fromstring(files.read(path, _FILE_LIMIT), parser)
        except files.FileError as error:
            raise UrdfError(f"{error}; give the path of a URDF") from None
        # an unknown encoding is a LookupError, or a ValueError if it is one of several bytes
        except (ElementTree.ParseError, LookupError, ValueError, RecursionError) as error:
            raise UrdfError(f"{path}: not well-formed XML: {error}") from None

    def error(self, text: str) -> UrdfError:
        return UrdfError(f"{self.path}: {text}")

    def element(self, query: str) -> ElementTree.Element:
        """The element of a query that begins with one in the root, such as a link or a joint by name."""
        whole, _, inner = query.partition("/")
        called, elements = whole.replace("[@name=", " ").removesuffix("]"), self.root.findall(whole)
        if not elements:
            raise self.error(f"{called} is missing")
        if len(elements) > 1:
            raise self.error(f"{called} is there {len(elements)} times; it must be there once")
        if (element := elements[0].find(inner or ".")) is None:
            raise self.error(f"{called} has no <{inner.replace('/', '><')}>")
        return element

    def vector(self, query: str) -> tuple[float, ...]:
        """The three numbers of an element's xyz."""
        self.number(query, "xyz")
        return _parts(self.element(query).get("xyz", ""))  # pyright: ignore[reportReturnType]  checked above

    def number(self, query: str, attribute: str) -> float:
        """A number, of a vector the last."""
        text = self.element(query).get(attribute, "")
        parts = _parts(text)
        if isinstance(parts, str) or len(parts) != (3 if attribute == "xyz" else 1):
            raise self.error(
                f"{query}: {attribute} = '{text}' is not {'three numbers' if attribute == 'xyz' else 'a number'}"
            )
        return parts[-1]

    def check_alike(self, wanted: ElementTree.Element, rolls: bool) -> None:
        """Checks that every joint and link of a packaged URDF is here, with the same places, axes, masses and inertias."""
        known = {(each.tag, each.get("name", "")) for each in wanted}
        for link in self.root.findall("link"):
            name = link.get("name", "")
            mass = link.find("inertial/mass")
            if ("link", name) not in known and mass is not None and _parts(mass.get("value", "")) != (0.0,):
                raise self.error(
                    f"link '{name}' has a mass, but the equations of motion contain only ball and body; add its mass, and "
                    "its effect on the centre of mass and the inertias, to link 'body'"
                )
        free = {("roll", "axis"), ("x", "origin")} | (set() if rolls else {("ball", "inertial/inertia")})
        for each in wanted:
            name = each.get("name", "")
            for place, attribute in _COMPARED.get(each.tag, ()):
                here = self.element(f"{each.tag}[@name='{name}']")
                found, right = (_attribute(element, place, attribute) for element in (here, each))
                if found != right and (name, place) not in free:
                    what = f"{place} {attribute}".removeprefix(". ")
                    raise self.error(f"{each.tag} '{name}': {what} is {found}, and must be {right}")


def _attribute(element: ElementTree.Element, place: str, attribute: str) -> str | tuple[float, ...]:
    """An attribute as it counts, with its default in URDFs."""
    default = {"link": "", "type": ""}.get(attribute, "0")
    if attribute in ("xyz", "rpy"):
        default = "1 0 0" if place == "axis" else "0 0 0"
    inner = element.find(place)
    return _parts((default if inner is None else inner.get(attribute, default)).replace("revolute", "continuous"))


def _parts(text: str) -> str | tuple[float, ...]:
    """Text as finite numbers, if it is that."""
    try:
        numbers = tuple(float(part) for part in text.split())
    except ValueError:
        return text
    return numbers if numbers and all(map(math.isfinite, numbers)) else text
