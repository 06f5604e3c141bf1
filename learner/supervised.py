"""S-step: training of the policy on observations and improved actions (paper Sec. II-A; Algorithm 2, line 13).

    minimise over theta   mean | network_theta(y) - (u* - offset) / scale |^2

from the current weights, by Adam with a step that decays to zero along half a cosine.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
import torch
from numpy.typing import NDArray

from t6gps.learner import policy
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.records import PolicySnapshot

TORCH_THREADS = 1
"""Fixed, since sums depend on how they are split: the same pairs must give the same weights on every machine."""


def train(
    snapshot: PolicySnapshot,
    observations: NDArray[np.float32],
    actions: NDArray[np.float32],
    settings: LearnerSettings,
    rng: np.random.Generator,
) -> Generator[tuple[int, int], None, tuple[PolicySnapshot, float]]:
    """Train on observations [n, ny] and actions u* [n, nu] (m), n >= 1.

    Yields (epochs done, epochs) and returns the next policy version with its mean squared error over all
    pairs, in network units (scale_m squared). The result is a function of the arguments alone.
    """
    torch.set_num_threads(TORCH_THREADS)
    inputs = torch.from_numpy(observations)
    targets = torch.from_numpy((actions - np.float32(snapshot.offset_m)) / np.float32(snapshot.scale_m))
    network = policy.module(snapshot)
    batches = -(-len(inputs) // settings.batch)
    optimiser = torch.optim.Adam(network.parameters(), lr=settings.learning_rate)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs * batches)
    loss_of = torch.nn.MSELoss()
    for epoch in range(settings.epochs):
        for batch in np.array_split(rng.permutation(len(inputs)), batches):
            chosen = torch.from_numpy(batch)
            loss = loss_of(network(inputs[chosen]), targets[chosen])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            decay.step()
        yield epoch + 1, settings.epochs
    with torch.no_grad():
        final = float(loss_of(network(inputs), targets))
    trained = policy.snapshot(
        network, version=snapshot.version + 1, offset_m=snapshot.offset_m, scale_m=snapshot.scale_m
    )
    return trained, final
