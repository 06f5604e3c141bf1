"""Local models of every class (FitLocalModels; Algorithm 2, lines 4 to 6).

Each group of segments becomes one job: its aligned samples, the pooled moments it is shrunk towards, and a
seed of its own. `fit_class` is a pure function of the job, so jobs may run anywhere, in any order. Every row
with a dynamics sample lies in exactly one bin (group, step) of one job.

A plan says which samples a job has; they are gathered when the job is due, so that only the jobs at work hold any.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm import warping
from t6gps.learner.algorithm.modes import FitOptions, fit_modes
from t6gps.learner.algorithm.regression import Models, Moments, pooled_moments, stack
from t6gps.learner.algorithm.segments import SegmentGroup, Segments
from t6gps.learner.rows import NONE, Floats, Ints, Rows
from t6gps.learner.streams import Stream, branch, generator


@dataclass(frozen=True)
class ClassPlan:
    """Everything that the models of one group of segments depend on, but for the samples; can be pickled.

    rows      positions of the samples in the iteration's rows [n], ascending
    state_n   entries of x
    step      aligned step of each sample [n], 0 .. steps - 1
    crosses   the last step holds crossings into the next triangle's frame
    ordinary, crossing   moments pooled over the kind, and over kind and exit; None where no such sample
                         exists
    run_seed, branch     of the job's own generator
    """

    rows: Ints
    state_n: int
    step: Ints
    steps: int
    crosses: bool
    ordinary: Moments | None
    crossing: Moments | None
    options: FitOptions
    run_seed: int
    branch: tuple[int, ...]


@dataclass(frozen=True)
class ClassJob:
    """A plan and its samples: joint vectors [x; u; x'] [n, 2 nx + nu]."""

    plan: ClassPlan
    samples: Floats


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


def plans(
    rows: Rows,
    segments: Segments,
    groups: Sequence[SegmentGroup],
    options: FitOptions,
    run_seed: int,
    iteration: int,
) -> dict[int, ClassPlan]:
    """The plan of each group with a dynamics sample, by its position in `groups` (paper Sec. III-B to III-E)."""
    index = np.flatnonzero(rows.continues)
    priors = _priors(rows, index)
    group_of = np.full(len(segments.start), NONE)
    for number, group in enumerate(groups):
        group_of[group.segments] = number
    group_of_row, lengths = group_of[segments.of_row[index]], segments.stop - segments.start
    made = {}
    for number in np.unique(group_of_row).tolist():
        chosen, group = index[group_of_row == number], groups[number]
        kind, entry, exit_, truncated = group.key
        crosses, segment = exit_ != NONE, segments.of_row[chosen]
        steps = warping.class_steps(lengths[group.segments], crosses)
        key = (kind, entry + 1, exit_ + 1, int(truncated), int(group.pooled))
        made[number] = ClassPlan(
            rows=chosen,
            state_n=rows.state.shape[1],
            step=warping.align(chosen - segments.start[segment], lengths[segment], steps, crosses),
            steps=steps,
            crosses=crosses,
            ordinary=priors.get((kind, NONE)),
            crossing=priors.get((kind, exit_)) if crosses else None,
            options=options,
            run_seed=run_seed,
            branch=branch(iteration, Stream.FITS, *key),
        )
    return made


def _priors(rows: Rows, index: Ints) -> dict[tuple[int, int], Moments]:
    """Moments of the ordinary transitions of each kind, key (kind, NONE), and of the crossings by kind and exit."""
    kinds, exits = rows.kind[index], rows.exit[index]
    return {
        (kind, exit_): pooled_moments(rows, index[(kinds == kind) & (exits == exit_)])
        for kind, exit_ in np.unique(np.stack([kinds, exits], axis=1), axis=0).tolist()
    }


def job(rows: Rows, plan: ClassPlan) -> ClassJob:
    """A plan with its samples."""
    return ClassJob(plan, rows.samples(plan.rows))


def fit_class(job: ClassJob) -> ClassModel:
    """Models of every step of one group (FitLocalModels of Algorithm 2); depends on nothing but `job`."""
    plan = job.plan
    rng = generator(plan.run_seed, plan.branch)
    tables, modes = [], np.zeros(plan.steps, dtype=np.int64)
    model, residual = np.full(len(plan.step), NONE), np.full(len(plan.step), np.nan)
    for step in np.unique(plan.step).tolist():
        chosen = np.flatnonzero(plan.step == step)
        prior = plan.crossing if plan.crosses and step == plan.steps - 1 else plan.ordinary
        assert prior is not None, "every sample is part of the pool of its kind"
        samples = job.samples[chosen].astype(np.float64)
        table, mode, residual[chosen] = fit_modes(samples, plan.state_n, prior, plan.options, rng)
        model[chosen], modes[step] = mode + modes.sum(), len(table)
        tables.append(table)
    return ClassModel(stack(tables), modes, model, residual)
