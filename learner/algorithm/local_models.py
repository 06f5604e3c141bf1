"""Local models of every class, and their association with the rows they came from (Algorithm 2, lines 4 to 6 and 9).

Each group of segments becomes one job: its aligned samples, the pooled moments it is shrunk towards, and a
seed of its own. `fit_class` is a pure function of the job, so jobs may run anywhere, in any order. Every row
with a dynamics sample lies in exactly one bin (group, step) of one job; patching a series of models along a
trajectory is a table look-up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm import warping
from t6gps.learner.algorithm.features import NONE, Rows
from t6gps.learner.algorithm.modes import FitOptions, Models, Moments, fit_modes, moments, stack
from t6gps.learner.algorithm.segments import SegmentGroup, Segments

Ints = NDArray[np.int64]

FIT_STREAM = 0
"""Branch of the learner's seed sequence from which the fits draw."""


@dataclass(frozen=True)
class ClassJob:
    """Everything that the models of one group of segments depend on; can be pickled.

    rows      positions of the samples in the iteration's rows [n], ascending
    samples   joint vectors [x; u; x'] [n, 2 nx + nu]
    step      aligned step of each sample [n], 0 .. steps - 1
    crosses   the last step holds crossings into the next triangle's frame
    ordinary, crossing   moments pooled over the kind, and over kind and exit; None where no such sample
                         exists
    entropy, branch      of the job's own seed sequence
    """

    rows: Ints
    samples: NDArray[np.float32]
    state_n: int
    step: Ints
    steps: int
    crosses: bool
    ordinary: Moments | None
    crossing: Moments | None
    options: FitOptions
    entropy: int
    branch: tuple[int, ...]


@dataclass(frozen=True)
class ClassModel:
    """Models of a group of segments, by step and mode.

    models     all of them, k in number, step after step
    modes      number of modes per step [steps]; 0 where a step has no sample
    model      model of each sample of the job [n], the mode with the least residual
    residual   that residual [n] in standard deviations
    """

    models: Models
    modes: Ints
    model: Ints
    residual: NDArray[np.float64]


@dataclass(frozen=True)
class Patch:
    """The models of all groups and the one that belongs to each row [n], NONE without a dynamics sample."""

    models: Models
    of_row: Ints
    residual: NDArray[np.float64]


def jobs(
    rows: Rows,
    segments: Segments,
    groups: Sequence[SegmentGroup],
    options: FitOptions,
    run_seed: int,
    iteration: int,
) -> dict[int, ClassJob]:
    """The job of each group with a dynamics sample, by its position in `groups` (paper Sec. III-B to III-E)."""
    samples, index = rows.samples, np.flatnonzero(rows.continues)
    priors = _pooled_moments(rows, samples, index)
    group_of = np.full(len(segments.start), NONE)
    for number, group in enumerate(groups):
        group_of[group.segments] = number
    group_of_row, lengths = group_of[segments.of_row[index]], segments.stop - segments.start
    built = {}
    for number in np.unique(group_of_row).tolist():
        chosen, group = index[group_of_row == number], groups[number]
        kind, entry, exit_, truncated = group.key
        crosses, segment = exit_ != NONE, segments.of_row[chosen]
        steps = warping.class_steps(lengths[group.segments], crosses)
        built[number] = ClassJob(
            rows=chosen,
            samples=samples[chosen],
            state_n=rows.state.shape[1],
            step=warping.align(chosen - segments.start[segment], lengths[segment], steps, crosses),
            steps=steps,
            crosses=crosses,
            ordinary=priors.get((kind, NONE)),
            crossing=priors.get((kind, exit_)) if crosses else None,
            options=options,
            entropy=run_seed,
            branch=(1, iteration, FIT_STREAM, kind, entry + 1, exit_ + 1, int(truncated), int(group.pooled)),
        )
    return built


def _pooled_moments(rows: Rows, samples: NDArray[np.float32], index: Ints) -> dict[tuple[int, int], Moments]:
    """Moments of the ordinary transitions of each kind, key (kind, NONE), and of the crossings by kind and exit."""
    kinds, exits = rows.kind[index], rows.exit[index]
    return {
        (kind, exit_): moments(samples[index[(kinds == kind) & (exits == exit_)]].astype(np.float64))
        for kind, exit_ in sorted(set(zip(kinds.tolist(), exits.tolist(), strict=True)))
    }


def fit_class(job: ClassJob) -> ClassModel:
    """Models of every step of one group (FitLocalModels of Algorithm 2); depends on nothing but `job`."""
    rng = np.random.default_rng(np.random.SeedSequence(job.entropy, spawn_key=job.branch))
    tables, modes = [], np.zeros(job.steps, dtype=np.int64)
    model, residual = np.full(len(job.step), NONE), np.full(len(job.step), np.nan)
    for step in np.unique(job.step).tolist():
        chosen = np.flatnonzero(job.step == step)
        prior = job.crossing if job.crosses and step == job.steps - 1 else job.ordinary
        assert prior is not None, "every sample is part of the pool of its kind"
        samples = job.samples[chosen].astype(np.float64)
        table, mode, residual[chosen] = fit_modes(samples, job.state_n, prior, job.options, rng)
        model[chosen], modes[step] = mode + modes.sum(), len(table)
        tables.append(table)
    return ClassModel(stack(tables), modes, model, residual)


def patch(job_list: Sequence[ClassJob], fits: Sequence[ClassModel], rows_n: int) -> Patch:
    """Models of all groups in one table, and each row's model in it (PatchModelSeries of Algorithm 2)."""
    of_row, residual = np.full(rows_n, NONE), np.full(rows_n, np.nan)
    first = 0
    for job, fit in zip(job_list, fits, strict=True):
        of_row[job.rows], residual[job.rows] = first + fit.model, fit.residual
        first += len(fit.models)
    return Patch(stack([fit.models for fit in fits]), of_row, residual)
