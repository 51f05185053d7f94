"""Whether learners go on from their state, for tests of all of them."""

import io

import numpy as np
import torch


def parameters(learner):
    """All weights of the learner's network, in one row."""
    return torch.cat([value.flatten() for value in learner.network.state_dict().values()])


def through_a_file(state):
    """As a checkpoint does: tensors and plain values only."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return torch.load(io.BytesIO(buffer.getvalue()), weights_only=True)


def goes_on_as_if_never_stopped(make):
    """Whether one that goes on from another's state learns what one that never stopped learns, bit for bit.

    Args:
        make: a learner for a seed.
    """
    whole, second = make(0), make(1)
    start = parameters(whole)
    for _ in range(whole.iterations // 2):
        whole.iterate()
    state = through_a_file(whole.state_dict())
    while whole.iteration < whole.iterations:
        whole.iterate()
    second.load_state_dict(state)
    torch.manual_seed(99)  # nothing depends on what else is drawn
    np.random.seed(99)
    while second.iteration < second.iterations:
        second.iterate()
    learnt = parameters(whole)
    return torch.equal(parameters(second), learnt) and not torch.equal(start, learnt)
