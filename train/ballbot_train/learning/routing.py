"""Teaches a policy's `Routes` which sides are cheapest: what every choice costs is predicted, for thousands of drawn slaloms.

`ballbot_baselines.optimum.sides` predicts the costs from the motion without obstacles, which depends on the distance to the
goal alone. So no optimum of a slalom is searched for this.
"""

import math
from typing import cast

import numpy as np
import torch

from ballbot_baselines import find_optimum
from ballbot_baselines.optimum import sides
from ballbot_gym.robot import Robot
from ballbot_gym.tasks import Task
from ballbot_gym.tasks.symmetry import FRAMES
from ballbot_train.evaluation import fresh
from ballbot_train.policy.network import Routes
from ballbot_train.work.console import console

EPISODES = 60_000
_DISTANCES = 7  # for which the motion without obstacles is found
_STEPS, _BATCH, _RATE = 6000, 1024, 3e-3
_TOLERANCE = 0.004  # choices whose costs differ by less, relative to the episode's, are about as good
_BAD = 50.0  # price of a regret of 1: it keeps the network from the few choices that are far worse than the best


def fit_routes(
    routes: Routes,
    task: Task,
    params: Robot,
    seed: int,
) -> tuple[float, float]:
    """Fits the network to the predicted costs of `EPISODES` slaloms drawn for training.

    Returns:
        How much more its choices cost than the ones predicted to be the best, relative to the cost of the episode, on a tenth
        of these slaloms, to which it was not fitted; and how much more the nearer sides of all obstacles cost.
    """
    console.print(f"learning on which sides to pass obstacles, from {EPISODES:,} drawn slaloms")
    observations, regrets = _predicted_regrets(task, params, seed, EPISODES)
    layouts = routes.layout(torch.as_tensor(observations, dtype=torch.float32))
    costs = torch.as_tensor(regrets, dtype=torch.float32)
    wanted = torch.softmax(-costs / _TOLERANCE, -1)
    kept = max(1, EPISODES // 10)
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(routes.parameters(), _RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS)
    for _ in range(_STEPS):
        drawn = torch.randint(kept, EPISODES, (_BATCH,), generator=generator)
        outputs = routes.mlp(layouts[drawn])
        regret = (outputs.softmax(-1) * costs[drawn].clamp(max=1.0)).sum(-1).mean()
        loss = torch.nn.functional.cross_entropy(outputs, wanted[drawn]) + _BAD * regret
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        chosen = routes.mlp(layouts[:kept]).argmax(-1, keepdim=True)
    regret, nearer = (float(part.clamp(max=1.0).mean()) for part in (costs[:kept].gather(1, chosen), costs[:kept, 0]))
    console.print(f"its sides cost {regret:.2%} more than those predicted to be the best, the nearer ones {nearer:.2%}")
    return regret, nearer


def _predicted_regrets(task: Task, params: Robot, seed: int, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """What every choice of farther sides costs more than the best one, relative to the cost of the episode.

    Returns:
        Observations (episodes, no) at the start, and regrets (episodes, 2^n) in the order of the outputs of `Routes`. Where a
        repeated obstacle is passed on another side than before, there is no such choice, and the regret is 100.
    """
    assert task.routed_frame is not None
    x, c, _ = fresh.draw(task, range(episodes), seed, "training")
    goals = np.array([task.reference(*episode, params).x[-1, :2] for episode in zip(x, c, strict=True)])
    distances = goals[:, 0] - x[:, 0]
    known = np.argsort(distances)[np.linspace(0, episodes - 1, _DISTANCES).astype(int)]
    motions = [find_optimum(task, params, x[i], task.without_obstacles(c[i]), guesses=1) for i in known]
    nearest = np.abs(distances[:, None] - distances[known]).argmin(1)
    obstacles = [cast(np.ndarray, task.passed_obstacles(each)) for each in c]  # x, y and the distance to keep, m
    route = FRAMES[task.routed_frame].route
    assert route is not None
    farther = np.array(Routes.choices(route.obstacles), int)
    regrets = np.full((episodes, len(farther)), 100.0)
    counts = np.array([len(each) for each in obstacles])
    for count in np.unique(counts):
        columns = np.flatnonzero((farther[:, count:] == farther[:, count - 1 : count]).all(1))
        of_count = np.flatnonzero(counts == count)
        for rows in np.array_split(of_count, math.ceil(len(of_count) / _BATCH)):
            own = np.array([obstacles[i] for i in rows])
            stretch = distances[rows] / distances[known][nearest[rows]]
            along = stretch[:, None] * np.array([motions[k].trajectory.x[:, 0] for k in nearest[rows]])
            predicted = sides.predict(task, params, x[rows], goals[rows, 1], along, own)
            costs, row_of = predicted.costs, {tuple(side): row for row, side in enumerate(predicted.sides.tolist())}
            base = stretch**2 * np.array([motions[k].cost for k in nearest[rows]])
            relative = (costs - costs.min(1, keepdims=True)) / (base + costs.min(1))[:, None]
            nearer = np.where(
                own[..., 1] < goals[rows, None, 1], 1, -1
            )  # the left of an obstacle below the goal's line
            for column in columns:
                picked = [row_of[tuple(side)] for side in (farther[column, :count] * nearer).tolist()]
                regrets[rows, column] = relative[np.arange(len(rows)), picked]
    return np.asarray(task.observe(x, c)), regrets
