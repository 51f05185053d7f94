"""Symmetries of tasks, declared once, for learners and policies: mirror images, and frames of reference.

A policy that respects a symmetry learns a situation once, and not again for every mirror image or direction.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from ballbot_gym import ops
from ballbot_gym.ops import squared


@dataclass(frozen=True)
class Mirror:
    """A mirror image: flipping these signs turns a motion into another motion with the same cost, limits and goal.

    Each field holds 1 or −1 for every component.
    """

    state: tuple[int, ...]
    """(8,) signs of the state."""
    action: tuple[int, int]
    """Signs of the force."""
    constants: tuple[int, ...] = ()
    """(nc,) signs of the episode's constants."""


MIRROR_X = Mirror((-1, 1, -1, 1, -1, 1, -1, 1), (-1, 1))
"""x and everything along it change their sign."""
MIRROR_Y = Mirror((1, -1, 1, -1, 1, -1, 1, -1), (1, -1))
"""y and everything along it change their sign."""
HALF_TURN = Mirror((-1,) * 8, (-1, -1))
"""Both mirrors one after the other: a rotation by 180°."""

REACH = 2**0.5
"""Actions in a frame, each component within ±REACH, include all actions of the world, however the frame is turned."""

Back = Callable[[tuple[Any, Any]], tuple[Any, Any]]
"""Turns an action in a frame into the action in the world."""


@dataclass(frozen=True)
class Route:
    """The functions of a network that decides on which side each obstacle is passed."""

    obstacles: int
    """Number of obstacles n of an observation, repeated ones included."""
    layout: Callable[[tuple[Any, ...]], tuple[Any, ...]]
    """Observation -> positions and radii of the obstacles (3 n). They hardly change during an episode."""
    sides: Callable[[tuple[Any, ...], tuple[Any, ...]], tuple[Any, ...]]
    """Observation, and 1 or −1 for every obstacle that is passed on its nearer or farther side -> 1 or −1 for every obstacle
    that is passed on its left or on its right."""


@dataclass(frozen=True)
class Frame:
    """A frame of reference that moves with the robot."""

    size: int
    """Number of features."""
    features: Callable[[tuple[Any, ...]], tuple[tuple[Any, ...], Back]]
    """Observation, as a tuple of its entries -> features (size), and the way back for actions."""
    route: Route | None = None
    """The route, if one decides on which sides obstacles are passed. These sides are then appended to the observation."""
    steady: Callable[[tuple[Any, ...]], tuple[tuple[Any, ...], tuple[Any, Any]]] | None = None
    """Features -> features (size), and action in the frame, of the steady motion that is the goal of the episode."""


def _radial(observation: tuple[Any, ...]) -> tuple[tuple[Any, ...], Back]:
    """Orbit's observation as seen from the ball: outwards is forwards, and the commanded motion goes to the left.

    The next feature is the commanded centripetal acceleration, v²/r, in units of 10 m/s². Leans and forces of steady orbits
    are nearly linear in it, so one rule fits slow and fast orbits. The last five resolve small errors
    (`_fine`): of radius, velocity, and of the lean from the steady orbit's. Without them a policy rides next to the circle.

    The body's axis is rotated instead of the angles γ and θ, because a rotation about the vertical maps axes to axes exactly.
    The symmetry neglects the body's inertia about its own axis, which is 1 % of the other inertia.
    """
    x, y, gamma, theta, vx, vy, gamma_dot, theta_dot, radius_error, ex, ey, radius, speed = observation
    distance = ops.sqrt(x * x + y * y + 1e-12)
    cos, sin = x / distance, y / distance
    side = ops.where(speed < 0, -1.0, 1.0)

    def rotated(a: Any, b: Any) -> tuple[Any, Any]:
        return cos * a + sin * b, side * (cos * b - sin * a)

    sin_gamma, cos_gamma = ops.sin(gamma), ops.cos(gamma)
    sin_theta, cos_theta = ops.sin(theta), ops.cos(theta)
    axis_x_rate = cos_gamma * cos_theta * gamma_dot - sin_gamma * sin_theta * theta_dot
    lean_out, lean_along = rotated(sin_gamma * cos_theta, sin_theta)
    error_out, error_along = rotated(ex, ey)
    pull = speed * speed / radius * (5.0**2 / 3.0 / 10.0)  # as observed they are divided by 5 m/s and by 3 m
    features = (
        distance,
        lean_out,
        lean_along,
        *rotated(vx, vy),
        *rotated(axis_x_rate, cos_theta * theta_dot),
        radius_error,
        error_out,
        error_along,
        radius,
        side * speed,
        pull,
        _fine(radius_error, 0.05),
        _fine(error_out, 0.2 / 5),
        _fine(error_along, 0.2 / 5),
        _fine(lean_out + _steady_lean(pull, 3.0 * radius), 0.05),
        _fine(lean_along, 0.05),
    )

    def back(action: tuple[Any, Any]) -> tuple[Any, Any]:
        outwards, along = action[0], side * action[1]
        return cos * outwards - sin * along, sin * outwards + cos * along

    return features, back


def _steady_orbit(features: tuple[Any, ...]) -> tuple[tuple[Any, ...], tuple[Any, Any]]:
    """`_radial`'s features on the steady orbit of the paper's robot, and the force inwards that keeps it there.

    See `Ballbot.steady_orbit`; to 0.001.
    """
    radius, speed, pull = features[10:13]
    none = 0.0 * radius
    meters = 3.0 * radius
    lean = _steady_lean(pull, meters, substitutions=12)
    turning = -lean * (5.0 * speed / meters) / 5.0  # of the body's axis, as observed divided by 5 rad/s
    force = 10.0 * pull * (_BALL_MASS + _BODY_MASS * (1.0 - _COM_HEIGHT * lean / meters))
    seen = (radius, -lean, none, none, speed, none, turning, none, none, none, radius, speed, pull)
    fine = (none, none, none, _fine(_steady_lean(pull, meters) - lean, 0.05), none)
    return (*seen, *fine), (-force / _FORCE_LIMIT, none)


def _steady_lean(pull: Any, radius: Any, substitutions: int = 3) -> Any:
    """Sine of the lean on a circle of this radius, m, where the ball is pulled inwards by `pull` times 10 m/s².

    See `PointBall.steady_speed`, whose equation substitutions solve, three of them to 0.003, with J/h of the paper's robot.
    """
    slope = pull
    for _ in range(substitutions):
        slope = pull / (_GRAVITY + _INERTIA_BY_MOMENT * pull / radius / ops.sqrt(1.0 + slope * slope))
    return slope / ops.sqrt(1.0 + slope * slope)


def _slalom(observation: tuple[Any, ...]) -> tuple[tuple[Any, ...], Back]:
    """Weave's observation as seen along the way: the next obstacles, the first of them to the left of the goal's line.

    Each obstacle is described by the distance ahead, by how far to the left the nearer way past it is, and by its radius. The
    nearer way is the one on the side of the line through the goal along x. It does not change while the robot moves, so
    a policy that takes it does not waver. It is best at every obstacle in four of five drawn slaloms, and costs 0.2 % on
    average. If the sides of a route are appended to the observation, the way on these sides replaces the nearer one. The
    radius is then negative for an obstacle that is to be passed on its right, as seen in the frame.

    Obstacles that the ball has passed are removed, and the next ones take their places. The side of the last obstacle still
    counts after it is passed, so that the features do not flip while the robot comes to rest.
    """
    x, y, gamma, theta, vx, vy, gamma_dot, theta_dot, *numbers = observation
    count = 3 * _OBSTACLES
    columns = [numbers[:count:3], numbers[1:count:3], numbers[2:count:3]]
    sides = [numbers[count:]] if numbers[count:] else []
    obstacles = list(zip(*columns, *sides, strict=True))
    for _ in obstacles[1:]:
        passed = _passed(obstacles[0][0], obstacles[0][2])
        obstacles = [
            tuple(ops.where(passed, after, before) for before, after in zip(*pair, strict=True))
            for pair in zip(obstacles, [*obstacles[1:], obstacles[-1]], strict=True)
        ]
    side = ops.where(obstacles[0][1] + y < 0, -1.0, 1.0)
    features = [x, side * y, gamma, side * theta, vx, side * vy, gamma_dot, side * theta_dot]
    for dx, dy, radius, *decided in obstacles[:_OBSTACLES_SEEN]:
        passed = _passed(dx, radius)
        left = decided[0] if decided else ops.where(dy + y < 0, 1.0, -1.0)
        way = dy + left * 0.2 * (radius + _BALL_RADIUS)
        signed = side * left * radius if decided else radius
        features += [ops.where(passed, -0.2, dx), ops.where(passed, 0.0, side * way), ops.where(passed, 0.0, signed)]
    return tuple(features), lambda action: (action[0], side * action[1])


def _slalom_layout(observation: tuple[Any, ...]) -> tuple[Any, ...]:
    """Where Weave's obstacles lie as seen from the goal, the first of them on the left: 5 times x, y and radius as observed.

    It stays the same throughout an episode, but for rounding.
    """
    x, y, *_ = observation
    numbers = observation[8:]
    side = ops.where(numbers[1] + y < 0, -1.0, 1.0)
    triples = zip(numbers[::3], numbers[1::3], numbers[2::3], strict=True)
    return tuple(value for dx, dy, radius in triples for value in (dx + x, side * (dy + y), radius))


def _slalom_sides(observation: tuple[Any, ...], farther: tuple[Any, ...]) -> tuple[Any, ...]:
    """See `Route.sides`. The nearer side is that of the goal's line."""
    layout = _slalom_layout(observation)
    mirrored = ops.where(observation[9] + observation[1] < 0, -1.0, 1.0)
    sides: list[Any] = []
    before: tuple[Any, ...] | None = None
    for (x, y, radius), way in zip(zip(layout[::3], layout[1::3], layout[2::3], strict=True), farther, strict=True):
        side = mirrored * way * ops.where(y < 0, 1.0, -1.0)
        if before is not None:  # unused numbers repeat the last obstacle, and so its side
            off = squared(x - before[0], y - before[1], radius - before[2])
            side = ops.where(off < 1e-9, sides[-1], side)
        sides.append(side)
        before = (x, y, radius)
    return tuple(sides)


def _fine_slalom(observation: tuple[Any, ...]) -> tuple[tuple[Any, ...], Back]:
    """Same as `_slalom`, followed by features that resolve small errors at rest in the goal, for learning from scratch."""
    features, back = _slalom(observation)
    return (*features, *_fine_rest(features)), back


def _rest(observation: tuple[Any, ...]) -> tuple[tuple[Any, ...], Back]:
    """Stabilize's observation, followed by features that resolve small errors at rest, for learning from scratch."""
    return (*observation, *_fine_rest(observation)), lambda action: action


def _still(features: tuple[Any, ...], obstacles: int = 0) -> tuple[tuple[Any, ...], tuple[Any, Any]]:
    """Features at rest at the goal, with these obstacles passed. No force is needed there."""
    none = 0.0 * features[0]
    seen = [none] * len(features)
    for i in range(obstacles):
        seen[8 + 3 * i] = none - 0.2
    return tuple(seen), (none, none)


def _fine_rest(seen: tuple[Any, ...]) -> list[Any]:
    """Small errors of position, velocity and lean (`_fine`) at a goal where the robot rests."""
    x, y, gamma, theta, vx, vy, *_ = seen
    errors = ((x, 0.05 / 5), (y, 0.05 / 5), (vx, 0.2 / 5), (vy, 0.2 / 5), (gamma, 0.05), (theta, 0.05))
    return [_fine(*error) for error in errors]


def _passed(dx: Any, radius: Any) -> Any:
    """Whether the ball is beyond an obstacle, given as observed."""
    return 5.0 * dx < -(radius + _BALL_RADIUS)


def _gate(observation: tuple[Any, ...], fine: bool = False) -> tuple[tuple[Any, ...], Back]:
    """Turn's observation, with features for what decides the turn: the speed as steps, and the errors at the gate in units of
    the gate's tolerances.

    Slow turns go directly, and fast turns loop. The best way switches between 3.4 and 4.6 m/s; where exactly depends on the
    robot and on the reserve that is kept at the gate. A network that observes the speed alone averages both ways there.

    A policy cannot carry a way of turning over a sharp step to the next speed. So the steps of the fine frame are 0.1 m/s
    wide. It also has leans and lean rates in units of the gate's tolerances.
    """
    x, y, gamma, theta, vx, vy, gamma_dot, theta_dot, speed = observation
    errors = [(x, 0.2 / 5), (y, 0.2 / 5), (vx, 0.5 / 5), (vy, 0.5 / 5)]
    if fine:
        steps = [0.5 * _fine(5.0 * speed - switch, 0.1) for switch in _SWITCHES]
        errors += [(gamma, 0.17), (theta, 0.17), (gamma_dot, 1.0 / 5), (theta_dot, 1.0 / 5)]
    else:
        steps = [ops.where(5.0 * speed > switch, 0.5, -0.5) for switch in _SWITCHES]
    return (*observation, *steps, *(_fine(*error) for error in errors)), lambda action: action


def _fine(error: Any, tolerance: float) -> Any:
    """An error, scaled so that values below the tolerance are resolved and large values are ±1."""
    return error / ops.sqrt(error * error + tolerance * tolerance)


_BALL_MASS, _BODY_MASS, _COM_HEIGHT, _FORCE_LIMIT = 0.5, 15.0, 0.6, 350.0  # kg, kg, m, N, of the paper's robot
_GRAVITY = 0.981  # 10 m/s²
_INERTIA_BY_MOMENT = 0.743  # m
_SWITCHES = tuple(3.4 + 0.1 * i for i in range(13))  # m/s
_OBSTACLES, _OBSTACLES_SEEN = 5, 4  # of an observation, repeated ones included; and of them in the frame
_BALL_RADIUS = 0.1  # m, about

_still_behind = partial(_still, obstacles=_OBSTACLES_SEEN)

FRAMES: dict[str, Frame] = {
    "radial": Frame(18, _radial, steady=_steady_orbit),
    "slalom": Frame(8 + 3 * _OBSTACLES_SEEN, _slalom, steady=_still_behind),
    "routed_slalom": Frame(8 + 3 * _OBSTACLES_SEEN, _slalom, route=Route(_OBSTACLES, _slalom_layout, _slalom_sides)),
    "fine_slalom": Frame(14 + 3 * _OBSTACLES_SEEN, _fine_slalom, steady=_still_behind),
    "fine_rest": Frame(14, _rest, steady=_still),
    "gate": Frame(13 + len(_SWITCHES), _gate),
    "fine_gate": Frame(17 + len(_SWITCHES), partial(_gate, fine=True)),
}
"""Every frame by the name that tasks and policy files give."""
