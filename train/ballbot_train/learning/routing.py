"""Teaches a policy's `Routes` which sides are cheapest: what every choice costs is predicted, for thousands of drawn slaloms.

`ballbot_baselines.sides` predicts the costs from the motion without obstacles, which depends on the goal's distance alone. So
no optimum of a slalom is searched for this.
"""

import itertools

import numpy as np
import torch

from ballbot_baselines import sides
from ballbot_baselines.optimum import find_optimum
from ballbot_gym.params import BallbotParams
from ballbot_gym.tasks import Task
from ballbot_train.console import console
from ballbot_train.evaluation import fresh
from ballbot_train.routes import Routes

EPISODES = 60_000
_DISTANCES = 7  # for which the motion without obstacles is found
_STEPS, _BATCH, _RATE = 6000, 1024, 3e-3
_TOLERANCE = 0.004  # choices whose costs differ by less, relative to the episode's, are about as good


def fit_routes(
    routes: Routes,
    task: Task,
    params: BallbotParams,
    seed: int,
    episodes: int | None = None,
    gradient_steps: int | None = None,
) -> float:
    """Fits the network to the predicted costs of slaloms drawn for training: of `EPISODES`, by default.

    Returns:
        How much more its choices cost than the ones predicted to be the best, relative to the cost of the episode, on a tenth
        of these slaloms, to which it was not fitted.
    """
    episodes = EPISODES if episodes is None else episodes
    gradient_steps = _STEPS if gradient_steps is None else gradient_steps
    console.print(f"learning on which sides to pass obstacles, from {episodes:,} drawn slaloms")
    observations, regrets = predicted_regrets(task, params, seed, episodes)
    layouts = routes.layout(torch.as_tensor(observations, dtype=torch.float32))
    costs = torch.as_tensor(regrets, dtype=torch.float32)
    wanted = torch.softmax(-costs / _TOLERANCE, -1)
    kept = max(1, episodes // 10)
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(routes.parameters(), _RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, gradient_steps)
    for _ in range(gradient_steps):
        drawn = torch.randint(kept, episodes, (_BATCH,), generator=generator)
        loss = torch.nn.functional.cross_entropy(routes.mlp(layouts[drawn]), wanted[drawn])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        chosen = routes.mlp(layouts[:kept]).argmax(-1, keepdim=True)
    return float(costs[:kept].clamp(max=1.0).gather(1, chosen).mean())


def predicted_regrets(task: Task, params: BallbotParams, seed: int, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """What every choice of farther sides costs more than the best one, relative to the cost of the episode.

    Returns:
        Observations (episodes, no) at the start, and regrets (episodes, 2^n) in the order of the outputs of `Routes`. Where a
        repeated obstacle is passed on another side than before, there is no such choice, and the regret is 100.
    """
    x, c = fresh.draw(task, range(episodes), seed, "training")
    observations = np.asarray(task.observe(x, c))
    obstacles = c[:, 2:].reshape(episodes, -1, 3)
    numbers = obstacles.shape[1]
    new = np.concatenate([np.ones((episodes, 1), bool), (np.diff(obstacles, axis=1) != 0).any(-1)], 1)
    counts = new.sum(1)
    distances = np.linspace(c[:, 0].min(), c[:, 0].max(), _DISTANCES)
    motions = [_without_obstacles(task, params, x[0], c[0], distance) for distance in distances]
    nearest = np.abs(c[:, :1] - distances).argmin(1)
    regrets = np.full((episodes, 2**numbers), 100.0)
    farther = np.array(list(itertools.product((1, -1), repeat=numbers)))
    for count in np.unique(counts):
        rows = np.flatnonzero(counts == count)
        own = obstacles[rows, :count]
        paths = np.array([path for path, _ in motions])[nearest[rows]]
        scale = c[rows, 0] / distances[nearest[rows]]
        passed = np.abs(scale[:, None, None] * paths[:, :, None] - own[:, None, :, 0]).argmin(1)
        y_goal = c[rows, 1]
        reach = np.array([task.passed_obstacles(each)[:, 2] for each in c[rows]])
        across = np.column_stack([x[rows, 1] - y_goal, x[rows, 3], x[rows, 5], x[rows, 7]])
        seen = np.stack([own[..., 1] - y_goal[:, None], reach], -1)
        costs = np.concatenate(
            [
                sides.predict_costs(task, params, *(part[k : k + 500] for part in (across, seen, passed)))
                for k in range(0, len(rows), 500)
            ]
        )
        base = np.array([cost for _, cost in motions])[nearest[rows]] * scale**2
        relative = (costs - costs.min(1, keepdims=True)) / (base + costs.min(1))[:, None]
        # from sides in the world to farther sides: the nearer one is on the left of an obstacle that lies below the line
        nearer = np.where(seen[..., 0] < 0, 1, -1)
        table = {tuple(side): k for k, side in enumerate(sides.choices(count).tolist())}
        for column, choice in enumerate(farther):
            if (choice[count:] != choice[count - 1]).any():
                continue
            picked = [table[tuple(side)] for side in (choice[:count] * nearer).tolist()]
            regrets[rows, column] = relative[np.arange(len(rows)), picked]
    return observations, regrets


def _without_obstacles(
    task: Task, params: BallbotParams, x: np.ndarray, c: np.ndarray, distance: float
) -> tuple[np.ndarray, float]:
    """Positions along the way (steps + 1,) m, and the cost, of the optimum to a goal so far away, without obstacles."""
    free = task.without_obstacles(c)
    free[0] = distance
    start = x.copy()
    start[1] = free[1]
    found = find_optimum(task, params, start, free, guesses=1)
    return found.trajectory.x[:, 0], found.cost
