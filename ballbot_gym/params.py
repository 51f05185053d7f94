"""The robot's parameters, read from its URDF by link and joint name."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

from ballbot_gym import files
from ballbot_gym.omni import Wheels
from ballbot_gym.ops import as_float, is_number, is_positive

_PACKAGE = Path(__file__).parent
_IN_WHEEL, _IN_CHECKOUT = _PACKAGE / "urdf", _PACKAGE.parent / "urdf"
URDF_FOLDER = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CHECKOUT
"""The URDFs of all robots. A wheel holds it inside the package, a checkout beside the package."""
URDF_PATH = URDF_FOLDER / "ballbot.urdf"
"""The URDF of the paper's robot."""
ROLLING_URDF_PATH = URDF_FOLDER / "rolling.urdf"
"""The URDF of the paper's robot with a ball that rolls."""
OMNI_URDF_PATH = URDF_FOLDER / "omni.urdf"
"""The URDF of a robot with three omni-wheels."""

STANDARD_GRAVITY = 9.81  # m/s²; a URDF carries no gravity

_NO_NUMBER = (str, bytes, bool, dict, list, tuple, type(None))
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


class _Derived:
    """What follows from the fields of a robot. Computed once, because equations of motion read it all the time."""

    total_mass: float
    """Ball and body, kg."""
    moving_mass: float
    """What a horizontal acceleration of the upright robot moves: ball and body, and what the ball's rolling adds, kg."""
    weight: float
    """Of ball and body, N."""
    grips: bool
    """Whether the floor's force is limited by friction, so that the robot can lose its grip."""
    first_moment: float
    """m·l, the body's mass times its centre's height above the ball's, kg·m."""
    pivot_inertia: float
    """I + m·l², the body's transverse inertia about the ball's centre, kg·m²."""


@dataclass(frozen=True)
class BallbotParams(_Derived):
    """Masses and lengths of the ballbot.

    | field | meaning | unit |
    |---|---|---|
    | ball_mass, ball_radius | the ball | kg, m |
    | body_mass, body_radius, body_length | the body, a cylinder | kg, m |
    | com_height | body's centre of mass above the ball's centre | m |
    | inertia, axial_inertia | of the body about its centre of mass, across and along its axis | kg·m² |
    | force_limit | largest force on the ball along each axis | N |
    | gravity | | m/s² |
    | rolls | whether the ball rolls without slipping, driven by a torque between it and the body; the paper's translates | |
    | ball_inertia | of a rolling ball about its centre; 0 where the ball does not roll | kg·m² |
    | friction | coefficient between ball and floor; the paper's floor gives whatever force is asked, which is inf | |
    | wheels | of a robot that three omni-wheels drive; None for an ideal torque, and a body that does not yaw | |

    A force F on the ball of a rolling robot stands for the torque r e_z × F that the body applies to it. With wheels
    force_limit is the largest pull of each wheel on the ball, at standstill.

    Raises:
        ValueError: a field is no number, or not positive and finite; the message names it.
    """

    ball_mass: float
    ball_radius: float
    body_mass: float
    body_radius: float
    body_length: float
    com_height: float
    inertia: float
    axial_inertia: float
    force_limit: float
    gravity: float = STANDARD_GRAVITY
    rolls: bool = False
    ball_inertia: float = 0.0
    friction: float = math.inf
    wheels: Wheels | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.rolls, bool):
            raise ValueError(f"BallbotParams: rolls must be True or False, not {self.rolls!r}")
        if isinstance(self.wheels, dict):  # as `dataclasses.asdict` makes it
            object.__setattr__(self, "wheels", Wheels(**self.wheels))
        if self.wheels is not None and not (isinstance(self.wheels, Wheels) and self.rolls):
            raise ValueError(
                f"BallbotParams: wheels must be Wheels of a robot with rolls=True, or None, not {self.wheels!r}"
            )
        for field in fields(self):
            if field.name in ("rolls", "wheels"):
                continue
            value = as_float(getattr(self, field.name))
            object.__setattr__(self, field.name, value)
            if field.name == "friction" and is_number(value) and value == math.inf:
                continue
            if isinstance(value, _NO_NUMBER):
                raise ValueError(f"BallbotParams: {field.name} must be a number, not {value!r}")
            if field.name == "ball_inertia" and not self.rolls:
                if not is_number(value) or value != 0:
                    raise ValueError(
                        f"BallbotParams: ball_inertia must be 0 where the ball does not roll, not {value!r}; set rolls=True"
                    )
                continue
            # batches of robots hold tensors, whose values are not looked at
            if is_number(value) and not is_positive(value):
                raise ValueError(f"BallbotParams: {field.name} must be positive and finite, not {value}")
        if is_number(self.inertia) and is_number(self.axial_inertia) and self.axial_inertia > 2 * self.inertia:
            # Bullet would take 0 for both, without a word
            raise ValueError(f"BallbotParams: axial_inertia must be at most twice inertia, not {self.axial_inertia}")
        total = self.ball_mass + self.body_mass
        derived = {
            "total_mass": total,
            "moving_mass": total + self.ball_inertia / self.ball_radius**2 if self.rolls else total,
            "weight": total * self.gravity,
            "grips": not (is_number(self.friction) and self.friction == math.inf),
            "first_moment": self.body_mass * self.com_height,
            "pivot_inertia": self.inertia + self.body_mass * self.com_height**2,
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        """All fields, but wheels only where there are some: records of robots without name them by this."""
        told = (f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.name != "wheels" or self.wheels)
        return f"{type(self).__name__}({', '.join(told)})"

    @property
    def state_size(self) -> int:
        """Components of a state: those of `dynamics.STATE`, or `dynamics.OMNI_STATE` with wheels."""
        return 8 if self.wheels is None else 11

    @property
    def action_size(self) -> int:
        """Components of a force or action: x and y, or one for each wheel."""
        return 2 if self.wheels is None else 3

    @classmethod
    def from_urdf(cls, path: str | Path = URDF_PATH, gravity: float = STANDARD_GRAVITY) -> "BallbotParams":
        """Reads the parameters from a URDF with the paper's chain of links and joints, or with that of a rolling ball.

        A joint 'roll' makes it a rolling ball's: world → x → y → z prismatic, hub; from the hub the ball on the spherical
        joint 'roll', and gamma, yoke, theta, body. So only the ball rolls, and the body does not yaw. An element <wheels>
        adds three omni-wheels, and a frame between theta and the body, which then turns about its own axis on joint 'psi'.

        Args:
            path: the URDF; without one, the robot of the paper.
            gravity: m/s².

        Raises:
            UrdfError: a link, joint or inertial is missing, a mass is negative, an inertia not positive, or the
                chain differs from the one that the closed-form dynamics describe.
        """
        urdf = _Urdf(Path(path))
        rolls, has_wheels = (urdf.root.find(query) is not None for query in ("joint[@name='roll']", "wheels"))
        numbers = {name: urdf.number(*places[0]) for name, places in _PLACES.items() if rolls or name != "ball_inertia"}
        friction = math.inf if urdf.root.find(_FRICTION[0]) is None else urdf.number(*_FRICTION)
        wheel = {field.name: urdf.number("wheels", field.name) for field in fields(Wheels) if has_wheels}
        try:
            wheels = Wheels(**wheel) if wheel else None
            params = cls(**numbers, gravity=float(gravity), rolls=rolls, friction=friction, wheels=wheels)
        except (ValueError, OverflowError) as error:
            raise urdf.error(str(error)) from None
        urdf.check_alike(params._written(), rolls)
        if (effort := urdf.number(*_PLACES["force_limit"][1])) != params.force_limit:
            raise urdf.error(f"joints 'x' and 'y' must have one effort limit, not {params.force_limit} and {effort} N")
        return params

    def to_urdf(self) -> str:
        """The URDF text of this robot: a packaged file with this robot's numbers. `from_urdf` reads it back exactly."""
        return ElementTree.tostring(self._written(), encoding="unicode")

    def _written(self) -> ElementTree.Element:
        urdf = _Urdf(OMNI_URDF_PATH if self.wheels else ROLLING_URDF_PATH if self.rolls else URDF_PATH)
        for field in fields(Wheels) if self.wheels else ():
            urdf.element("wheels").set(field.name, repr(getattr(self.wheels, field.name)))
        for name, places in _PLACES.items():
            value = getattr(self, name)
            if name == "ball_inertia" and not self.rolls:
                # a solid sphere's, which has no effect; a power would raise an OverflowError where a product is inf
                value = 0.4 * self.ball_mass * self.ball_radius * self.ball_radius
            for query, attribute in places:
                if (element := urdf.root.find(query)) is not None:  # only a ball that rolls collides
                    element.set(attribute, f"0 0 {value!r}" if attribute == "xyz" else repr(value))
        ball = urdf.element(_BALL[:-1])
        if (contact := ball.find("contact")) is not None:
            ball.remove(contact)
        if self.friction != math.inf:
            contact = ElementTree.SubElement(ball, "contact")
            ElementTree.SubElement(contact, "lateral_friction").set("value", repr(self.friction))
        return urdf.root


@cache
def default_params() -> BallbotParams:
    """The paper's robot, read once from the packaged URDF."""
    return BallbotParams.from_urdf()


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
                    f"link '{name}' has a mass, and the equations of motion know ball and body alone; add its mass, and what "
                    "it does to the centre of mass and the inertias, to link 'body'"
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
