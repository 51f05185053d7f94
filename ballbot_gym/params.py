"""The robot's parameters, read from its URDF by link and joint name."""

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

from ballbot_gym import files
from ballbot_gym.omni import Wheels
from ballbot_gym.ops import is_number, is_positive

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

# joint: type, axis, parent link, child link. The closed-form dynamics hold for these two chains only.
_CHAIN = {
    "x": ("prismatic", (1.0, 0.0, 0.0), "world", "slide"),
    "y": ("prismatic", (0.0, 1.0, 0.0), "slide", "ball"),
    "gamma": ("continuous", (0.0, 1.0, 0.0), "ball", "yoke"),
    "theta": ("continuous", (-1.0, 0.0, 0.0), "yoke", "body"),
}
_ROLLING_CHAIN = {
    "x": ("prismatic", (1.0, 0.0, 0.0), "world", "slide_x"),
    "y": ("prismatic", (0.0, 1.0, 0.0), "slide_x", "slide_y"),
    "z": ("prismatic", (0.0, 0.0, 1.0), "slide_y", "hub"),
    "roll": ("spherical", None, "hub", "ball"),
    "gamma": ("continuous", (0.0, 1.0, 0.0), "hub", "yoke"),
    "theta": ("continuous", (-1.0, 0.0, 0.0), "yoke", "body"),
}
_OMNI_CHAIN = _ROLLING_CHAIN | {
    "theta": ("continuous", (-1.0, 0.0, 0.0), "yoke", "frame"),
    "psi": ("continuous", (0.0, 0.0, 1.0), "frame", "body"),
}
_NO_NUMBER = (str, bytes, bool, dict, list, tuple, type(None))
_FILE_LIMIT = 16 * 2**20  # bytes
_MASSLESS_LINKS = ("slide", "yoke")
_ROLLING_MASSLESS_LINKS = ("slide_x", "slide_y", "hub", "yoke")
_OMNI_MASSLESS_LINKS = (*_ROLLING_MASSLESS_LINKS, "frame")


class UrdfError(ValueError):
    """A URDF that does not describe a ballbot; the message names the file, the element and the fault."""


@dataclass(frozen=True)
class BallbotParams:
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
            value = getattr(self, field.name)
            if field.name in ("rolls", "wheels") or (
                field.name == "friction" and is_number(value) and value == math.inf
            ):
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

    @cached_property
    def total_mass(self) -> float:
        """Ball and body, kg."""
        return self.ball_mass + self.body_mass

    @cached_property
    def moving_mass(self) -> float:
        """What a horizontal acceleration of the upright robot moves: ball and body, and what the ball's rolling adds, kg."""
        return self.total_mass + self.ball_inertia / self.ball_radius**2 if self.rolls else self.total_mass

    @cached_property
    def weight(self) -> float:
        """Of ball and body, N."""
        return self.total_mass * self.gravity

    @cached_property
    def grips(self) -> bool:
        """Whether the floor's force is limited by friction, so that the robot can lose its grip."""
        return not (is_number(self.friction) and self.friction == math.inf)

    @cached_property
    def first_moment(self) -> float:
        """m·l, the body's mass times its centre's height above the ball's, kg·m."""
        return self.body_mass * self.com_height

    @cached_property
    def pivot_inertia(self) -> float:
        """I + m·l², the body's transverse inertia about the ball's centre, kg·m²."""
        return self.inertia + self.body_mass * self.com_height**2

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
        rolls, wheels = urdf.has_joint("roll"), urdf.wheels()
        chain, massless = (_ROLLING_CHAIN, _ROLLING_MASSLESS_LINKS) if rolls else (_CHAIN, _MASSLESS_LINKS)
        if wheels is not None:
            chain, massless = _OMNI_CHAIN, _OMNI_MASSLESS_LINKS
        for joint, (kind, axis, parent, child) in chain.items():
            urdf.check_joint(joint, kind, axis, parent, child)
        for link in massless:
            urdf.check_massless(link)
        ball_mass = urdf.positive_mass("ball")
        ball_inertias = urdf.principal_inertias("ball")
        if rolls and len(set(ball_inertias)) > 1:
            raise urdf.error(f"link 'ball' must be round: its inertias {ball_inertias} kg·m² differ")
        transverse, transverse_y, axial = urdf.principal_inertias("body")
        if transverse != transverse_y:
            raise urdf.error(f"link 'body' must be round: ixx = {transverse} differs from iyy = {transverse_y}")
        return cls(
            ball_mass=ball_mass,
            ball_radius=urdf.visual("ball", "sphere", "radius"),
            body_mass=urdf.positive_mass("body"),
            body_radius=urdf.visual("body", "cylinder", "radius"),
            body_length=urdf.visual("body", "cylinder", "length"),
            com_height=urdf.com_height("body"),
            inertia=transverse,
            axial_inertia=axial,
            force_limit=urdf.force_limit(),
            gravity=float(gravity),
            rolls=rolls,
            ball_inertia=ball_inertias[0] if rolls else 0.0,
            friction=urdf.friction("ball"),
            wheels=wheels,
        )

    def to_urdf(self) -> str:
        """The URDF text of this robot: a packaged file with this robot's numbers. `from_urdf` reads it back exactly."""
        urdf = _Urdf(OMNI_URDF_PATH if self.wheels else ROLLING_URDF_PATH if self.rolls else URDF_PATH)
        if self.wheels is not None:
            for field in fields(Wheels):
                urdf.find("wheels").set(field.name, repr(getattr(self.wheels, field.name)))
        urdf.find("link[@name='ball']/inertial/mass").set("value", repr(self.ball_mass))
        urdf.find("link[@name='body']/inertial/mass").set("value", repr(self.body_mass))
        body_inertia = urdf.find("link[@name='body']/inertial/inertia")
        for name, value in (("ixx", self.inertia), ("iyy", self.inertia), ("izz", self.axial_inertia)):
            body_inertia.set(name, repr(value))
        # that of a solid sphere has no effect where the ball does not roll
        ball_inertia = self.ball_inertia if self.rolls else 0.4 * self.ball_mass * self.ball_radius**2
        for name in ("ixx", "iyy", "izz"):
            urdf.find("link[@name='ball']/inertial/inertia").set(name, repr(ball_inertia))
        for place in ("inertial", "visual"):
            urdf.find(f"link[@name='body']/{place}/origin").set("xyz", f"0 0 {self.com_height!r}")
        urdf.find("link[@name='ball']/visual/geometry/sphere").set("radius", repr(self.ball_radius))
        if self.rolls:
            urdf.find("link[@name='ball']/collision/geometry/sphere").set("radius", repr(self.ball_radius))
        cylinder = urdf.find("link[@name='body']/visual/geometry/cylinder")
        cylinder.set("radius", repr(self.body_radius))
        cylinder.set("length", repr(self.body_length))
        urdf.find("joint[@name='x']/origin").set("xyz", f"0 0 {self.ball_radius!r}")
        for joint in ("x", "y"):
            urdf.find(f"joint[@name='{joint}']/limit").set("effort", repr(self.force_limit))
        urdf.set_friction("ball", self.friction)
        return ElementTree.tostring(urdf.root, encoding="unicode")


@cache
def default_params() -> BallbotParams:
    """The paper's robot, read once from the packaged URDF."""
    return BallbotParams.from_urdf()


class ModelNumbers(NamedTuple):
    """The parameters that `dynamics` reads, as plain values, tensors or symbols.

    torch.compile cannot trace the cached properties of `BallbotParams`, because they take a lock.
    """

    total_mass: Any
    moving_mass: Any
    first_moment: Any
    pivot_inertia: Any
    axial_inertia: Any
    gravity: Any
    weight: Any
    rolls: bool
    ball_radius: Any
    friction: Any
    grips: bool
    com_height: Any = None
    ball_inertia: Any = None
    force_limit: Any = None
    wheels: Wheels | None = None

    @classmethod
    def of(cls, params: BallbotParams) -> "ModelNumbers":
        total_mass = params.ball_mass + params.body_mass
        rolling = params.ball_inertia / params.ball_radius**2 if params.rolls else None
        return cls(
            total_mass=total_mass,
            moving_mass=total_mass if rolling is None else total_mass + rolling,
            first_moment=BallbotParams.first_moment.func(params),
            pivot_inertia=BallbotParams.pivot_inertia.func(params),
            axial_inertia=params.axial_inertia,
            gravity=params.gravity,
            weight=total_mass * params.gravity,
            rolls=params.rolls,
            ball_radius=params.ball_radius,
            friction=params.friction,
            grips=BallbotParams.grips.func(params),
            com_height=params.com_height,
            ball_inertia=params.ball_inertia,
            force_limit=params.force_limit,
            wheels=params.wheels,
        )


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

    def find(self, query: str) -> ElementTree.Element:
        element = self.root.find(query)
        if element is None:
            raise self.error(f"no {query}")
        return element

    def _named(self, tag: str, name: str) -> ElementTree.Element:
        elements = self.root.findall(f"{tag}[@name='{name}']")
        if not elements:
            raise self.error(f"{tag} '{name}' is missing")
        if len(elements) > 1:
            raise self.error(f"{tag} '{name}' is there {len(elements)} times; it must be there once")
        return elements[0]

    def _child(self, tag: str, name: str, query: str) -> ElementTree.Element:
        element = self._named(tag, name).find(query)
        if element is None:
            raise self.error(f"{tag} '{name}' has no <{query.replace('/', '><')}>")
        return element

    def _number(self, element: ElementTree.Element, attribute: str, where: str) -> float:
        text = element.get(attribute)
        if text is None:
            raise self.error(f"{where} has no attribute '{attribute}'")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(f"{where}: {attribute} = '{text}' is not a number")
        return value

    def _vector(self, element: ElementTree.Element | None, default: str, where: str) -> tuple[float, ...]:
        text = default if element is None else element.get("xyz", default)
        try:
            vector = tuple(float(part) for part in text.split())
        except ValueError:
            vector = ()
        if len(vector) != 3 or not all(map(math.isfinite, vector)):
            raise self.error(f"{where}: xyz = '{text}' is not three numbers")
        return vector

    def has_joint(self, name: str) -> bool:
        return self.root.find(f"joint[@name='{name}']") is not None

    def wheels(self) -> Wheels | None:
        """Those of the element <wheels>, if there is one."""
        element = self.root.find("wheels")
        if element is None:
            return None
        try:
            return Wheels(**{f.name: self._number(element, f.name, "wheels") for f in fields(Wheels)})
        except ValueError as error:
            raise error if isinstance(error, UrdfError) else self.error(str(error)) from None

    def friction(self, link: str) -> float:
        """The coefficient of a link's <contact>, which Bullet reads too; without one, inf."""
        element = self._named("link", link).find("contact/lateral_friction")
        if element is None:
            return math.inf
        value = self._number(element, "value", f"lateral_friction of link '{link}'")
        if value <= 0:
            raise self.error(f"link '{link}' must have a positive lateral_friction, not {value}")
        return value

    def set_friction(self, link: str, friction: float) -> None:
        element = self._named("link", link)
        contact = element.find("contact")
        if contact is not None:
            element.remove(contact)
        if friction != math.inf:
            contact = ElementTree.SubElement(element, "contact")
            ElementTree.SubElement(contact, "lateral_friction").set("value", repr(friction))

    def check_joint(self, name: str, kind: str, axis: tuple[float, ...] | None, parent: str, child: str) -> None:
        joint = self._named("joint", name)
        for tag, expected in (("parent", parent), ("child", child)):
            self._named("link", expected)
            found = self._child("joint", name, tag).get("link")
            if found != expected:
                raise self.error(f"joint '{name}' has {tag} link '{found}'; it must be '{expected}'")
        kinds = ("continuous", "revolute") if kind == "continuous" else (kind,)
        if joint.get("type") not in kinds:
            raise self.error(f"joint '{name}' is of type '{joint.get('type')}'; it must be {kind}")
        x, y, z = self._vector(joint.find("origin"), "0 0 0", f"origin of joint '{name}'")
        if (x, y) != (0, 0) or (z != 0 and name != "x"):
            raise self.error(f"joint '{name}' is displaced by {(x, y, z)} m; only joint 'x' may be, upwards")
        self._check_unrotated(joint.find("origin"), f"joint '{name}'")
        found_axis = self._vector(joint.find("axis"), "1 0 0", f"axis of joint '{name}'")
        if axis is not None and found_axis != axis:
            raise self.error(f"joint '{name}' has axis {found_axis}; it must be {axis}")

    def check_massless(self, link: str) -> None:
        if self.mass(link) != 0:
            raise self.error(f"link '{link}' has mass {self.mass(link)} kg; it must have 0")
        inertia = self._child("link", link, "inertial/inertia")
        where = f"inertia of link '{link}'"
        for name in ("ixx", "iyy", "izz"):
            if self._number(inertia, name, where) != 0:
                raise self.error(f"{where}: {name} must be 0, as its mass is")

    def _check_unrotated(self, origin: ElementTree.Element | None, where: str) -> None:
        text = "0 0 0" if origin is None else origin.get("rpy", "0 0 0")
        if any(part.strip("+-0.") for part in text.split()):
            raise self.error(f"{where} is rotated: rpy = '{text}' must be 0 0 0")

    def mass(self, link: str) -> float:
        mass = self._number(self._child("link", link, "inertial/mass"), "value", f"mass of link '{link}'")
        if mass < 0:
            raise self.error(f"link '{link}' has negative mass {mass} kg")
        return mass

    def positive_mass(self, link: str) -> float:
        mass = self.mass(link)
        if mass == 0:
            raise self.error(f"link '{link}' has mass 0; it must be positive")
        return mass

    def principal_inertias(self, link: str) -> tuple[float, float, float]:
        inertia = self._child("link", link, "inertial/inertia")
        where = f"inertia of link '{link}'"
        for name in ("ixy", "ixz", "iyz"):
            if inertia.get(name) is not None and self._number(inertia, name, where) != 0:
                raise self.error(f"{where}: {name} must be 0")
        ixx, iyy, izz = (self._number(inertia, name, where) for name in ("ixx", "iyy", "izz"))
        if min(ixx, iyy, izz) <= 0:
            raise self.error(f"{where} must be positive, not {(ixx, iyy, izz)} kg·m²")
        return ixx, iyy, izz

    def com_height(self, link: str) -> float:
        origin = self._child("link", link, "inertial/origin")
        self._check_unrotated(origin, f"inertial of link '{link}'")
        x, y, z = self._vector(origin, "0 0 0", f"centre of mass of link '{link}'")
        if (x, y) != (0, 0) or z <= 0:
            raise self.error(f"link '{link}' must have its centre of mass on the axis above the ball, not at {x, y, z}")
        return z

    def visual(self, link: str, shape: str, attribute: str) -> float:
        element = self._child("link", link, f"visual/geometry/{shape}")
        value = self._number(element, attribute, f"{shape} of link '{link}'")
        if value <= 0:
            raise self.error(f"{shape} of link '{link}' must have a positive {attribute}, not {value} m")
        return value

    def force_limit(self) -> float:
        efforts = [
            self._number(self._child("joint", name, "limit"), "effort", f"limit of joint '{name}'") for name in "xy"
        ]
        if efforts[0] != efforts[1] or efforts[0] <= 0:
            raise self.error(f"joints 'x' and 'y' must have one positive effort limit, not {efforts} N")
        return efforts[0]
